"""ICM: the error of a model of the next state, in an embedding that distinguishes actions.

Pathak et al. 2017, "Curiosity-driven exploration by self-supervised prediction", arXiv 1705.05363.
An inverse model predicts the action from the embeddings before and after it. A forward model
predicts the embedding after it from the action and the embedding before. The embedding gets the
gradients of both. Networks, losses and reward are those of URLB for states (`agent/icm.py`, with
the trunk of `icm_apt.py`, without which it has no embedding): the losses are the mean lengths of
both errors, the reward is log(1 + length of the forward error). The paper and its code
(github.com/pathak22/noreward-rl) minimise 0.8 times the inverse loss and 0.2 times half the squared
forward error; their reward is 0.01 times the latter.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax.intrinsic import descent, protocol
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.protocol import EMBEDDING_SIZE, HIDDEN_SIZE, Bonus, Setting, Steps
from maxent_jax.sac.networks import Mlp, Trunk
from maxent_jax.types import Metrics

SQUARE_FLOOR = 1e-12  # of a squared length: the root has no slope at 0


class Icm(NamedTuple):
    """The static part."""

    setting: Setting
    trunk: Trunk
    forward: Mlp
    inverse: Mlp
    optimizer: optax.GradientTransformation


class Parameters(NamedTuple):
    """Of the three networks; the state is these and their optimiser."""

    trunk: Any
    forward: Any
    inverse: Any


def make(setting: Setting) -> Bonus:
    """Makes the bonus log(1 + length of the forward error), positive."""
    icm = build(setting)
    return Bonus(
        init=functools.partial(init, icm),
        reward=functools.partial(reward, icm),
        learn=functools.partial(learn, icm),
    )


def build(setting: Setting) -> Icm:
    """Makes the static part. Models have one hidden layer, as in URLB."""
    return Icm(
        setting=setting,
        trunk=Trunk(EMBEDDING_SIZE),
        forward=Mlp(1, HIDDEN_SIZE, EMBEDDING_SIZE),
        inverse=Mlp(1, HIDDEN_SIZE, setting.action_size),
        optimizer=protocol.optimizer(setting),
    )


def init(icm: Icm, key: jax.Array) -> Learned:
    """Returns random networks."""
    key_trunk, key_forward, key_inverse = jax.random.split(key, 3)
    features = jnp.zeros((1, icm.setting.num_features))
    embedding = jnp.zeros((1, EMBEDDING_SIZE))
    action = jnp.zeros((1, icm.setting.action_size))
    parameters = Parameters(
        trunk=icm.trunk.init(key_trunk, features),
        forward=icm.forward.init(key_forward, jnp.concatenate([embedding, action], axis=-1)),
        inverse=icm.inverse.init(key_inverse, jnp.concatenate([embedding, embedding], axis=-1)),
    )
    return descent.begin(icm.optimizer, parameters)


def reward(icm: Icm, state: Learned, steps: Steps) -> tuple[Learned, jax.Array]:
    """Returns log(1 + length of the forward error), [B]."""
    forward, _ = errors(icm, state.parameters, steps)
    return state, jnp.log1p(forward)


def learn(icm: Icm, state: Learned, steps: Steps, key: jax.Array) -> tuple[Learned, Metrics]:
    """Takes one gradient step of all three networks."""
    del key

    def loss(parameters):
        forward, inverse = (jnp.mean(error) for error in errors(icm, parameters, steps))
        metrics = {"bonus_forward_error": forward, "bonus_inverse_error": inverse}
        return forward + inverse, metrics

    return descent.descend(icm.optimizer, state, loss)


def embed(icm: Icm, parameters: Parameters, features: jax.Array) -> jax.Array:
    """Embeds features, [B, F] -> [B, E] in [-1, 1]."""
    inputs = protocol.scaled(icm.setting, features)
    return cast(jax.Array, icm.trunk.apply(parameters.trunk, inputs))


def errors(icm: Icm, parameters: Parameters, steps: Steps) -> tuple[jax.Array, jax.Array]:
    """Returns the lengths of the forward and the inverse model's errors, [B] each."""
    before = embed(icm, parameters, steps.features)
    after = embed(icm, parameters, steps.next_features)
    cause = jnp.concatenate([before, steps.action], axis=-1)
    expected = cast(jax.Array, icm.forward.apply(parameters.forward, cause))
    both = jnp.concatenate([before, after], axis=-1)
    guess = jnp.tanh(cast(jax.Array, icm.inverse.apply(parameters.inverse, both)))
    return _lengths(after - expected), _lengths(steps.action - guess)


def _lengths(vectors: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.maximum(jnp.sum(vectors**2, axis=-1), SQUARE_FLOOR))
