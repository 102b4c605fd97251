"""Scores archived policies by their return under the current reward."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.components import Components
from maxent_jax.density.knn import NONE_EXCLUDED, knn_distances
from maxent_jax.mixture import Archive
from maxent_jax.mixture.occupancy import Occupancy


class Scores(NamedTuple):
    """What each archived policy earns under r_t, unshaped; 0 for an empty slot."""

    episode_return: jax.Array  # [P] undiscounted, mean over the policy's episodes
    step_reward: jax.Array  # [P] mean over the policy's states


def score(
    components: Components,
    occupancy: Occupancy,
    points: jax.Array,
    rows: jax.Array,
    archive: Archive,
    num_filled: jax.Array | None = None,
) -> Scores:
    """Scores each policy by its return under the reward that the reference points define.

    A state leaves itself out of the reference. With `leave_own_out` it also leaves out the states
    of its own policy and of policies that the same iteration archived, unless fewer than k points
    would remain. Points of a history have no row, so a state that is in the history sees itself.

    Args:
      points: [M, F] the reference.
      rows: [M] int32, each point's row in the occupancy; -1 for none.
      archive: the policies to score.
      num_filled: [] int32, how many of the points are filled; all of them if None.
    Returns:
      The scores, [P] each.
    """
    config = components.config
    num_rows = occupancy.policy.shape[0]
    capacity = jax.tree.leaves(archive.parameters)[0].shape[0]
    label = capacity + jnp.arange(num_rows, dtype=jnp.int32)  # a state's own, or its iteration's
    if config.mixture.leave_own_out:
        iteration = (occupancy.policy + config.mixture.snapshots - 1) // config.mixture.snapshots
        owner = jnp.where(rows < 0, -1, iteration[rows])
        others = jnp.sum(owner[None] != jnp.arange(capacity)[:, None], axis=1)  # [P]
        alone = others < config.intrinsic.num_neighbors
        label = jnp.where(alone[iteration], label, iteration)
    point_label = jnp.where(rows < 0, NONE_EXCLUDED - 1, label[rows])
    distance = knn_distances(
        occupancy.features,
        points,
        config.intrinsic.num_neighbors,
        exclude=label,
        count=num_filled,
        labels=point_label,
    )[:, -1]
    reward = components.unshaped_reward(distance)
    alive = occupancy.alive.astype(jnp.float32)
    total = jnp.zeros(capacity).at[occupancy.policy].add(jnp.where(alive > 0, reward, 0.0))
    lived = jnp.zeros(capacity).at[occupancy.policy].add(alive)
    played = jnp.zeros(capacity).at[occupancy.episode_policy].add(1.0)
    return Scores(total / jnp.maximum(played, 1), total / jnp.maximum(lived, 1))


def best(scores: Scores, occupancy: Occupancy) -> jax.Array:
    """Returns the policy with the highest return among those that played, [] int32."""
    capacity = scores.episode_return.shape[0]
    played = jnp.zeros(capacity, bool).at[occupancy.episode_policy].set(True)
    return jnp.argmax(jnp.where(played, scores.episode_return, -jnp.inf)).astype(jnp.int32)
