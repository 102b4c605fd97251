"""The three losses of soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Batch(NamedTuple):
    """What one update learns from."""

    observation: jax.Array  # [B, D]
    action: jax.Array  # [B, A], in [-1, 1]
    reward: jax.Array  # [B], or the discounted sum of n
    next_observation: jax.Array  # [B, D]
    discount: jax.Array  # [B] 0 at a terminal state, else γ^(n-1); a time limit is not terminal


def sample_action(mean: jax.Array, log_std: jax.Array, key: jax.Array):
    """A tanh-squashed Gaussian action [..., A] and its log-probability [...], nats (Eq. 26)."""
    noise = jax.random.normal(key, mean.shape)
    raw = mean + jnp.exp(log_std) * noise
    log_gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    # log(1 - tanh(x)^2), in a form that stays finite for large x
    log_slope = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))
    return jnp.tanh(raw), jnp.sum(log_gaussian - log_slope, axis=-1)


def critic_loss(values: jax.Array, target: jax.Array) -> jax.Array:
    """Sum over the critics [B, 2] of the mean squared error from the target [B] (Eq. 5)."""
    return jnp.mean(jnp.sum((values - target[:, None]) ** 2, axis=-1))


def bellman_target(batch: Batch, next_value: jax.Array, discount: float) -> jax.Array:
    """r + γ V(s'), V = min Q - α log π, and no V beyond a terminal state (Eq. 2 and 3).

    With n steps, r is their discounted sum, s' the last state, and the discount γ^(n-1) more.
    """
    return batch.reward + discount * batch.discount * next_value


def actor_loss(log_prob: jax.Array, values: jax.Array, temperature: jax.Array) -> jax.Array:
    """mean of α log π - min Q (Eq. 7)."""
    return jnp.mean(temperature * log_prob - jnp.min(values, axis=-1))


def temperature_loss(
    log_temperature: jax.Array, log_prob: jax.Array, target_entropy: float
) -> jax.Array:
    """α falls while the policy's entropy is above its target (Eq. 18), learned as log α."""
    return -jnp.exp(log_temperature) * jnp.mean(jax.lax.stop_gradient(log_prob) + target_entropy)
