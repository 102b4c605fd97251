"""The grid of visits against numpy's histogram, its entropy against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from maxent_jax.density import histogram
from maxent_jax.density.histogram import Grid

NAMES = ("a", "b")
ANT = Grid(NAMES, (-40.0, -40.0), (40.0, 40.0), (100, 100))
WALKER = Grid(NAMES, (-20.0, 0.5), (5.0, 2.0), (30, 7), coordinates=(2, 0))
EXACT = Grid(NAMES, (-4.0, -2.0), (4.0, 2.0), (8, 16))  # edges that float32 represents
GRIDS = pytest.mark.parametrize("grid", [ANT, WALKER, EXACT], ids=["ant", "walker", "exact"])


def expected_count(states, grid, weights=None):
    position = np.asarray(states, np.float64)[:, list(grid.coordinates)]
    known = ~np.isnan(position).any(1)
    ranges = list(zip(grid.low, grid.high, strict=True))
    weights = None if weights is None else np.asarray(weights, np.float64)[known]
    return np.histogram2d(*position[known].T, bins=grid.bins, range=ranges, weights=weights)[0]


def random_states(rng, grid, num=5000):
    low, high, bins = np.array(grid.low), np.array(grid.high), np.array(grid.bins)
    # A third of each coordinate off the grid; 1e-3 of a cell away from each edge, since float32
    # places a state to about 100 × 2^-23 = 1e-5 of a cell.
    cell = rng.integers(-bins // 4, bins + bins // 4, size=(num, 2))
    position = low + (cell + rng.uniform(1e-3, 1 - 1e-3, (num, 2))) / bins * (high - low)
    states = rng.standard_normal((num, 4)).astype(np.float32)
    states[:, list(grid.coordinates)] = position
    return states


@GRIDS
@pytest.mark.parametrize("weight", [None, np.int32, np.float32])
def test_the_count_is_that_of_numpy(grid, weight):
    rng = np.random.default_rng(0)
    states = random_states(rng, grid)
    weights = None if weight is None else rng.integers(5, size=len(states)).astype(weight)
    counts = jax.jit(histogram.count, static_argnums=1)(states, grid, weights)
    expected = expected_count(states, grid, weights)
    np.testing.assert_array_equal(counts, expected)  # whole numbers are exact in float32
    assert counts.dtype == (weight or np.int32)
    assert 0 < expected.sum() < (len(states) if weights is None else weights.sum())


def test_fractional_weights_add_up_as_in_numpy():
    rng = np.random.default_rng(1)
    states, weights = random_states(rng, WALKER), rng.random(5000).astype(np.float32)
    counts = histogram.count(states, WALKER, jnp.asarray(weights))
    # Derived: a cell sums about 20 numbers below 1.
    np.testing.assert_allclose(counts, expected_count(states, WALKER, weights), rtol=20 * 2**-24)


def test_a_state_on_an_edge_falls_where_numpy_puts_it():
    edges = [
        np.linspace(a, b, n + 1) for a, b, n in zip(EXACT.low, EXACT.high, EXACT.bins, strict=True)
    ]
    states = np.stack(np.meshgrid(*edges), -1).reshape(-1, 2).astype(np.float32)
    counts = histogram.count(states, EXACT)
    np.testing.assert_array_equal(counts, expected_count(states, EXACT))
    assert counts[0, 0] == 1
    assert counts[-1, -1] == 4  # its own low corner, and the corners of the upper edges


@GRIDS
def test_a_state_on_or_just_inside_the_outer_edges_falls_in_the_outer_cells(grid):
    low, high = np.float32(grid.low), np.float32(grid.high)
    beyond = np.stack([np.nextafter(low, -np.inf), np.nextafter(high, np.inf)])
    inside = np.stack([low, np.nextafter(low, np.inf), np.nextafter(high, -np.inf), high])
    states = np.zeros((6, 4), np.float32)
    states[:, list(grid.coordinates)] = np.concatenate([inside, beyond])
    counts = np.asarray(histogram.count(states, grid))
    assert counts[0, 0] == counts[-1, -1] == 2
    assert counts.sum() == 4


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30, -1e30])
@pytest.mark.parametrize("coordinate", [0, 1])
def test_states_off_the_grid_or_not_finite_are_dropped(bad, coordinate):
    states = np.ones((3, 4), np.float32)
    states[1, coordinate] = bad
    counts = np.asarray(histogram.count(states, ANT))
    assert counts.sum() == 2
    assert counts[51, 51] == 2  # (1 + 40) / 0.8 = 51.25


def test_coordinates_that_the_grid_leaves_out_do_not_matter():
    states = np.ones((2, 4), np.float32)
    states[:, 2:] = np.nan
    assert histogram.count(states, ANT).sum() == 2


def test_coverage_counts_the_cells_visited_at_least_once():
    counts = jnp.array([[0, 1, 7], [0, 0, 2]])
    assert histogram.coverage(counts) == 3
    assert histogram.coverage(counts * 0.01) == 3
    assert histogram.coverage(jnp.zeros((4, 4), jnp.int32)) == 0
    assert histogram.coverage(counts).dtype == jnp.int32


# Derived: sums of up to 10^4 positive terms, added pairwise or in float32 lanes, to a value below
# 9.3; each frequency and its logarithm is off by a few 2^-24.
ENTROPY = {"rtol": 1e-5, "atol": 1e-6}


@pytest.mark.parametrize("scale", [1, 7, 0.25, 1e-6])
@pytest.mark.parametrize("num_cells", [1, 2, 10_000])
def test_cells_visited_alike_have_the_entropy_log_of_their_number(num_cells, scale):
    counts = np.zeros(10_000, np.float32 if isinstance(scale, float) else np.int32)
    counts[:num_cells] = scale
    entropy = histogram.shannon_entropy(jnp.asarray(counts.reshape(100, 100)))
    np.testing.assert_allclose(entropy, np.log(num_cells), **ENTROPY)


@pytest.mark.parametrize("scale", [1, 1000, 0.01])
def test_the_entropy_is_that_of_scipy_and_does_not_depend_on_the_scale(scale):
    counts = np.random.default_rng(2).integers(4, size=(20, 30)) * scale
    entropy = histogram.shannon_entropy(jnp.asarray(counts))
    np.testing.assert_allclose(entropy, stats.entropy(counts.ravel()), **ENTROPY)


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.float32])
def test_the_entropy_of_no_visits_is_zero(dtype):
    assert histogram.shannon_entropy(jnp.zeros((5, 5), dtype)) == 0


@GRIDS
def test_coverage_only_grows_as_states_are_added(grid):
    rng = np.random.default_rng(2)
    counts, before = jnp.zeros(grid.bins, jnp.int32), 0
    for _ in range(6):
        counts = counts + histogram.count(random_states(rng, grid, 40), grid)
        after = int(histogram.coverage(counts))
        assert after >= before
        before = after
    assert before > 40
