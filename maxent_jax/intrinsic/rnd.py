"""RND: the error of a network that predicts the output of another, fixed one.

Burda et al. 2018, "Exploration by random network distillation", arXiv 1810.12894. Their code
(github.com/openai/random-network-distillation) divides by the standard deviation of the reward's
discounted return. URLB, whose transitions have no order, divides by that of the reward, as we do.
URLB normalises what it sees over the batch; we do so over all that it saw so far, as RND's authors
do. Their predictor has two layers more than the target; ours has the target's layers, as in URLB.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax import moments
from maxent_jax.intrinsic import descent, protocol
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.protocol import HIDDEN_LAYERS, HIDDEN_SIZE, Bonus, Setting, Steps
from maxent_jax.moments import Moments
from maxent_jax.sac.networks import Mlp
from maxent_jax.types import Metrics

OUTPUT_SIZE = 512  # rep_size of their code, rnd_rep_dim of URLB
OBSERVATION_LIMIT = 5.0  # standard deviations (2.4 of the paper)
VARIANCE_FLOOR = 1e-5  # of a feature, in units of its scale; from URLB's batch norm
STD_FLOOR = 1e-8  # of the error: URLB


class Rnd(NamedTuple):
    """The static part."""

    setting: Setting
    network: Mlp
    optimizer: optax.GradientTransformation


class State(NamedTuple):
    """The fixed target, the predictor, and the running normalisers."""

    target: Any
    predictor: Learned
    observations: Moments  # [F] of the features seen
    errors: Moments  # []


def make(setting: Setting) -> Bonus:
    """Makes the bonus error / std(error), positive."""
    rnd = build(setting)
    return Bonus(
        init=functools.partial(init, rnd),
        reward=functools.partial(reward, rnd),
        learn=functools.partial(learn, rnd),
    )


def build(setting: Setting) -> Rnd:
    """Makes the static part."""
    network = Mlp(HIDDEN_LAYERS, HIDDEN_SIZE, OUTPUT_SIZE)
    return Rnd(setting, network, protocol.optimizer(setting))


def init(rnd: Rnd, key: jax.Array) -> State:
    """Returns a random predictor and target, and empty normalisers."""
    key_target, key_predictor = jax.random.split(key)
    inputs = jnp.zeros((1, rnd.setting.num_features))
    return State(
        target=rnd.network.init(key_target, inputs),
        predictor=descent.begin(rnd.optimizer, rnd.network.init(key_predictor, inputs)),
        observations=moments.init((rnd.setting.num_features,)),
        errors=moments.init(),
    )


def reward(rnd: Rnd, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the reward [B]; both normalisers are updated before they are used."""
    state, error = advance(rnd, state, steps)
    return state, error / (jnp.sqrt(state.errors.variance) + STD_FLOOR)


def advance(rnd: Rnd, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Updates the normalisers with the steps; also returns their errors [B], not normalised."""
    met = protocol.scaled(rnd.setting, steps.next_features)
    state = state._replace(observations=moments.update(state.observations, met))
    error = prediction_error(rnd, state, state.predictor.parameters, steps)
    return state._replace(errors=moments.update(state.errors, error)), error


def learn(rnd: Rnd, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """Takes one gradient step of the predictor; the normalisers do not change."""
    del key

    def loss(parameters):
        value = jnp.mean(prediction_error(rnd, state, parameters, steps))
        return value, {"bonus_prediction_error": value}

    predictor, metrics = descent.descend(rnd.optimizer, state.predictor, loss)
    return state._replace(predictor=predictor), metrics


def prediction_error(rnd: Rnd, state: State, parameters: Any, steps: Steps) -> jax.Array:
    """Returns the mean squared error of a predictor with these parameters, [B]."""
    seen = state.observations
    std = jnp.sqrt(seen.variance + VARIANCE_FLOOR)
    inputs = (protocol.scaled(rnd.setting, steps.next_features) - seen.mean[None]) / std[None]
    inputs = jnp.clip(inputs, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
    wanted = cast(jax.Array, rnd.network.apply(state.target, inputs))
    predicted = cast(jax.Array, rnd.network.apply(parameters, inputs))
    return jnp.mean((predicted - wanted) ** 2, axis=-1)
