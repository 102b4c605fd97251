"""GIRIL: the error of a model that generates the next state from the action.

Yu, Lyu & Tsang 2020, "Intrinsic reward driven imitation learning via generative model", arXiv
2006.15061: a method of imitation. Its model learns the transitions of a demonstrator before the
agent learns, and stays as it is. Here the model learns the agent's own transitions while the agent
learns, as in RLE (github.com/RLE-Foundation/rllte, `girm.py`). The model is a variational
autoencoder of the next state, given the state. Its encoder is an inverse model: the code z is a
Gaussian estimate of the action. The reward is λ |s' - decoder(s, a)|² with the action that was
taken (the paper's β = 1); λ = 1, because rewards are divided by their deviation anyway. Differences
from the authors' code (github.com/xingruiyu/GIRIL, `vae.py`):
- Their actions are discrete: softmax of z, and cross entropy. Ours are continuous: z itself, and
  the mean squared error, as in RLE.
- They sum the divergence over the batch, so that its weight grows with the batch. We take the mean.
- Networks have two hidden layers, for states; theirs are convolutions. The standard deviation of z
  is kept within the limits of our policies.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax.intrinsic import descent, protocol
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.protocol import HIDDEN_LAYERS, HIDDEN_SIZE, Bonus, Setting, Steps
from maxent_jax.sac.networks import Actor, Mlp
from maxent_jax.types import Metrics

# Of the losses: lambda_action and beta of their train_reward_module.sh; the error's own is 1.
ACTION_WEIGHT, DIVERGENCE_WEIGHT = 100.0, 1.0


class Giril(NamedTuple):
    """The static part."""

    setting: Setting
    encoder: Actor
    decoder: Mlp
    optimizer: optax.GradientTransformation


class Parameters(NamedTuple):
    """Of both networks; the state is these and their optimiser."""

    encoder: Any
    decoder: Any


def make(setting: Setting) -> Bonus:
    """Makes the bonus, the squared length of the decoder's error, at least 0."""
    giril = build(setting)
    return Bonus(
        init=functools.partial(init, giril),
        reward=functools.partial(reward, giril),
        learn=functools.partial(learn, giril),
    )


def build(setting: Setting) -> Giril:
    """Makes the static part."""
    return Giril(
        setting=setting,
        encoder=Actor(setting.action_size, HIDDEN_LAYERS, HIDDEN_SIZE),
        decoder=Mlp(HIDDEN_LAYERS, HIDDEN_SIZE, setting.num_features),
        optimizer=protocol.optimizer(setting),
    )


def init(giril: Giril, key: jax.Array) -> Learned:
    """Returns random networks."""
    key_encoder, key_decoder = jax.random.split(key)
    dims, num_actions = giril.setting.num_features, giril.setting.action_size
    parameters = Parameters(
        encoder=giril.encoder.init(key_encoder, jnp.zeros((1, 2 * dims))),
        decoder=giril.decoder.init(key_decoder, jnp.zeros((1, dims + num_actions))),
    )
    return descent.begin(giril.optimizer, parameters)


def reward(giril: Giril, state: Learned, steps: Steps) -> tuple[Learned, jax.Array]:
    """Returns the squared length of the error in the next state, in units of the scale, [B]."""
    error = decoding_error(giril, state.parameters, steps, steps.action)
    return state, jnp.sum(error**2, axis=-1)


def learn(giril: Giril, state: Learned, steps: Steps, key: jax.Array) -> tuple[Learned, Metrics]:
    """Takes one gradient step of both networks, with one code drawn for each transition."""

    def loss(parameters):
        mean, log_std = encode(giril, parameters, steps)
        code = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        reconstruction = jnp.mean(decoding_error(giril, parameters, steps, code) ** 2)
        action = jnp.mean((code - steps.action) ** 2)
        divergence = jnp.mean(divergence_from_prior(mean, log_std))
        metrics = {
            "bonus_reconstruction_error": reconstruction,
            "bonus_action_error": action,
            "bonus_divergence": divergence,
        }
        return reconstruction + ACTION_WEIGHT * action + DIVERGENCE_WEIGHT * divergence, metrics

    return descent.descend(giril.optimizer, state, loss)


def encode(giril: Giril, parameters: Parameters, steps: Steps) -> tuple[jax.Array, jax.Array]:
    """Returns the mean and the log standard deviation of the code, [B, A] each."""
    before = protocol.scaled(giril.setting, steps.features)
    after = protocol.scaled(giril.setting, steps.next_features)
    both = jnp.concatenate([before, after], axis=-1)
    return cast(tuple[jax.Array, jax.Array], giril.encoder.apply(parameters.encoder, both))


def decoding_error(
    giril: Giril, parameters: Parameters, steps: Steps, action: jax.Array
) -> jax.Array:
    """Returns the decoded minus the true next state, [B, F], given actions or codes [B, A]."""
    before = protocol.scaled(giril.setting, steps.features)
    cause = jnp.concatenate([before, action], axis=-1)
    decoded = cast(jax.Array, giril.decoder.apply(parameters.decoder, cause))
    return decoded - protocol.scaled(giril.setting, steps.next_features)


def divergence_from_prior(mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """The divergence of a Gaussian code from the prior N(0, 1).

    Args:
      mean: [B, A].
      log_std: [B, A].
    Returns:
      [B] KL(N(mean, std²) || N(0, 1)), nats.
    """
    return 0.5 * jnp.sum(mean**2 + jnp.exp(2 * log_std) - 1 - 2 * log_std, axis=-1)
