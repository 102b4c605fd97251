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
    return _rows_at(weights, ticks)


def draw_rows(weights: jax.Array, num: int, key: jax.Array, num_episodes: int = 1) -> jax.Array:
    """Draws rows in proportion to their weights, by systematic sampling along each episode.

    Args:
      weights: [R] >= 0 of T·E states, step by step; they need not sum to 1.
      num: n, how many rows.
      key: typed.
      num_episodes: E.
    Returns:
      [n] int32. A row repeats only if its share of the draw exceeds one. The number of rows from an
      episode differs from its share by less than one.
    """
    ticks = (jnp.arange(num) + jax.random.uniform(key)) / num
    return _rows_by_episode(weights, ticks, num_episodes)


def draw_distinct(
    weights: jax.Array, num: int, key: jax.Array, num_episodes: int = 1
) -> tuple[jax.Array, jax.Array]:
    """Draws as many rows as `draw_rows` can without repeating one, at most `num`.

    Args: as `draw_rows`.
    Returns:
      Rows [n] int32, and how many of them count, from the first: [] int32.
    """
    largest_share = jnp.max(weights) / jnp.sum(weights)
    count = jnp.clip(jnp.floor(1.0 / largest_share), 1, num)
    ticks = (jnp.arange(num) + jax.random.uniform(key)) / count
    return _rows_by_episode(weights, ticks, num_episodes), count.astype(jnp.int32)


def _rows_by_episode(weights: jax.Array, ticks: jax.Array, num_episodes: int) -> jax.Array:
    # Step by step, ticks at equal distances could meet the same episodes at every step.
    num_steps = weights.shape[0] // num_episodes
    drawn = _rows_at(weights.reshape(num_steps, num_episodes).T.reshape(-1), ticks)
    return drawn % num_steps * num_episodes + drawn // num_steps


def _rows_at(weights: jax.Array, ticks: jax.Array) -> jax.Array:
    """The rows [n] int32 at the ticks [n], which are shares of the sum of the weights.

    A tick of 1 or more gives the last row that has weight.
    """
    # A parallel sum rounds each prefix separately. Without the running maximum it could fall, or
    # rise at a row of weight 0.
    cumulative = jax.lax.cummax(jnp.where(weights > 0, jnp.cumsum(weights), 0.0))
    row = jnp.searchsorted(cumulative, ticks * cumulative[-1], side="right")
    # Rounding may push the last tick past the end: it then belongs to the last row with weight.
    last = weights.shape[0] - 1 - jnp.argmax(weights[::-1] > 0)
    return jnp.minimum(row, last).astype(jnp.int32)
