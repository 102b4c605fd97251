"""EntGame (Tiapkin et al. 2023) in a known MDP, for comparison with MaxEnt-V."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.theory import tabular
from maxent_jax.theory.mdps import Mdp


class GameTrace(NamedTuple):
    """The measures of a game for N seeds."""

    entropy: np.ndarray  # [N, T + 1] of the uniform mixture of the policies so far, nats
    mixture: np.ndarray  # [N, S] occupancy of the last mixture


def ent_game(
    mdp: Mdp, first: np.ndarray, num_iterations: int, prior: float, sampled: bool, keys: jax.Array
) -> GameTrace:
    """Plays EntGame: a forecaster predicts the states that a sampler visits.

    The sampler maximises the forecaster's log-loss. The forecaster's density is proportional to
    n(s) + n_0, where n(s) counts the visits so far, and the sampler plans exactly on -log of it.
    With expected visits this is MaxEnt-V for the entropy itself, with a smoothing that vanishes:
    n_0 divided by the number of steps so far. In the paper the sampler also earns a bonus for
    uncertainty about the transitions; here they are known.

    Args:
      mdp: one for all seeds.
      first: [N, L, S, A] π_0 of each seed.
      num_iterations: T.
      prior: n_0 > 0, visits that the forecaster adds to each state.
      sampled: count the states of one episode per iteration, as in the paper, not expected ones.
      keys: [N] typed keys of the episodes.
    Returns:
      The trace of all seeds.
    Raises:
      ValueError: n_0 <= 0 or T < 1.
    Source: Tiapkin et al. 2023, Algorithm 1.
    """
    if not 0 < prior < np.inf:
        raise ValueError(f"prior is {prior}, but must be a positive number")
    if num_iterations < 1:
        raise ValueError(f"num_iterations is {num_iterations}, but must be at least 1")
    with tabular.float64():
        steps = tabular.converged_steps(mdp)
        play = jax.vmap(
            lambda policy, key: _play(
                tabular.on_device(mdp), policy, num_iterations, prior, sampled, steps, key
            )
        )
        return GameTrace(*(np.asarray(x) for x in jax.jit(play)(jnp.asarray(first), keys)))


def _play(mdp, first, num_iterations, prior, sampled, steps, key):
    def visits(policy, occupied, key):
        if sampled:
            return tabular.sample_visits(mdp, policy, steps, key)
        return occupied * tabular.episode_length(mdp)

    def iteration(now, t):
        mixed, counts = now
        reward = -jnp.log(counts + prior)
        values = tabular.plan(mdp, reward, jnp.zeros(first.shape[:2]), steps)
        policy = tabular.greedy(tabular.action_values(mdp, reward, values))
        occupied = tabular.occupancy(mdp, policy)
        mixed = mixed + (occupied - mixed) / (t + 2)
        counts = counts + visits(policy, occupied, jax.random.fold_in(key, t + 1))
        return (mixed, counts), tabular.objective(mixed, 0.0)

    occupied = tabular.occupancy(mdp, first)
    begin = occupied, visits(first, occupied, jax.random.fold_in(key, 0))
    (mixed, _), entropy = jax.lax.scan(iteration, begin, jnp.arange(num_iterations))
    return jnp.append(tabular.objective(occupied, 0.0), entropy), mixed
