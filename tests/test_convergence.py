"""The rule on curves whose plateau is known."""

import numpy as np
import pytest

from maxent_jax.algorithm.convergence import has_plateaued

STEPS = np.arange(60)
SATURATING = 1 - np.exp(-STEPS / 5)


def ends_at(curve, patience=4, tolerance=0.05):
    """The number of segments after which the rule ends the iteration, None if never."""
    return next((n for n in STEPS if has_plateaued(list(curve[:n]), patience, tolerance)), None)


def test_a_saturating_return_ends_where_its_rise_falls_below_the_tolerance():
    """Of 1 - exp(-n/5) the means of two windows of 4 differ by (1 - e^(-4/5)) times the mean of
    exp(-n/5) over the earlier one, against 5 % of the whole rise: by hand, after 19 segments."""
    decay = np.exp(-STEPS / 5)
    expected = next(
        n
        for n in range(8, 60)
        if (1 - np.exp(-4 / 5)) * decay[n - 8 : n - 4].mean() <= 0.05 * SATURATING[n - 1]
    )
    assert ends_at(SATURATING) == expected == 19


@pytest.mark.parametrize(
    "curve",
    [STEPS * 1.0, -STEPS * 1.0, np.exp(STEPS / 10)],
    ids=["rises", "falls", "rises ever faster"],
)
def test_what_still_moves_goes_on(curve):
    assert ends_at(curve) is None


def test_a_dip_at_the_start_is_no_plateau():
    dip = np.concatenate([np.linspace(0.5, 0.1, 10), 0.1 + SATURATING[:40]])
    assert ends_at(dip) == 10 + ends_at(SATURATING)


@pytest.mark.parametrize("scale, shift", [(100.0, 0.0), (1.0, -7.0), (0.01, 3.0)])
def test_units_do_not_matter(scale, shift):
    assert ends_at(scale * SATURATING + shift) == ends_at(SATURATING)


def test_patience_zero_never_ends():
    assert ends_at(np.ones(60), patience=0) is None


@pytest.mark.parametrize("tolerance", [0.0, 0.05])
def test_what_never_moves_ends_as_soon_as_it_may(tolerance):
    assert ends_at(np.ones(60), tolerance=tolerance) == 8


def test_too_few_segments_say_nothing():
    assert not has_plateaued([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], 4, 0.05)
