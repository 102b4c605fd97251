"""MaxEnt-H's reward as published: 1/(p + ε), p the mixture's density in the cell that is reached.

Hazan et al. 2019, in the code of github.com/abbyvansoest/maxent, where ε = 1/sqrt(cells) and p
comes from rollouts of the mixture when an iteration begins. Differences:
- Their grid for Ant has x, y and five random projections of the rest, 1.9e8 cells. Ours is the
  two-dimensional grid of the coverage, without the joints.
- They count states off the grid in its outermost cells; we count all of them in one further cell.
- Their rollouts continue where health fails; ours end.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.intrinsic.protocol import Bonus, Setting, Steps


class State(NamedTuple):
    """The reward in each cell; the last one is for states off the grid."""

    payment: jax.Array  # [cells + 1]


def make(setting: Setting) -> Bonus:
    """The reward 1/(p + ε), positive and at most sqrt(cells)."""
    return Bonus(functools.partial(init, setting.num_cells), reward, refresh=refresh)


def init(num_cells: int, key: jax.Array) -> State:
    """Returns rewards of 0, until the first refresh."""
    del key
    return State(jnp.zeros(num_cells + 1))


def refresh(state: State, share: jax.Array) -> State:
    """Sets the rewards from the share of the mixture's states in each cell, [bins, bins]."""
    del state
    on_grid = share.reshape(-1)
    density = jnp.append(on_grid, jnp.maximum(1 - jnp.sum(on_grid), 0.0))
    return State(1 / (density + on_grid.shape[0] ** -0.5))


def reward(state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the reward [B] of `steps.cell`."""
    return state, state.payment[steps.cell]
