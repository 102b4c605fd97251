"""Gradient steps of a policy on one batch, while its states stay near those of the batch."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax.baselines.mepol import estimates
from maxent_jax.baselines.mepol.estimates import Particles
from maxent_jax.baselines.mepol.settings import Settings
from maxent_jax.sac.networks import GaussianPolicy

ADAM = optax.scale_by_adam()  # ascend applies the rate, which falls with every refused step


class Batch(NamedTuple):
    """Episodes of the policy that played."""

    inputs: jax.Array  # [T, E, I] of the state in which each action was drawn
    actions: jax.Array  # [T, E, A] as drawn, not clipped
    particles: Particles


class Ascent(NamedTuple):
    """The state of the steps on a batch."""

    policy: Any  # the last one accepted
    gradient: Any  # of its entropy
    entropy: jax.Array  # [] nats, of the states that it would visit
    kl: jax.Array  # [] nats, from the batch's states to its own
    optimizer: Any
    num_accepted: jax.Array  # [] int32
    num_refused: jax.Array  # [] int32
    ended: jax.Array  # [] bool


def ascend(
    module: GaussianPolicy, settings: Settings, policy: Any, optimizer: Any, batch: Batch
) -> tuple[Ascent, jax.Array]:
    """Takes gradient steps on a batch, within the trust region.

    A step that leaves the trust region is refused, and a smaller step from the same policy is
    tried. After a refusal, the first accepted step is the last one. Refused steps enter Adam's
    moments too. The number of attempts is fixed, so that seeds can run in parallel; attempts after
    the end change nothing.

    Args:
      policy: the parameters of the policy that played.
      optimizer: the state of ADAM.
    Returns:
      The last state of the steps, and the entropy [] in nats of the states of the policy that
      played.
    Source: the official code. Algorithm 1 of Mutti et al. 2021 has neither the backtracking nor a
    largest number of steps.
    """
    measure = _measures(module, policy, batch)
    (entropy, kl), gradient = measure(policy)
    zero = jnp.zeros((), jnp.int32)
    # With too few particles nothing can be learned, and Adam must not see the gradient.
    ended = ~jnp.isfinite(entropy)
    begin = Ascent(policy, gradient, entropy, kl, optimizer, zero, zero, ended)

    def attempt(now: Ascent) -> Ascent:
        direction, optimizer = ADAM.update(now.gradient, now.optimizer)
        rate = settings.learning_rate / settings.backtrack_factor**now.num_refused
        tried = jax.tree.map(lambda x, d: x + rate * d, now.policy, direction)
        (entropy, kl), gradient = measure(tried)
        accepted = jnp.isfinite(entropy) & (kl <= settings.kl_threshold)  # false for NaN
        num_accepted = now.num_accepted + accepted
        num_refused = now.num_refused + ~accepted
        ended = accepted & (num_refused > 0)
        ended |= num_accepted == settings.max_updates
        ended |= num_refused == settings.max_backtracks
        keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)
        return Ascent(
            policy=keep(tried, now.policy),
            gradient=keep(gradient, now.gradient),
            entropy=keep(entropy, now.entropy),
            kl=keep(kl, now.kl),
            optimizer=optimizer,
            num_accepted=num_accepted,
            num_refused=num_refused,
            ended=ended,
        )

    def step(now, _):
        return jax.lax.cond(now.ended, lambda x: x, attempt, now), None

    most = settings.max_updates + settings.max_backtracks - 1
    return jax.lax.scan(step, begin, length=most)[0], entropy


def gaussian(module: GaussianPolicy, policy: Any, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the policy's mean and log standard deviation, [..., I] -> [..., A] each."""
    return cast(tuple[jax.Array, jax.Array], module.apply(policy, inputs))


def log_prob(module: GaussianPolicy, policy: Any, batch: Batch) -> jax.Array:
    """Returns the log-probability of the drawn actions up to a constant, [T, E] nats.

    It ignores the clipping, which the environment does in the same way for every policy.
    """
    mean, log_std = gaussian(module, policy, batch.inputs)
    noise = (batch.actions - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * noise**2 - log_std, axis=-1)


def _measures(module: GaussianPolicy, played_by: Any, batch: Batch) -> Callable:
    """policy -> (entropy, KL from the policy that played), and the gradient of the entropy."""
    played = log_prob(module, played_by, batch)
    particles = batch.particles

    def estimate(policy):
        log_ratio = log_prob(module, policy, batch) - played
        log_weight = estimates.log_weights(log_ratio, particles.alive)
        return estimates.entropy(particles, log_weight), estimates.kl(particles, log_weight)

    return jax.value_and_grad(estimate, has_aux=True)
