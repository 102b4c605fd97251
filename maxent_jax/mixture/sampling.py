"""Draws from the mixture: the policy that plays each episode, and states by weight."""

import jax
import jax.numpy as jnp


def assign_episodes(weights: jax.Array, num_episodes: int, offset: jax.Array) -> jax.Array:
    """Assigns a policy to each episode by systematic sampling.

    Each policy's number of episodes differs from its share by less than one.

    Args:
      weights: [P], sum 1.
      num_episodes: E.
      offset: [] in [0, 1). With 0.5, equal weights get equal shares; random, the draw is unbiased.
    Returns:
      [E] int32, ascending.
    """
    ticks = (jnp.arange(num_episodes) + offset) / num_episodes
    return _inverse_cumulative(weights, ticks)


def draw_rows(weights: jax.Array, num: int, key: jax.Array) -> jax.Array:
    """Draws rows [num] int32 in proportion to `weights` [R] >= 0, by systematic sampling.

    A row repeats only if its share of the draw exceeds one.
    """
    ticks = (jnp.arange(num) + jax.random.uniform(key)) / num
    return _inverse_cumulative(weights, ticks)


def _inverse_cumulative(weights: jax.Array, ticks: jax.Array) -> jax.Array:
    # A parallel sum rounds each prefix separately. Without the running maximum it could fall, or
    # rise at a row of weight 0.
    cumulative = jax.lax.cummax(jnp.where(weights > 0, jnp.cumsum(weights), 0.0))
    row = jnp.searchsorted(cumulative, ticks * cumulative[-1], side="right")
    # Rounding may push the last tick past the end: it then belongs to the last row with weight.
    last = weights.shape[0] - 1 - jnp.argmax(weights[::-1] > 0)
    return jnp.minimum(row, last).astype(jnp.int32)
