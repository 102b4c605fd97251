"""The three losses of soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Batch(NamedTuple):
    """Transitions for one update."""

    observation: jax.Array  # [B, D]
    action: jax.Array  # [B, A], in [-1, 1]
    reward: jax.Array  # [B], or the discounted sum of n rewards
    next_observation: jax.Array  # [B, D]
    discount: jax.Array  # [B] 0 at a terminal state, else γ^(n-1); a time limit is not terminal


def sample_action(mean: jax.Array, log_std: jax.Array, key: jax.Array):
    """Draws an action from a tanh-squashed Gaussian.

    Args:
      mean: [..., A] before the tanh.
      log_std: [..., A] before the tanh.
      key: draws the action.
    Returns:
      The action [..., A] and its log-probability [...], in nats.
    Source: Eq. 26.
    """
    noise = jax.random.normal(key, mean.shape)
    raw = mean + jnp.exp(log_std) * noise
    log_gaussian = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    # log(1 - tanh(x)^2), in a form that stays finite for large x
    log_slope = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))
    return jnp.tanh(raw), jnp.sum(log_gaussian - log_slope, axis=-1)


def critic_loss(values: jax.Array, target: jax.Array) -> jax.Array:
    """Returns the mean squared error of the critics, summed over them.

    Args:
      values: [B, 2].
      target: [B].
    Returns:
      [] the loss.
    Source: Eq. 5.
    """
    return jnp.mean(jnp.sum((values - target[:, None]) ** 2, axis=-1))


def bellman_target(batch: Batch, next_value: jax.Array, discount: float) -> jax.Array:
    """Returns r + γ V(s') with V = min Q - α log π, without V after a terminal state, [B] -> [B].

    With n steps, r is their discounted sum, s' the last state, and V has a further factor γ^(n-1).

    Source: Eq. 2 and 3.
    """
    return batch.reward + discount * batch.discount * next_value


def actor_loss(log_prob: jax.Array, values: jax.Array, temperature: jax.Array) -> jax.Array:
    """Returns the mean of α log π - min Q.

    Args:
      log_prob: [B] log π, nats.
      values: [B, 2] Q of both critics.
      temperature: [] α.
    Returns:
      [] the loss.
    Source: Eq. 7.
    """
    return jnp.mean(temperature * log_prob - jnp.min(values, axis=-1))


def temperature_loss(
    log_temperature: jax.Array, log_prob: jax.Array, target_entropy: float
) -> jax.Array:
    """Returns a loss that lowers α while the policy's entropy is above its target.

    Args:
      log_temperature: [] log α, which is what is learned.
      log_prob: [B] log π, nats.
      target_entropy: nats.
    Returns:
      [] the loss.
    Source: Eq. 18.
    """
    return -jnp.exp(log_temperature) * jnp.mean(jax.lax.stop_gradient(log_prob) + target_entropy)
