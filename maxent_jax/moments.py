"""Running mean and variance, batch by batch."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

# Weight of the initial mean 0 and variance 1, as in the code of RND and in URLB.
PRIOR_WEIGHT = 1e-4
SMALLEST_DEVIATION = 1e-2


class Moments(NamedTuple):
    """Mean and variance of all values seen so far."""

    mean: jax.Array  # [...]
    variance: jax.Array  # [...] mean squared deviation
    weight: jax.Array  # [] float32, how many values were seen


def init(shape: tuple[int, ...] = ()) -> Moments:
    """Returns mean 0 and variance 1, [*shape]; the first batch replaces them."""
    return Moments(jnp.zeros(shape), jnp.ones(shape), jnp.asarray(PRIOR_WEIGHT, jnp.float32))


def update(moments: Moments, batch: jax.Array, valid: jax.Array | None = None) -> Moments:
    """Merges a batch into the moments.

    Args:
      moments: [...].
      batch: [B, ...].
      valid: [B] bool, the rows that count; all of them when left out.
    Returns:
      The moments [...] of all values so far.
    Source: Chan, Golub & LeVeque 1979, the pairwise update of sums of squares.
    """
    valid = jnp.ones(batch.shape[0], bool) if valid is None else valid
    rows = valid.reshape(-1, *[1] * (batch.ndim - 1))
    weight = jnp.sum(valid, dtype=jnp.float32)
    mean = jnp.sum(jnp.where(rows, batch, 0.0), axis=0) / jnp.maximum(weight, 1.0)
    deviation = jnp.where(rows, batch - mean[None], 0.0)
    variance = jnp.sum(deviation**2, axis=0) / jnp.maximum(weight, 1.0)

    share = weight / (moments.weight + weight)
    change = mean - moments.mean
    spread = (1 - share) * moments.variance + share * variance
    return Moments(
        mean=moments.mean + share * change,
        variance=spread + share * (1 - share) * change**2,
        weight=moments.weight + weight,
    )


def normalized(moments: Moments, values: jax.Array, largest: float) -> jax.Array:
    """Normalises values [..., *S] to mean 0 and deviation 1, and clips them to ± largest.

    A deviation below SMALLEST_DEVIATION is raised to it, so that a nearly constant value is not
    magnified.

    Args:
      moments: [*S], of the values seen so far.
      values: [..., *S].
      largest: the largest magnitude of a result.
    """
    deviation = jnp.maximum(jnp.sqrt(moments.variance), SMALLEST_DEVIATION)
    mean, deviation = (jnp.broadcast_to(x, values.shape) for x in (moments.mean, deviation))
    return jnp.clip((values - mean) / deviation, -largest, largest)
