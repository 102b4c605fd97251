"""k-means MaxEnt: by how much a state would spread the centres of all states met.

Nedergaard & Cook 2022, "k-means maximum entropy exploration", arXiv 2205.15623, and its code
(github.com/axnedergaard/kme). Centres follow the states, each state the nearest, where a centre
that has had few counts as nearer. Sum over the centres of f(distance to the nearest other) bounds
the entropy from below, with f a root in the code's experiments; the reward is what one step towards
the state would add to it, from centres that stay put while a batch is paid (`coupled: False`).
Their C++ offsets distances between centres by their counts too, their later Python does not, as
here; centres start at the origin in the former, uniform in [-1, 1] in the latter and here.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.intrinsic import protocol
from maxent_jax.intrinsic.protocol import Bonus, Setting, Steps
from maxent_jax.types import Metrics

# k, learning_rate, balancing_strength and power_fn_exponent of mujoco/train.yaml.
NUM_CENTERS, STEP, BALANCE, EXPONENT = 300, 0.05, 1e-4, 0.5
# States of a batch that are followed, one after the other: all in `quick` and `paper`.
MAX_FOLLOWED = 128


class State(NamedTuple):
    """Where the centres are, in scaled observations, and how many states each has followed."""

    centers: jax.Array  # [C, D]
    counts: jax.Array  # [C] int32


def make(setting: Setting) -> Bonus:
    """The reward: how much wider apart the centres would be, of either sign."""
    return Bonus(
        init=functools.partial(init, setting),
        reward=functools.partial(reward, setting),
        learn=functools.partial(learn, setting),
    )


def init(setting: Setting, key: jax.Array) -> State:
    """Centres uniform in [-1, 1]."""
    shape = (NUM_CENTERS, setting.observation_size)
    centers = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    return State(centers, jnp.zeros(NUM_CENTERS, jnp.int32))


def reward(setting: Setting, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """What each state alone would add to the sum of roots, were its centre to follow it."""
    states = protocol.scaled(setting, steps.next_observation)
    chosen = nearest_center(state, states)
    moved = _moved(state.centers[chosen], states)
    return state, gains(state.centers, chosen, moved)


def learn(setting: Setting, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """States of the batch one after the other, in a random order, each moving its centre."""
    states = jax.random.permutation(key, protocol.scaled(setting, steps.next_observation))
    states = states[:MAX_FOLLOWED]

    def follow(state: State, point: jax.Array):
        index = nearest_center(state, point[None])[0]
        center = state.centers[index]
        centers = state.centers.at[index].set(_moved(center, point))
        distance = jnp.sqrt(jnp.sum((point - center) ** 2))
        return State(centers, state.counts.at[index].add(1)), distance

    state, distances = jax.lax.scan(follow, state, states)
    return state, {"bonus_center_distance": jnp.mean(distances)}


def nearest_center(state: State, states: jax.Array) -> jax.Array:
    """[B, D] -> [B] int: the least of distance + κ (count - mean count)."""
    counts = state.counts.astype(jnp.float32)
    offset = BALANCE * (counts - jnp.mean(counts))
    return jnp.argmin(_distances(states, state.centers) + offset[None], axis=-1)


def gains(centers: jax.Array, chosen: jax.Array, moved: jax.Array) -> jax.Array:
    """By how much the sum over centres of f(distance to the nearest other) would rise.

    Args:
      centers: [C, D].
      chosen: [B] int, the centre that moves, alone.
      moved: [B, D] where to.
    Returns:
      [B].
    """
    own = jnp.arange(centers.shape[0])
    between = jnp.where(jnp.eye(own.size, dtype=bool), jnp.inf, _distances(centers, centers))
    nearest = jnp.argmin(between, axis=-1)
    first = jnp.min(between, axis=-1)
    second = jnp.min(jnp.where(own[None] == nearest[:, None], jnp.inf, between), axis=-1)

    mover = own[None] == chosen[:, None]  # [B, C]
    to_moved = jnp.where(mover, jnp.inf, _distances(moved, centers))
    without_mover = jnp.where(nearest[None] == chosen[:, None], second[None], first[None])
    after = jnp.minimum(to_moved, without_mover)
    after = jnp.where(mover, jnp.min(to_moved, axis=-1, keepdims=True), after)
    return jnp.sum(after**EXPONENT - first[None] ** EXPONENT, axis=-1)


def _moved(center: jax.Array, state: jax.Array) -> jax.Array:
    return center + STEP * (state - center)


def _distances(points: jax.Array, others: jax.Array) -> jax.Array:
    """[B, D], [C, D] -> [B, C], by differences, of which no small one is lost."""
    return jnp.sqrt(jnp.sum((points[:, None] - others[None]) ** 2, axis=-1))
