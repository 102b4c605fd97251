"""Frank-Wolfe with line search or full correction, for reference.

The oracles are exact, as in loop.py, but the weights of a mixture are chosen by looking at R. No
method of the paper does this.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from maxent_jax import mixture
from maxent_jax.theory import tabular
from maxent_jax.theory.mdps import Mdp

Rule = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


def line_search(occupancies: np.ndarray, weights: np.ndarray, smoothing: float) -> np.ndarray:
    """Returns weights after the step towards the newest policy that increases H_σ most.

    Args:
      occupancies: [P, S] of the policies, oldest first.
      weights: [P - 1] of the policies before the newest.
      smoothing: σ.
    Returns:
      [P] weights.
    """
    mixed, newest = weights @ occupancies[:-1], occupancies[-1]

    def slope(step):
        now = mixed + step * (newest - mixed)
        return float((newest - mixed) @ (-np.log(now + smoothing) - now / (now + smoothing)))

    if slope(0.0) <= 0:
        step = 0.0
    else:
        step = 1.0 if slope(1.0) >= 0 else optimize.brentq(slope, 0.0, 1.0, xtol=1e-15)
    return np.append((1 - step) * weights, step)


def fully_corrective(occupancies: np.ndarray, weights: np.ndarray, smoothing: float) -> np.ndarray:
    """Returns the best weights [P] of all policies so far.

    Args: as `line_search`.
    """
    return mixture.fully_corrective_weights(occupancies, smoothing, np.append(weights, 0.0))


RULES: dict[str, Rule] = {"line search": line_search, "fully corrective": fully_corrective}


def run(
    mdp: Mdp, rule: Rule, first: np.ndarray, num_iterations: int, smoothing: float
) -> np.ndarray:
    """Returns H_σ of the mixture after each iteration, [T + 1] nats; planning converges.

    Args:
      mdp: a single MDP.
      rule: one of RULES.
      first: [L, S, A] π_0.
      num_iterations: T.
      smoothing: σ.
    """
    with tabular.float64():
        mdp = tabular.on_device(mdp)
        steps = tabular.converged_steps(mdp)
        occupancies = [np.asarray(tabular.occupancy(mdp, jnp.asarray(first)))]
        weights = np.ones(1)
        objective = [_objective(occupancies, weights, smoothing)]
        for _ in range(num_iterations):
            newest = _best_occupancy(mdp, jnp.asarray(weights @ occupancies), smoothing, steps)
            occupancies.append(np.asarray(newest))
            weights = rule(np.stack(occupancies), weights, smoothing)
            objective.append(_objective(occupancies, weights, smoothing))
    return np.array(objective)


def _objective(occupancies: list[np.ndarray], weights: np.ndarray, smoothing: float) -> float:
    return float(tabular.objective(jnp.asarray(weights @ np.stack(occupancies)), smoothing))


@functools.partial(jax.jit, static_argnames="steps")
def _best_occupancy(mdp, mixed, smoothing, steps):
    reward = tabular.gradient(mixed, smoothing)
    zeros = jnp.zeros((len(mdp.discount), len(mixed)))
    values = tabular.plan(mdp, reward, zeros, steps)
    return tabular.greedy_occupancy(mdp, reward, values)
