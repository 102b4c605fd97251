"""Draws from the mixture: which policy plays each episode, and which of its states are taken."""

import jax
import jax.numpy as jnp


def assign_episodes(weights: jax.Array, num_episodes: int, offset: jax.Array) -> jax.Array:
    """Which policy plays each episode, by systematic sampling: shares off by less than one episode.

    Args:
      weights: [P] of sum 1.
      num_episodes: E.
      offset: [] in [0, 1): 0.5 gives equal weights equal shares; random makes the draw unbiased.
    Returns:
      [E] int32, ascending.
    """
    ticks = (jnp.arange(num_episodes) + offset) / num_episodes
    return _inverse_cumulative(weights, ticks)


def draw_rows(weights: jax.Array, num: int, key: jax.Array) -> jax.Array:
    """[num] int32: rows drawn in proportion to `weights` [R] >= 0, by systematic sampling.

    A row repeats only where its share of the draw exceeds one.
    """
    ticks = (jnp.arange(num) + jax.random.uniform(key)) / num
    return _inverse_cumulative(weights, ticks)


def _inverse_cumulative(weights: jax.Array, ticks: jax.Array) -> jax.Array:
    # A parallel sum rounds each prefix by itself: without the running maximum it may fall, or rise
    # at a row of weight 0.
    cumulative = jax.lax.cummax(jnp.where(weights > 0, jnp.cumsum(weights), 0.0))
    row = jnp.searchsorted(cumulative, ticks * cumulative[-1], side="right")
    # Rounding may push the last tick past the end; the last row with weight takes it.
    last = weights.shape[0] - 1 - jnp.argmax(weights[::-1] > 0)
    return jnp.minimum(row, last).astype(jnp.int32)
