"""EntGame (Tiapkin et al. 2023) in a known MDP: a newer peer of MaxEnt-V, in V's own terms."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.theory import tabular
from maxent_jax.theory.mdps import Mdp


class GameTrace(NamedTuple):
    """What a game went through, for each of N seeds."""

    entropy: np.ndarray  # [N, T + 1] of the uniform mixture of the policies so far, nats
    mixture: np.ndarray  # [N, S] the last


def ent_game(
    mdp: Mdp, first: np.ndarray, num_iterations: int, prior: float, sampled: bool, keys: jax.Array
) -> GameTrace:
    """A forecaster predicts the states that a sampler visits; the sampler maximises its log-loss.

    The forecaster's density is in proportion to n(s) + n_0, with n(s) the visits so far; the
    sampler plans exactly on -log of it. With expected visits that is MaxEnt-V for the entropy
    itself with a smoothing that vanishes, n_0 over the number of steps so far. The paper's sampler
    also earns a bonus for what it does not know of the transitions; here they are known.

    Args:
      mdp: one, for all seeds.
      first: [N, L, S, A] π_0 of each seed.
      num_iterations: T.
      prior: n_0 > 0, visits of each state that the forecaster pretends to have seen.
      sampled: count the states of one episode an iteration, as the paper does, not expected ones.
      keys: [N] of the episodes.
    Source: Tiapkin et al. 2023, Algorithm 1.
    Raises:
      ValueError: n_0 <= 0 or T < 1.
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
