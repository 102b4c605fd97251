"""Rewards from R, the distance to the k-th nearest reference state."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.checks import check_number, check_whole
from maxent_jax.density.entropy import log_density, num_others
from maxent_jax.density.knn import knn_distances, smallest_k

# Logarithmic forms stop falling below this distance (feature units), or a duplicate would be -inf.
# Two states of one episode, a control step apart, are about a hundred times farther apart.
DISTANCE_FLOOR = 1e-3


def _log1p(distance, scale, dims):
    del dims
    return jnp.log1p(distance / scale)


def _linear(distance, scale, dims):
    del dims
    return distance / scale


def _log(distance, scale, dims):
    del dims
    return jnp.log(jnp.maximum(distance, DISTANCE_FLOOR) / scale)


def _paper(distance, scale, dims):
    del scale
    return dims * jnp.log(jnp.maximum(distance, DISTANCE_FLOOR))


FORMS: dict[str, Callable[..., jax.Array]] = {
    "log1p": _log1p,  # log(1 + R/c): never negative, bounded at duplicates
    "linear": _linear,  # R/c
    "log": _log,  # log(R/c), floored
    "paper": _paper,  # p log R (Eq. 7), floored
}


def of_distance(distance: jax.Array, form: str, scale: float, dims: int) -> jax.Array:
    """Returns the reward of a state at distance R, [...] -> [...], dimensionless.

    Args:
      distance: [...] R, in feature units. Infinity is replaced by about the largest float32 for
        which R/c is also finite, so that no reward is infinite.
      form: one of FORMS.
      scale: c, in feature units.
      dims: p, the number of features.
    """
    largest = 0.5 * jnp.finfo(jnp.float32).max * jnp.minimum(scale, 1.0)  # half, since c is rounded
    return FORMS[form](jnp.minimum(distance, largest), scale, dims)


def knn_reward(
    features: jax.Array,
    reference: jax.Array,
    num_neighbors: int,
    scale: float = 1.0,
    form: str = "log1p",
    exclude: jax.Array | None = None,
    count: jax.Array | int | None = None,
) -> jax.Array:
    """Returns the particle reward: how far a state is from those that the mixture visits.

    Args:
      features: [B, F] states to reward, in feature units (metres for the first two).
      reference: [M, F] states drawn from the mixture, fixed between refreshes of the reward.
      num_neighbors: k.
      scale: c, in feature units.
      form: one of FORMS.
      exclude: [B] int, as in `knn_distances`.
      count: [] int, as in `knn_distances`.
    Returns:
      [B] dimensionless; log(1 + R/c) by default, at least 0.
    Raises:
      ValueError: M < k, an unknown form, or a scale that is not positive.
      TypeError: the scale is not a number, or as `knn_distances`.
    Source: Eq. 7; Liu & Abbeel 2021, Eq. 5. `log1p` departs from both in the 1 +, see
    docs/decisions.md, decision 2.
    """
    if form not in FORMS:
        raise ValueError(f"unknown reward form '{form}': choose one of {', '.join(FORMS)}")
    if not isinstance(scale, jax.core.Tracer) and not 0 < check_number("scale", scale) < jnp.inf:
        raise ValueError(f"scale is {scale}, but must be a positive number")
    distance = knn_distances(features, reference, num_neighbors, exclude, count)[:, -1]
    return of_distance(distance, form, scale, np.shape(features)[1])


def hazan_reward(
    features: jax.Array,
    reference: jax.Array,
    num_neighbors: int,
    exclude: jax.Array | None = None,
) -> jax.Array:
    """Returns the gradient of the entropy at each state, log(1/density) - 1, [B] nats.

    By Prop. 1 it is p log R + log(N π^(p/2) / (k Γ(p/2 + 1))) - 1. It is inf where a state has
    fewer than k neighbours.

    Args: as `knn_reward`.
    Source: Eq. 10.
    """
    return -_floored_log_density(features, reference, num_neighbors, exclude) - 1


def renyi_reward(
    features: jax.Array,
    reference: jax.Array,
    num_neighbors: int,
    alpha: float,
    exclude: jax.Array | None = None,
) -> jax.Array:
    """Returns (α - 1) log p at each state, [B] nats: high where states are rare.

    Its exponential, p^(α - 1), is the gradient of ∫ p^α up to the factor α, and Rényi's entropy is
    log(∫ p^α) / (1 - α). The smaller α, the more rare states count.

    Args: as `knn_reward`, and
      alpha: the order, in (0, 1); at 1 the entropy is Shannon's and this form is 0.
    Raises:
      ValueError: M < k, or alpha outside (0, 1).
      TypeError: alpha is not a number, or as `knn_distances`.
    Source: Yuan et al. 2022 (RISE), whose R^(1 - α) leaves out the exponent p.
    """
    if not 0 < check_number("alpha", alpha) < 1:
        raise ValueError(f"alpha is {alpha}, but must lie between 0 and 1")
    return (alpha - 1) * _floored_log_density(features, reference, num_neighbors, exclude)


def _floored_log_density(features, reference, num_neighbors, exclude):
    """[B] nats, finite also where a state is in the reference."""
    distance = knn_distances(features, reference, num_neighbors, exclude)[:, -1]
    num_points, dims = np.shape(reference)
    others = num_others(num_points, exclude)
    return floored_log_density(distance, others, num_neighbors, dims)


def floored_log_density(
    distance: jax.Array, num_points: jax.Array | int, num_neighbors: int, dims: int
) -> jax.Array:
    """Returns log_density at a distance of at least DISTANCE_FLOOR, so that it is finite.

    Args: as `density.entropy.log_density`.
    """
    distance = jnp.maximum(distance, DISTANCE_FLOOR)
    return log_density(distance, num_points, num_neighbors, dims)


def shaped(
    reward: jax.Array,
    potential: jax.Array,
    next_potential: jax.Array,
    discount: float,
    alive: jax.Array,
    survives_death: bool,
) -> jax.Array:
    """Adds potential-based shaping to a reward: r + γΦ(s') - Φ(s).

    With Φ = 0 at terminal states this is policy-invariant: the optimal policies are those of r.

    Args:
      reward: [...] r.
      potential: [...] Φ(s).
      next_potential: [...] Φ(s').
      discount: γ.
      alive: [...] 0 where health failed at s', else 1; a time limit keeps its potential.
      survives_death: also keep Φ where health failed, so that dying far out does not cost what
        was gained on the way. The shaping is then not policy-invariant.
    Returns:
      [...] the shaped reward.
    Source: Ng et al. 1999.
    """
    kept = jnp.ones_like(alive) if survives_death else alive
    return reward + discount * kept * next_potential - potential


def episodic_bonus(
    features: jax.Array, earlier: jax.Array, count: jax.Array, num_neighbors: int
) -> jax.Array:
    """Returns how new each state is within its own episode.

    Args:
      features: [..., F] states.
      earlier: [..., L, F] the earlier states of its episode; the first `count` are filled.
      count: [...] int.
      num_neighbors: k.
    Returns:
      [...] the sum of the distances to the k nearest, in feature units. With fewer than k
        earlier states it is k times their mean distance; with none it is 0.
    Raises:
      ValueError: k < 1, or the shapes do not match.
    Source: the paper's appendix; Badia et al. 2020 (NGU).
    """
    check_whole("num_neighbors", num_neighbors, least=1)
    lead, dims = features.shape[:-1], features.shape[-1:]
    if (*earlier.shape[:-2], *earlier.shape[-1:], *count.shape) != (*lead, *dims, *lead):
        raise ValueError(
            f"features have shape {features.shape}, earlier {earlier.shape} and count "
            f"{count.shape}, but must be [..., F], [..., L, F] and [...]"
        )
    squared = jnp.sum((earlier - features[..., None, :]) ** 2, axis=-1)
    filled = jax.lax.broadcasted_iota(jnp.int32, squared.shape, squared.ndim - 1) < count[..., None]
    nearest = jnp.sqrt(smallest_k(jnp.where(filled, squared, jnp.inf), num_neighbors))
    available = jnp.minimum(count, num_neighbors)
    total = jnp.sum(jnp.where(jnp.isfinite(nearest), nearest, 0.0), axis=-1)
    return total * num_neighbors / jnp.maximum(available, 1)
