"""What MEPOL knows of a policy that it has not played: entropy and KL from another's particles.

A particle is a state of a batch. The policy that is asked about gives it the weight with which it
would have reached it, and every estimate is made of the weights around each particle.

Source: Mutti, Pratissoli & Restelli 2021, arXiv 2007.04640; Ajgl & Šimandl 2011 for the estimators.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import digamma

from maxent_jax.density.entropy import log_density

QUERIES_AT_ONCE = 256  # rows of the distance matrix that exist at a time
MIN_VOLUME = 1e-15  # of a neighbourhood, where particles coincide; the official MountainCar's eps


class Particles(NamedTuple):
    """The R = T·E states of E episodes and their neighbourhoods; fixed while policies are tried."""

    alive: jax.Array  # [T, E] bool: reached before its episode's end, else nothing counts it
    neighbors: jax.Array  # [R, k] int32, itself and then its k - 1 nearest others
    log_volume: jax.Array  # [R] of the ball that reaches its k-th nearest other


def particles(features: jax.Array, alive: jax.Array, k: int) -> Particles:
    """The states of a batch with their neighbourhoods.

    Args:
      features: [T, E, F].
      alive: [T, E] bool, with more than k true.
      k: which neighbour the ball reaches.
    Raises:
      ValueError: R <= k.
    Source: the official code. Of the k particles of a ball one is its centre; that on its edge is
    not among them.
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
    """The k nearest others of each point, ascending: distances and rows, [R, k] each.

    Exact, by direct differences. Memory grows with R.

    Args:
      points: [R, F].
      alive: [R] bool; a point that is not alive is nobody's neighbour.
      k: neighbours wanted; where there are fewer, the distance is inf.
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
    """Normalised importance weights of the particles, [R] nats; -inf where not alive.

    The probability of a state is that of all actions of its episode up to it.

    Args:
      log_ratio: [T, E] log π'(a|s) - log π(a|s) of the action that led to each state.
      alive: [T, E] bool.
    """
    upto = jnp.cumsum(jnp.where(alive, log_ratio, 0.0), axis=0)
    return jax.nn.log_softmax(jnp.where(alive, upto, -jnp.inf).reshape(-1))


def entropy(particles: Particles, log_weight: jax.Array) -> jax.Array:
    """Differential entropy of the weighted policy's states, [] nats; differentiable in the weights.

    -Σ_i (W_i / k) log(W_i / V_i) + log k - ψ(k), with W_i the weight of the k particles in the ball
    around particle i and V_i its volume. With equal weights it is density.entropy.knn_entropy with
    N in the place of N - 1.

    Args:
      log_weight: [R] of log_weights.
    """
    k = particles.neighbors.shape[1]
    alive = particles.alive.reshape(-1)
    log_mass = _log_mass(particles, log_weight)
    terms = jnp.exp(log_mass) / k * (particles.log_volume - log_mass)
    return jnp.sum(jnp.where(alive, terms, 0.0)) + jnp.log(k) - digamma(k)


def kl(particles: Particles, log_weight: jax.Array) -> jax.Array:
    """KL(d_π ‖ d_π'), of the policy that played and the weighted one, [] nats.

    The mean over the N particles of log(k / (N W_i)), and 0 where that is negative.

    Args:
      log_weight: [R] of log_weights.
    """
    k = particles.neighbors.shape[1]
    alive = particles.alive.reshape(-1)
    num_alive = jnp.sum(alive)
    terms = jnp.log(k) - jnp.log(num_alive) - _log_mass(particles, log_weight)
    return jnp.maximum(jnp.sum(jnp.where(alive, terms, 0.0)) / num_alive, 0.0)


def _log_mass(particles: Particles, log_weight: jax.Array) -> jax.Array:
    """[R] log W_i, 0 where not alive. In logarithms: float32 holds no ratio of 1,000 actions."""
    around = log_weight[particles.neighbors]
    alive = particles.alive.reshape(-1, 1)
    return jax.nn.logsumexp(jnp.where(alive, around, -jnp.log(around.shape[1])), axis=1)
