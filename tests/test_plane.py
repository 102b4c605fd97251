"""Unit cells of the plane, against sets of floored positions."""

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.density import plane


def test_cells_are_floored_positions_counted_once():
    rng = np.random.default_rng(0)
    places = rng.normal(0, 30, (2000, 2)).astype(np.float32)
    places[:6] = [[0, 0], [-1, 0], [-1e-3, 0.999], [5, -5], [4.9999, -5.0001], [0.5, 0.5]]
    counts = rng.uniform(size=2000) < 0.7
    visit, found, seen = jax.jit(plane.visit), plane.empty(), set()
    for batch, valid in zip(np.split(places, 40), np.split(counts, 40), strict=True):
        found = visit(found, batch, valid)
        seen |= set(map(tuple, np.floor(batch[valid]).astype(int)))
        assert plane.num_cells(found) == len(seen)
    assert 500 < len(seen) < 1400  # many are met more than once


def test_what_is_beyond_the_plane_or_not_finite_is_dropped():
    half = plane.SIDE / 2
    inside = jnp.array([[-half, -half], [half - 0.5, 0.0]])
    outside = jnp.array([[half, 0.0], [0.0, -half - 0.1], [jnp.nan, 0.0], [0.0, jnp.inf], [3e9, 0]])
    everything = jnp.concatenate([inside, outside])
    found = plane.visit(plane.empty(), everything, jnp.ones(len(everything), bool))
    assert plane.num_cells(found) == 2
