"""State coverage and entropy from visits to the cells of a grid, as the paper reports them."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp


class Grid(NamedTuple):
    """Cells of equal size over two coordinates of the state. Static and hashable."""

    names: tuple[str, str]  # of the coordinates, with their units
    low: tuple[float, float]
    high: tuple[float, float]
    bins: tuple[int, int]
    coordinates: tuple[int, int] = (0, 1)  # indices in the state, or in its transform
    transform: Callable[[jax.Array], jax.Array] | None = None  # [..., D] -> [..., at least 2]

    @property
    def num_cells(self) -> int:
        """The number of cells on both axes together."""
        return self.bins[0] * self.bins[1]


def locate(states: jax.Array, grid: Grid) -> jax.Array:
    """Returns the grid coordinates [..., 2] of states [..., D]."""
    located = grid.transform(states) if grid.transform else states
    return located[..., jnp.array(grid.coordinates)]


def count(states: jax.Array, grid: Grid, weights: jax.Array | None = None) -> jax.Array:
    """Counts how often, or with how much weight, states visit each cell.

    Args:
      states: [B, D].
      grid: the cells. A state on the upper edge belongs to the last cell, as in numpy.
      weights: [B] int or float, the weight of each state; 1 when left out.
    Returns:
      [bins, bins] in the weights' dtype, else int32. States off the grid, and NaN, are dropped.
    Raises:
      ValueError: the shapes do not match the grid or each other.
      TypeError: the grid is not a Grid.
    """
    if not isinstance(grid, Grid):
        raise TypeError(f"grid is {grid!r}, but must be a density.histogram.Grid")
    states = jnp.asarray(states)
    if states.ndim != 2 or (grid.transform is None and states.shape[1] <= max(grid.coordinates)):
        raise ValueError(
            f"states have shape {states.shape}, but must be [B, D] with the coordinates "
            f"{grid.coordinates} of the grid"
        )
    weights = jnp.ones(states.shape[0], jnp.int32) if weights is None else jnp.asarray(weights)
    if weights.shape != states.shape[:1]:
        raise ValueError(f"weights have shape {weights.shape}, but must be [{states.shape[0]}]")
    counts = jnp.zeros(grid.num_cells, weights.dtype)
    return counts.at[cells(states, grid)].add(weights, mode="drop").reshape(grid.bins)


def cells(states: jax.Array, grid: Grid) -> jax.Array:
    """Returns the cell of each state, [B, D] -> [B] int32.

    Cells are numbered row by row; num_cells stands for states off the grid and for NaN.
    """
    position = locate(states, grid)
    low, high, bins = (jnp.array([x], jnp.float32) for x in (grid.low, grid.high, grid.bins))
    cell = jnp.floor((position - low) / (high - low) * bins)
    cell = jnp.minimum(cell, bins - 1)  # the upper edge, and positions that round to it
    inside = ((position >= low) & (position <= high)).all(-1)
    row, column = jnp.where(inside[:, None], cell, 0).astype(jnp.int32).T
    return jnp.where(inside, row * grid.bins[1] + column, grid.num_cells)


def coverage(counts: jax.Array) -> jax.Array:
    """Returns the number of cells visited at least once, [...] -> [] int32."""
    return jnp.sum(jnp.asarray(counts) > 0, dtype=jnp.int32)


def shannon_entropy(counts: jax.Array) -> jax.Array:
    """Returns the entropy of visit frequencies, [...] -> [] nats, at most log(number of cells).

    It is 0 without visits.
    """
    counts = jnp.asarray(counts)
    total = jnp.sum(counts)
    frequency = counts / jnp.where(total > 0, total, 1)
    return -jnp.sum(jnp.where(counts > 0, frequency * jnp.log(jnp.maximum(frequency, 1e-38)), 0.0))
