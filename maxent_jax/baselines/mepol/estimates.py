"""MEPOL's estimates for a policy that has not played: entropy and KL from another's particles.

A particle is a state of a batch. Its importance weight says how likely the new policy would have
reached it. Every estimate is computed from the weights around each particle.

Source: Mutti, Pratissoli & Restelli 2021, arXiv 2007.04640; Ajgl & Šimandl 2011 for the estimators.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import digamma

from maxent_jax.density.entropy import log_density

QUERIES_AT_ONCE = 256  # rows of the distance matrix that are in memory at a time
MIN_VOLUME = 1e-15  # of a neighbourhood, if particles coincide; the official MountainCar's eps


class Particles(NamedTuple):
    """The R = T·E states of E episodes and their neighbourhoods; fixed while policies are tried."""

    alive: jax.Array  # [T, E] bool: reached before the episode's end; the others do not count
    neighbors: jax.Array  # [R, k] int32, the particle and then its k - 1 nearest others
    log_volume: jax.Array  # [R] of the ball that reaches the particle's k-th nearest other


def particles(features: jax.Array, alive: jax.Array, k: int) -> Particles:
    """Finds the neighbourhoods of the states of a batch.

    Args:
      features: [T, E, F] of the states.
      alive: [T, E] bool, more than k of them true.
      k: the ball reaches the k-th neighbour.
    Returns:
      The particles, R = T·E.
    Raises:
      ValueError: R <= k.
    Source: the official code. The k particles of a ball include its centre, but not the one on its
    edge.
    """
    dims = features.shape[-1]
    distance, others = nearest(features.reshape(-1, dims), alive.reshape(-1), k)
    own = jnp.arange(len(others), dtype=jnp.int32)
    log_volume = -log_density(distance[:, -1], num_points=1, k=1, dims=dims)
    return Particles(
        alive=alive,
        neighbors=jnp.concatenate([own[:, None], others[:, :-1]], axis=1),
        log_volume=jnp.maximum(log_volume, jnp.log(MIN_VOLUME)),
    )


def nearest(points: jax.Array, alive: jax.Array, k: int) -> tuple[jax.Array, jax.Array]:
    """Finds the k nearest others of each point.

    The search is exact, by direct differences. Memory grows with R.

    Args:
      points: [R, F] points.
      alive: [R] bool; a point that is not alive is no neighbour.
      k: number of neighbours.
    Returns:
      Distances and rows [R, k], in ascending order; a missing neighbour has distance inf.
    Raises:
      ValueError: R <= k.
    """
    num_points = len(points)
    if num_points <= k:
        raise ValueError(f"{num_points} particles are too few for {k} neighbours")
    rows = jnp.arange(num_points, dtype=jnp.int32)
    there = jnp.where(alive[:, None], points, jnp.inf).T

    def search(query):
        row, point = query
        squared = sum((there[f] - point[f]) ** 2 for f in range(len(point)))
        return jax.lax.top_k(-jnp.where(rows == row, jnp.inf, squared), k)

    negative, found = jax.lax.map(search, (rows, points), batch_size=QUERIES_AT_ONCE)
    return jnp.sqrt(-negative), found


def log_weights(log_ratio: jax.Array, alive: jax.Array) -> jax.Array:
    """Returns the logarithms of the particles' normalised importance weights.

    The probability of a state is that of all actions of its episode up to it.

    Args:
      log_ratio: [T, E] log π'(a|s) - log π(a|s) of the action that led to each state.
      alive: [T, E] bool, as in Particles.
    Returns:
      [R] nats; -inf where not alive.
    """
    upto = jnp.cumsum(jnp.where(alive, log_ratio, 0.0), axis=0)
    return jax.nn.log_softmax(jnp.where(alive, upto, -jnp.inf).reshape(-1))


def entropy(particles: Particles, log_weight: jax.Array) -> jax.Array:
    """Estimates the differential entropy of the new policy's states, [] nats; differentiable.

    -Σ_i (W_i / k) log(W_i / V_i) + log k - ψ(k), with W_i the weight of the k particles in the ball
    around particle i and V_i its volume. With equal weights this is density.entropy.knn_entropy
    with N in place of N - 1.

    Args:
      log_weight: [R] from `log_weights`.
    """
    k = particles.neighbors.shape[1]
    alive = particles.alive.reshape(-1)
    log_mass = _log_mass(particles, log_weight)
    terms = jnp.exp(log_mass) / k * (particles.log_volume - log_mass)
    return jnp.sum(jnp.where(alive, terms, 0.0)) + jnp.log(k) - digamma(k)


def kl(particles: Particles, log_weight: jax.Array) -> jax.Array:
    """Estimates KL(d_π ‖ d_π') from the policy that played to the new one, [] nats.

    This is the mean over the N particles of log(k / (N W_i)), or 0 if that is negative.

    Args:
      log_weight: [R] from `log_weights`.
    """
    k = particles.neighbors.shape[1]
    alive = particles.alive.reshape(-1)
    num_alive = jnp.sum(alive)
    terms = jnp.log(k) - jnp.log(num_alive) - _log_mass(particles, log_weight)
    return jnp.maximum(jnp.sum(jnp.where(alive, terms, 0.0)) / num_alive, 0.0)


def _log_mass(particles: Particles, log_weight: jax.Array) -> jax.Array:
    """[R] log W_i, 0 where not alive; float32 cannot hold the ratio itself for 1,000 actions."""
    around = log_weight[particles.neighbors]
    alive = particles.alive.reshape(-1, 1)
    return jax.nn.logsumexp(jnp.where(alive, around, -jnp.log(around.shape[1])), axis=1)
