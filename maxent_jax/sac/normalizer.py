"""Running mean and deviation of what the networks see."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

LARGEST = 10.0  # deviations; a state far from all that were seen is cut off there
SMALLEST_VARIANCE = 1e-4


class Normalizer(NamedTuple):
    """Moments of all inputs seen so far; none yet: inputs pass unchanged."""

    number: jax.Array  # [] float32, of inputs
    mean: jax.Array  # [I]
    variance: jax.Array  # [I]


def init(size: int) -> Normalizer:
    """Nothing seen."""
    return Normalizer(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def add(normalizer: Normalizer, inputs: jax.Array, counts: jax.Array) -> Normalizer:
    """With the inputs [N, I] that count, [N] bool.

    Source: Chan, Golub and LeVeque 1979.
    """
    chosen = counts[:, None]
    new = jnp.sum(counts, dtype=jnp.float32)
    mean = jnp.sum(inputs, axis=0, where=chosen) / jnp.maximum(new, 1.0)
    squares = jnp.sum((inputs - mean[None]) ** 2, axis=0, where=chosen)
    known, total = normalizer.number, normalizer.number + new
    gap, share = mean - normalizer.mean, new / jnp.maximum(total, 1.0)
    pooled = (normalizer.variance * known + squares) / jnp.maximum(total, 1.0)
    moved = Normalizer(
        number=total,
        mean=normalizer.mean + share * gap,
        variance=pooled + (1 - share) * share * gap**2,
    )
    return jax.tree.map(lambda new, old: jnp.where(total > 0, new, old), moved, normalizer)


def apply(normalizer: Normalizer, inputs: jax.Array) -> jax.Array:
    """[..., I] with mean 0 and deviation 1 over what was seen."""
    deviation = jnp.sqrt(jnp.maximum(normalizer.variance, SMALLEST_VARIANCE))
    mean, deviation = (jnp.broadcast_to(x, inputs.shape) for x in (normalizer.mean, deviation))
    return jnp.clip((inputs - mean) / deviation, -LARGEST, LARGEST)
