"""Weights of the mixture's policies: uniform, geometric, last, and fully corrective."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from maxent_jax.checks import check_number, check_whole

CORRECTIVE_ROUNDS = 1000  # for 21 policies within log(21)/1000 = 0.003 nats of the optimum


def uniform_weights(n: int) -> np.ndarray:
    """Returns [n] float64 weights of 1/n each (MaxEnt-V and LA).

    Raises:
      ValueError: n < 1.
    """
    _check_count(n)
    return np.full(n, 1.0 / n)


def geometric_weights(n: int, eta: float) -> np.ndarray:
    """Returns the η-geometric weights of MaxEnt-H, oldest policy first; the newest is largest.

    y_i = (1 - η)^(n - i) for i = 0 ... n - 1, projected on the simplex in the Euclidean norm.

    Args:
      n: number of policies.
      eta: step size in (0, 1].
    Returns:
      [n] float64, at least 0, sum 1.
    Raises:
      ValueError: n < 1, or η outside (0, 1].
    Source: Eq. 13, as in the official code of Hazan et al. 2019; see docs/decisions.md, decision 3.
    """
    _check_count(n)
    if not 0 < check_number("eta", eta) <= 1:
        raise ValueError(f"eta is {eta}, but must be in (0, 1]")
    return project_to_simplex((1 - eta) ** (n - np.arange(n, dtype=np.float64)))


def fully_corrective_weights(
    occupancies: np.ndarray, smoothing: float, start: np.ndarray | None = None
) -> np.ndarray:
    """Returns the weights whose mixture has the largest smoothed entropy -Σ d(s) log(d(s) + σ).

    This is a concave problem on the simplex, which SciPy's SLSQP solves.

    Args:
      occupancies: [n, S] of each policy over S states, each row of sum 1.
      smoothing: σ > 0.
      start: [n] initial weights; equal ones if None.
    Returns:
      [n] float64, at least 0, sum 1.
    Raises:
      ValueError: there are no policies, the shapes do not match, an occupancy is negative or not
        finite, or σ <= 0.
    """
    occupancies = np.asarray(occupancies, np.float64)
    if occupancies.ndim != 2:
        raise ValueError(f"occupancies have shape {occupancies.shape}, but must be [n, S]")
    n = len(occupancies)
    _check_count(n)
    if not (np.isfinite(occupancies) & (occupancies >= 0)).all():
        raise ValueError("occupancies hold a number that is negative or not finite")
    if not 0 < check_number("smoothing", smoothing) < np.inf:
        raise ValueError(f"smoothing is {smoothing}, but must be a positive number")
    if start is not None and np.shape(start) != (n,):
        raise ValueError(f"start has shape {np.shape(start)}, but must be [{n}], one per policy")

    def loss(weights):
        mixed = weights @ occupancies
        shared = np.log(mixed + smoothing)
        return mixed @ shared, occupancies @ (shared + mixed / (mixed + smoothing))

    solved = optimize.minimize(
        loss,
        uniform_weights(n) if start is None else start,
        jac=True,
        bounds=[(0, 1)] * n,
        constraints={"type": "eq", "fun": lambda x: x.sum() - 1, "jac": np.ones_like},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 1000},
    )
    weights = np.maximum(solved.x, 0)
    return weights / weights.sum()


def project_to_simplex(values: np.ndarray) -> np.ndarray:
    """Projects `values` [n] on the simplex: the nearest point [n] with entries >= 0 and sum 1.

    Source: Duchi et al. 2008, Fig. 1.
    """
    descending = np.sort(values)[::-1]
    excess = (np.cumsum(descending) - 1) / np.arange(1, len(values) + 1)
    threshold = excess[np.flatnonzero(descending > excess)[-1]]
    return np.maximum(values - threshold, 0)


def last_weights(n: int) -> np.ndarray:
    """Returns [n] float64 weights: 1 for the newest policy, 0 for the others.

    Raises:
      ValueError: n < 1.
    """
    _check_count(n)
    return np.eye(n)[-1]


def weight_table(kind: str, capacity: int, eta: float) -> np.ndarray:
    """Returns [P, P] float32 weights: row n - 1 for a mixture of n policies, 0 in the other slots.

    It is computed once on the host in float64, so that the scan needs no projection of dynamic
    size. Fully corrective weights depend on the visited states; they start from equal weights.
    """
    makers = {"geometric": lambda n: geometric_weights(n, eta), "last": last_weights}
    make = makers.get(kind, uniform_weights)
    table = np.zeros((capacity, capacity))
    for n in range(1, capacity + 1):
        table[n - 1, :n] = make(n)
    return table.astype(np.float32)


def most_entropic_weights(occupancies: jax.Array, weights: jax.Array) -> jax.Array:
    """Fully corrective weights within a jitted program: those of the largest entropy of Σ w_i d_i.

    Each round multiplies w_i by exp(-Σ d_i log Σ w_j d_j) and normalises. This is Blahut and
    Arimoto's algorithm, here for a channel whose inputs also earn their own entropy, so the entropy
    never falls. After n rounds it is within log(1/min w)/n of the largest.

    Args:
      occupancies: [P, S] >= 0 over S cells, of sum 1 where the slot holds a policy.
      weights: [P] initial weights, 0 for an empty slot.
    Returns:
      [P] of sum 1.
    Source: Arimoto 1972; Blahut 1972.
    """

    def improve(weights, _):
        mixed = weights @ occupancies
        gain = -occupancies @ jnp.log(jnp.maximum(mixed, 1e-30))
        raised = weights * jnp.exp(gain - jnp.max(jnp.where(weights > 0, gain, -jnp.inf)))
        return raised / jnp.sum(raised), None

    return jax.lax.scan(improve, weights, length=CORRECTIVE_ROUNDS)[0]


def _check_count(n: int) -> None:
    if check_whole("n", n) < 1:
        raise ValueError(f"a mixture needs at least 1 policy, not {n}")
