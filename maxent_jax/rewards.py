"""Rewards from distances to the reference states. R is the distance to the k-th nearest."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from maxent_jax.checks import check_number, check_whole
from maxent_jax.density.entropy import log_density
from maxent_jax.density.knn import knn_distances, smallest_k

# Below this distance, in feature units, the logarithmic forms stop falling: a duplicate would be
# -inf. Two states of one episode, a control step apart, lie about a hundred times farther.
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
    """The reward of a state at distance R, [...] -> [...], dimensionless.

    Args:
      distance: R, feature units; inf counts as about the largest float32 whose R/c is one too, so
        that no reward is infinite.
      form: one of FORMS.
      scale: c, feature units.
      dims: p, the number of features.
    """
    largest = 0.5 * jnp.finfo(jnp.float32).max * jnp.minimum(scale, 1.0)  # half: c rounds
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
    """Particle reward: how far a state lies from the states that the mixture already visits.

    Args:
      features: [B, F] states to reward, in feature units (metres for the first two).
      reference: [M, F] states drawn from the mixture, fixed while the reward is.
      num_neighbors: k.
      scale: c, feature units.
      form: one of FORMS.
      exclude, count: as in knn_distances.
    Returns:
      [B] dimensionless; log(1 + R/c) by default, at least 0.
    Raises:
      ValueError: M < k, an unknown form, or a scale that is not positive.
    Source: Eq. 7; Liu & Abbeel 2021, Eq. 5. `log1p` departs from both in the 1 +.
    """
    if form not in FORMS:
        raise ValueError(f"unknown reward form '{form}': choose one of {', '.join(FORMS)}")
    if not isinstance(scale, jax.core.Tracer) and not 0 < check_number("scale", scale) < jnp.inf:
        raise ValueError(f"scale is {scale}, but must be a positive number")
    distance = knn_distances(features, reference, num_neighbors, exclude, count)[:, -1]
    return of_distance(distance, form, scale, jnp.shape(features)[1])


def hazan_reward(
    features: jax.Array,
    reference: jax.Array,
    num_neighbors: int,
    exclude: jax.Array | None = None,
) -> jax.Array:
    """The gradient of the entropy at a state, log(1/density) - 1, [B, F] -> [B] nats.

    By Prop. 1 it is an affine map, of slope 1, of p log R: intercept
    log(N π^(p/2) / (k Γ(p/2 + 1))) - 1. Arguments as in knn_reward. Source: Eq. 10.
    """
    return -_floored_log_density(features, reference, num_neighbors, exclude) - 1


def renyi_reward(
    features: jax.Array,
    reference: jax.Array,
    num_neighbors: int,
    alpha: float,
    exclude: jax.Array | None = None,
) -> jax.Array:
    """(α - 1) log p at a state, [B, F] -> [B] nats: high where few states are, if α < 1.

    Up to the factor α its exponential, p^(α - 1), is the gradient of ∫ p^α, whose logarithm over
    1 - α is Rényi's entropy; the smaller α, the more rare states count.

    Args:
      alpha: the order, in (0, 1); at 1 the entropy is Shannon's and this form is 0.
      features, reference, num_neighbors, exclude: as in knn_reward.
    Raises:
      ValueError: M < k, or alpha outside (0, 1).
    Source: Yuan et al. 2022 (RISE), whose R^(1 - α) leaves out the exponent p.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha is {alpha}, but must lie between 0 and 1")
    return (alpha - 1) * _floored_log_density(features, reference, num_neighbors, exclude)


def _floored_log_density(features, reference, num_neighbors, exclude):
    """[B] nats, bounded where a state is also a reference state."""
    num_points = jnp.asarray(reference.shape[0], jnp.float32)
    if exclude is not None:
        num_points = num_points - (exclude >= 0)
    distance = knn_distances(features, reference, num_neighbors, exclude)[:, -1]
    return floored_log_density(distance, num_points, num_neighbors, reference.shape[1])


def floored_log_density(
    distance: jax.Array, num_points: jax.Array | int, num_neighbors: int, dims: int
) -> jax.Array:
    """density.entropy.log_density, bounded where the distance is 0."""
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
    """r + γΦ(s') - Φ(s), all [...] but for γ, `discount`.

    With Φ = 0 at a terminal state the optimal policies are those of r (Ng et al. 1999). With
    `survives_death` a state in which health fails keeps its Φ, so that a death far out does not
    cost what was gained on the way: not policy-invariant.

    Args:
      alive: 0 where health failed at s', else 1; a time limit keeps its potential.
    """
    kept = jnp.ones_like(alive) if survives_death else alive
    return reward + discount * kept * next_potential - potential


def episodic_bonus(
    features: jax.Array, earlier: jax.Array, count: jax.Array, num_neighbors: int
) -> jax.Array:
    """How new a state is within its own episode.

    Args:
      features: [..., F] states.
      earlier: [..., L, F] the states before each in its episode; the first `count` are filled.
      count: [...] int.
      num_neighbors: k.
    Returns:
      [...] the sum of the distances to the k nearest, feature units. With fewer than k earlier
      states it is k times the mean over those there are; 0 with none.
    Raises:
      ValueError: k < 1, or shapes that do not match.
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
