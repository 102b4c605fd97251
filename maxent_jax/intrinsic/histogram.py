"""MaxEnt-H's reward as published: 1/(p + ε), p the mixture's density in the cell that is reached.

Hazan et al. 2019, in the code of github.com/abbyvansoest/maxent, where ε = 1/sqrt(cells) and p
comes from rollouts of the mixture as an iteration begins. There the Ant's grid is of x, y and five
random projections of the rest, 1.9e8 cells; here it is that of the coverage, two-dimensional, and
the joints do not enter. There states off the grid count to its outermost cells; here all of them
together are one cell more. There rollouts go on where health fails; here they end.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.intrinsic.protocol import Bonus, Setting, Steps, no_learning


class State(NamedTuple):
    """What each cell pays, the last for states off the grid."""

    payment: jax.Array  # [cells + 1]


def make(setting: Setting) -> Bonus:
    """The reward 1/(p + ε), positive and at most sqrt(cells)."""
    return Bonus(
        init=functools.partial(init, setting.num_cells),
        reward=reward,
        learn=no_learning,
        refresh=refresh,
    )


def init(num_cells: int, key: jax.Array) -> State:
    """Pays nothing: a mixture comes first."""
    del key
    return State(jnp.zeros(num_cells + 1))


def refresh(state: State, share: jax.Array) -> State:
    """With the mixture's share of states in each cell, [bins, bins], as an iteration begins."""
    del state
    on_grid = share.reshape(-1)
    density = jnp.append(on_grid, jnp.maximum(1 - jnp.sum(on_grid), 0.0))
    return State(1 / (density + on_grid.shape[0] ** -0.5))


def reward(state: State, steps: Steps) -> tuple[State, jax.Array]:
    """[B], of `steps.cell`."""
    assert steps.cell is not None
    return state, state.payment[steps.cell]
