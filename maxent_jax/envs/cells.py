"""Cells of a grid at whose first states episodes begin again, as in Go-Explore.

Source: Ecoffet et al. 2019 and 2021. Their weight is 1 / sqrt(visits + 1), where a trajectory
visits a cell once. Here it is the inverse of the density of all steps, which is 1 / visits up to a
factor. They replace a cell's state when a shorter trajectory reaches it; here the first one stays.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Cells(NamedTuple):
    """Q cells. Those with visits have a state; `base.Episodes` holds it in its pool of starts."""

    share: jax.Array  # [N] of the episodes that begin at a cell; those with 0 are not counted
    age: jax.Array  # [Q] int32, of the state's episode there
    visits: jax.Array  # [Q] int32, steps that left a state in the cell


def init(num_cells: int, share: jax.Array) -> Cells:
    """Returns Q cells without visits, for N episodes with these shares [N]."""
    none = jnp.zeros(num_cells, jnp.int32)
    return Cells(share, none, none)


def visit(cells: Cells, cell: jax.Array, age: jax.Array) -> tuple[Cells, jax.Array]:
    """Counts the cells that the episodes are in.

    Args:
      cells: Q cells.
      cell: [N] int32, the cell of each episode; Q for a state off the grid.
      age: [N] int32 of the episodes.
    Returns:
      The cells after the visit, and [N] int32 the cell whose first state is this episode's; Q for
      an episode that is not the first in its cell.
    """
    num_cells, rows = cells.age.shape[0], jnp.arange(cell.shape[0], dtype=jnp.int32)
    cell = jnp.where(cells.share > 0, cell, num_cells)
    first = jnp.full(num_cells, rows.shape[0], jnp.int32).at[cell].min(rows, mode="drop")
    is_first = first.at[cell].get(mode="fill", fill_value=-1) == rows
    is_empty = cells.visits.at[cell].get(mode="fill", fill_value=1) == 0
    new = jnp.where(is_empty & is_first, cell, num_cells)
    after = cells._replace(
        age=cells.age.at[new].set(age, mode="drop"),
        visits=cells.visits.at[cell].add(1, mode="drop"),
    )
    return after, new


def draw(cells: Cells, num: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws cells with probability in proportion to 1 / visits, 0 without visits.

    Args:
      cells: Q cells.
      num: of draws, independent of each other.
      key: of the draw.
    Returns:
      [num] int32 the cells, and [num] bool whether each has a state. All are false if no cell has
      one; otherwise one is false only by a rare rounding error.
    """
    weights = jnp.where(cells.visits > 0, 1.0 / jnp.maximum(cells.visits, 1), 0.0)
    cell = jax.random.choice(key, weights.shape[0], (num,), p=weights)
    return cell, cells.visits[cell] > 0
