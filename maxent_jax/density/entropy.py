"""Density and entropy from the k nearest neighbours (Eq. 6 and 9), in nats."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import digamma, gammaln

from maxent_jax.checks import check_whole
from maxent_jax.density.knn import knn_distances


def log_density(distance: jax.Array, num_points: jax.Array | int, k: int, dims: int) -> jax.Array:
    """Returns log(k Γ(p/2 + 1) / (N π^(p/2) R^p)): k of N points lie in a ball of radius R.

    Args:
      distance: [...] R, to the k-th nearest point.
      num_points: [] or [...] N, the points that could have been neighbours.
      k: which neighbour R belongs to.
      dims: p.
    Returns:
      [...] nats; inf where R is 0.
    Source: Eq. 9.
    """
    log_volume = 0.5 * dims * jnp.log(jnp.pi) - gammaln(0.5 * dims + 1) + dims * jnp.log(distance)
    return jnp.log(k) - jnp.log(num_points) - log_volume


def knn_density(
    queries: jax.Array, points: jax.Array, k: int, exclude: jax.Array | None = None
) -> jax.Array:
    """Returns the density at each query, [B, F] -> [B], per unit of volume.

    A query that excludes a point has one neighbour fewer to find: N - 1.

    Args: as `knn_distances`.
    Source: Eq. 9.
    """
    distance = knn_distances(queries, points, k, exclude)[:, -1]
    num_points, dims = np.shape(points)
    return jnp.exp(log_density(distance, num_others(num_points, exclude), k, dims))


def num_others(num_points: int, exclude: jax.Array | None) -> jax.Array:
    """Returns how many of N points can be neighbours of each query, [] or [B] float32.

    Args:
      num_points: N.
      exclude: [B] int, the point that a query ignores, -1 for none; None: no query ignores one.
    """
    others = jnp.asarray(num_points, jnp.float32)
    return others if exclude is None else others - (jnp.asarray(exclude) >= 0)


def knn_entropy(samples: jax.Array, k: int, count: jax.Array | None = None) -> jax.Array:
    """Estimates the differential entropy of the distribution that samples come from.

    Args:
      samples: [N, F]. Each is measured against the others. They must be distinct draws, because
        copies of a draw bias the estimate.
      k: which neighbour.
      count: [] int32, how many of the samples count, from the first; all of them if None.
    Returns:
      [] nats; -inf where k or more samples coincide with another one; NaN if count <= k.
    Raises:
      ValueError: N <= k, or as `knn_distances`.
      TypeError: as `knn_distances`.
    Source: Eq. 6, with its bias correction log k - ψ(k) (Kozachenko & Leonenko 1987).
    """
    check_whole("k", k)
    if np.ndim(samples) != 2:
        raise ValueError(f"samples have shape {np.shape(samples)}, but must be [N, F]")
    num_samples, dims = np.shape(samples)
    if num_samples <= k:
        raise ValueError(f"{num_samples} samples are too few for {k} neighbours")
    own = jnp.arange(num_samples, dtype=jnp.int32)
    counted = num_samples if count is None else count
    distance = knn_distances(samples, samples, k, exclude=own, count=count)[:, -1]
    surprise = -log_density(distance, counted - 1, k, dims)
    mean = jnp.sum(jnp.where(own < counted, surprise, 0.0)) / counted
    return jnp.where(counted > k, mean + jnp.log(k) - digamma(k), jnp.nan)
