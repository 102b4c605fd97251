"""Weighs episodes of single policies as training weighs those of the mixture."""

import jax.numpy as jnp
import numpy as np

from maxent_jax.mixture.occupancy import Occupancy


def pooled(visited: Occupancy, weights: np.ndarray) -> Occupancy:
    """Makes an episode count by its policy's weight; all states of a policy then count alike.

    A long episode counts for more, as among episodes of policies that are drawn by weight.

    Args:
      weights: [P] of the policies.
    """
    played = np.bincount(visited.episode_policy, minlength=len(weights))
    of_state = (weights / np.maximum(played, 1))[np.asarray(visited.policy)]
    weight = np.asarray(visited.alive) * of_state
    return visited._replace(weight=jnp.asarray(weight / weight.sum(), jnp.float32))


def without_weightless(visited: Occupancy, weights: np.ndarray) -> Occupancy:
    """Leaves out the episodes of policies of weight 0; keeps those that belong to no policy.

    Args:
      weights: [P] of the policies.
    """
    policy = np.asarray(visited.episode_policy)
    counts = (policy < 0) | (weights[policy] > 0)
    if counts.all():
        return visited
    rows = np.tile(counts, len(visited.alive) // len(policy))
    of_states = ("states", "features", "policy", "weight", "alive")
    returns = visited.task_return
    return visited._replace(
        **{name: getattr(visited, name)[rows] for name in of_states},
        episode_policy=visited.episode_policy[counts],
        task_return=None if returns is None else returns[counts],
    )
