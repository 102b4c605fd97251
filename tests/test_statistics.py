"""Interquartile means, bootstrap intervals, probability of improvement: by hand and by coverage."""

import numpy as np
import pytest

from maxent_jax.studies import statistics


def test_the_interquartile_mean_leaves_out_a_quarter_on_either_side_of_all_runs():
    tasks = [np.array([0.0, 1.0, 2.0, 100.0]), np.array([3.0, 4.0, -50.0, 5.0])]
    # Sorted: -50 0 | 1 2 3 4 | 5 100.
    assert statistics.interquartile_mean(tasks) == pytest.approx(2.5)


def test_the_probability_of_improvement_counts_pairs_and_averages_over_tasks():
    ours = [np.array([3.0, 1.0]), np.array([5.0])]
    theirs = [np.array([2.0, 1.0, 0.0]), np.array([6.0])]
    # 3 beats all three; 1 beats one and ties with one: (3 + 1.5)/6. The other task is lost.
    assert statistics.probability_of_improvement(ours, theirs) == pytest.approx((4.5 / 6 + 0) / 2)
    assert statistics.probability_of_improvement(ours, ours) == 0.5
    with pytest.raises(ValueError, match="zip"):
        statistics.probability_of_improvement(ours, theirs[:1])


def test_nine_in_ten_intervals_hold_the_mean_that_the_seeds_were_drawn_around():
    random = np.random.default_rng(0)
    held = 0
    for trial in range(200):
        low, high = statistics.interval(
            lambda x: np.mean(x[0], axis=-1),
            [random.normal(3.0, 1.0, 20)],
            seed=trial,
            resamples=300,
        )
        held += low <= 3.0 <= high
    # Derived: the percentile bootstrap of 20 normal seeds covers 0.93; four standard errors.
    assert 0.86 < held / 200 < 1.0


def test_seeds_are_drawn_within_their_task():
    tasks = [np.zeros(5), np.full(5, 10.0)]
    assert statistics.interval(lambda x: np.mean(np.concatenate(x, -1), -1), tasks) == (5.0, 5.0)
    with pytest.raises(ValueError, match="no seeds"):
        statistics.interval(statistics.interquartile_mean, [np.zeros(0)])


def test_curves_are_drawn_whole():
    curves = np.array([[0.0, 0.0], [1.0, -1.0], [2.0, -2.0], [3.0, -3.0]])
    middle, low, high = statistics.interval_of_curves(curves)
    np.testing.assert_allclose(middle, [1.5, -1.5])
    np.testing.assert_allclose(low, -high[::-1])
    assert (low <= middle).all() and (middle <= high).all() and (low < high).all()


def test_a_run_at_minus_infinity_counts_as_the_worst_and_spoils_nothing():
    values = np.array([-np.inf, 1.0, 2.0, 3.0, 4.0])
    low, high = statistics.interval(statistics.interquartile_mean, [values])
    assert statistics.interquartile_mean([values]) == 2.0
    assert low == -np.inf and 2.0 < high <= 4.0
    assert statistics.probability_of_improvement([values[1:]], [values[:1]]) == 1.0
    middle, below, above = statistics.interval_of_curves(values[:, None])
    assert (middle, below) == (2.0, -np.inf) and 2.0 < above <= 4.0
