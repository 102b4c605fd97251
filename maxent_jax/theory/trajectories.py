"""Compares mixtures with policies that see the episode: entropy of the mean, and of a trajectory.

MaxEnt-H, LA and V maximise the entropy H(E[d]) of the mean occupancy. ηψ-learning seeks a large
expected entropy E[H(d)] of the visits d of a single trajectory. As H is concave, the second is
never larger than the first, and a policy can be good at the first and poor at the second.
"""

import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.theory import eta_psi, histories, mdps, optimum, tabular
from maxent_jax.theory.histories import Histories
from maxent_jax.theory.mdps import Mdp

ENTROPY_SMOOTHING = 1e-7  # times 1/|S|: changes an entropy by at most 1e-7 nats
TOLERANCE = 1e-6  # nats, of the largest entropy of the mean


def known(toy: bool) -> dict[str, Mdp]:
    """Returns MDPs with few histories by name; the chain and the grid are deterministic.

    The chain is that of the official code of ηψ-learning: 6 states, from the third, 20 steps.
    """
    if toy:
        return {"chain": mdps.finite_horizon(mdps.double_chain(4, failure=0), 4)}
    return {
        "chain": mdps.finite_horizon(mdps.double_chain(6, failure=0), 20),
        "grid": mdps.finite_horizon(mdps.open_grid(3, success=1), 9),
        "slippery grid": mdps.finite_horizon(mdps.open_grid(3, success=0.9), 9),
        "river swim": mdps.finite_horizon(mdps.river_swim(), 12),
        "Garnet": mdps.finite_horizon(mdps.garnet(6, 2, 3, seed=0), 8),
    }


def compare(
    mdp: Mdp, iterations: int, settings: eta_psi.Settings, keys: jax.Array
) -> dict[str, Any]:
    """Compares policies of an MDP of finite horizon; each of the keys [K] is a run of learning."""
    listed = histories.enumerate_all(mdp)
    states, actions = mdp.successors.shape[:2]
    uniform = np.full((len(mdp.discount), states, actions), 1 / actions)
    largest = optimum.solve(mdp, ENTROPY_SMOOTHING / states, TOLERANCE)
    started = time.perf_counter()
    learned = eta_psi.greedy_policy(listed, eta_psi.learn(listed, settings, keys))
    seconds = time.perf_counter() - started
    fixed = eta_psi.greedy_policy(listed, eta_psi.fixed_point(listed))
    one = lambda policy: histories.evaluate(listed, policy[None])
    return {
        "states": states,
        "horizon": len(mdp.discount),
        "histories": len(listed.state),
        "learning_seconds": seconds,
        "policies": {
            "best that sees the episode": _entropies(one(histories.best_policy(listed))),
            "ηψ, fixed point": _entropies(one(fixed)),
            "ηψ-learning": _entropies(histories.evaluate(listed, learned)),
            "largest entropy of the mean": _entropies(
                one(histories.of_markov(listed, largest.policy))
            ),
            "V's mixture": _entropies(_mixture(listed, veritas(mdp, uniform, iterations))),
            "uniformly random": _entropies(one(histories.of_markov(listed, uniform))),
        },
    }


def veritas(mdp: Mdp, first: np.ndarray, iterations: int) -> np.ndarray:
    """Runs MaxEnt-V with σ = 1/|S| as `loop.run` does, and keeps the policies.

    Args:
      first: [L, S, A] π_0.
      iterations: T.
    Returns:
      [T + 1, L, S, A] the policies, which the mixture weighs uniformly.
    """
    with tabular.float64():
        archive = _veritas(tabular.on_device(mdp), jnp.asarray(first), iterations)
        return np.concatenate([first[None], archive])


@functools.partial(jax.jit, static_argnames="iterations")
def _veritas(mdp, first, iterations):
    def iteration(mixed, t):
        reward = tabular.gradient(mixed, 1 / len(mixed))
        values = tabular.plan(mdp, reward, jnp.zeros(first.shape[:2]), len(first))
        policy = tabular.greedy(tabular.action_values(mdp, reward, values))
        return mixed + (tabular.occupancy(mdp, policy) - mixed) / (t + 2), policy

    return jax.lax.scan(iteration, tabular.occupancy(mdp, first), jnp.arange(iterations))[1]


def _mixture(listed: Histories, archive: np.ndarray) -> histories.Visits:
    """What a mixture visits that draws a policy of the archive [P, L, S, A] for each episode."""
    every = histories.evaluate(listed, np.stack([histories.of_markov(listed, p) for p in archive]))
    return histories.Visits(*(field.mean(axis=0, keepdims=True) for field in every))


def _entropies(visits: histories.Visits) -> dict[str, np.ndarray]:
    """E[H(d)] and H(E[d]) of each policy, [P] nats."""
    return {
        "of_a_trajectory": visits.trajectory_entropy,
        "of_the_mean": histories.entropy(visits.occupancy),
    }
