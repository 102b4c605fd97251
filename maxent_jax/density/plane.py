"""The unit cells of the plane that states have visited, cumulatively: METRA's state coverage.

A cell is (floor(x), floor(y)), in metres, as in the code of Park et al. 2024 (METRA, arXiv
2310.08887), where cells have no bounds. Here the plane ends 512 m from its origin, which is farther
than any of the robots gets in an episode of 1,000 steps; what lies beyond is not counted.
"""

import jax
import jax.numpy as jnp

SIDE = 1024  # metres


def empty() -> jax.Array:
    """Returns the plane without visits, [SIDE, SIDE] bool."""
    return jnp.zeros((SIDE, SIDE), bool)


def visit(plane: jax.Array, places: jax.Array, counts: jax.Array) -> jax.Array:
    """Adds visits.

    Args:
      plane: [SIDE, SIDE] bool, the cells visited so far.
      places: [B, 2] metres; what is not finite is dropped.
      counts: [B] bool, the places that count.
    Returns:
      [SIDE, SIDE] bool, with the cells of the places.
    """
    cell = jnp.floor(places) + SIDE // 2
    inside = ((cell >= 0) & (cell < SIDE)).all(-1) & counts
    row, column = jnp.where(inside[:, None], cell, SIDE).astype(jnp.int32).T
    return plane.at[row, column].set(True, mode="drop")


def num_cells(plane: jax.Array) -> jax.Array:
    """Returns the number of cells visited, [] int32."""
    return jnp.sum(plane, dtype=jnp.int32)
