"""k-means MaxEnt: by how much a state would spread the centres of all states seen so far.

Nedergaard & Cook 2022, "k-means maximum entropy exploration", arXiv 2205.15623, and its code
(github.com/axnedergaard/kme). Each state moves its nearest centre; a centre that few states have
moved counts as nearer. The sum over the centres of f(distance to the nearest other) is a lower
bound of the entropy; f is a root in the code's experiments. The reward is what one step towards the
state would add to the sum; the centres do not move while a batch is rewarded (`coupled: False`).
Their C++ also offsets distances between centres by their counts, and starts the centres at the
origin. Their later Python does not, and starts them uniformly in [-1, 1]; we do the same.
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
# States of a batch that move a centre, one after the other: all in `quick` and `paper`.
MAX_FOLLOWED = 128


class State(NamedTuple):
    """The centres, in scaled features, and how many states have moved each."""

    centers: jax.Array  # [C, F]
    counts: jax.Array  # [C] int32


def make(setting: Setting) -> Bonus:
    """Makes the bonus: by how much the centres would spread, of either sign."""
    return Bonus(
        init=functools.partial(init, setting),
        reward=functools.partial(reward, setting),
        learn=functools.partial(learn, setting),
    )


def init(setting: Setting, key: jax.Array) -> State:
    """Draws centres uniformly from [-1, 1]."""
    shape = (NUM_CENTERS, setting.num_features)
    centers = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
    return State(centers, jnp.zeros(NUM_CENTERS, jnp.int32))


def reward(setting: Setting, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns what each state alone would add to the sum of roots by moving its centre, [B]."""
    states = protocol.scaled(setting, steps.next_features)
    chosen = nearest_center(state, states)
    moved = _moved(state.centers[chosen], states)
    return state, gains(state.centers, chosen, moved)


def learn(setting: Setting, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """Lets the states of the batch move their centres, one after the other in random order."""
    states = jax.random.permutation(key, protocol.scaled(setting, steps.next_features))
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
    """Returns the centre with the least distance + κ (count - mean count), [B, F] -> [B] int."""
    counts = state.counts.astype(jnp.float32)
    offset = BALANCE * (counts - jnp.mean(counts))
    return jnp.argmin(_distances(states, state.centers) + offset[None], axis=-1)


def gains(centers: jax.Array, chosen: jax.Array, moved: jax.Array) -> jax.Array:
    """Returns by how much the sum over centres of f(distance to the nearest other) would rise.

    Args:
      centers: [C, F].
      chosen: [B] int, the only centre that moves.
      moved: [B, F] its new place.
    Returns:
      [B] the rise.
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
    """[B, F], [C, F] -> [B, C], by differences, so that no small distance is lost."""
    return jnp.sqrt(jnp.sum((points[:, None] - others[None]) ** 2, axis=-1))
