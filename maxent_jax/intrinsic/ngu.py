"""NGU: novelty within the episode, times novelty over the agent's whole life.

Badia et al. 2020, "Never give up: learning directed exploration strategies", arXiv 2002.06038,
Eq. 1 and Algorithm 1; there is no official code. States are compared in an embedding from which an
inverse model predicts the action. The loss is the squared error (a Gaussian likelihood); in the
paper actions are discrete. The paper recomputes embeddings with a copy that is refreshed once per
episode; here an embedding is computed once, when its state is reached. Left out: the weight decay
of 1e-5, and Algorithm 1's cut at a similarity of 8, which 10 neighbours never reach.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax import moments
from maxent_jax.density.knn import smallest_k
from maxent_jax.intrinsic import descent, protocol, rnd
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.protocol import (
    HIDDEN_LAYERS,
    HIDDEN_SIZE,
    Bonus,
    Episodic,
    Setting,
    Steps,
)
from maxent_jax.intrinsic.rnd import Rnd
from maxent_jax.moments import Moments
from maxent_jax.sac.networks import Mlp
from maxent_jax.types import Metrics

# Table 6 of the paper, but for the size of the embedding (B.1) and the limit (below Eq. 1).
NUM_NEIGHBORS = 10
KERNEL_WIDTH = 1e-4  # ε; the text says 1e-3, the table of the experiments 1e-4
CLUSTER_DISTANCE = 0.008  # ξ
PSEUDO_COUNT = 1e-3  # c
MODULATOR_LIMIT = 5.0  # L
EMBEDDING_SIZE = 32
MEAN_FLOOR = 1e-12  # of the mean squared distance, if all states so far are equal


class Ngu(NamedTuple):
    """The static part."""

    setting: Setting
    rnd: Rnd
    embedding: Mlp
    inverse: Mlp
    optimizer: optax.GradientTransformation


class Parameters(NamedTuple):
    """Of the embedding and the inverse model."""

    embedding: Any
    inverse: Any


class State(NamedTuple):
    """RND's state, the embedding, and the running mean of squared distances."""

    rnd: rnd.State
    controllable: Learned
    distances: Moments  # [] squared, to the nearest neighbours


def make(setting: Setting) -> Bonus:
    """Makes the bonus episodic novelty × clip(1 + (error - mean) / std, 1, 5), positive."""
    ngu = Ngu(
        setting=setting,
        rnd=rnd.build(setting),
        embedding=Mlp(HIDDEN_LAYERS, HIDDEN_SIZE, EMBEDDING_SIZE),
        inverse=Mlp(1, HIDDEN_SIZE, setting.action_size),
        optimizer=protocol.optimizer(setting),
    )
    return Bonus(
        init=functools.partial(init, ngu),
        reward=functools.partial(reward, ngu),
        learn=functools.partial(learn, ngu),
        episodic=Episodic(
            size=EMBEDDING_SIZE,
            embed=functools.partial(embed, ngu),
            novelty=functools.partial(novelty, ngu),
        ),
    )


def init(ngu: Ngu, key: jax.Array) -> State:
    """Returns random networks, and empty normalisers."""
    key_rnd, key_embedding, key_inverse = jax.random.split(key, 3)
    features = jnp.zeros((1, ngu.setting.num_features))
    parameters = Parameters(
        embedding=ngu.embedding.init(key_embedding, features),
        inverse=ngu.inverse.init(key_inverse, jnp.zeros((1, 2 * EMBEDDING_SIZE))),
    )
    return State(
        rnd=rnd.init(ngu.rnd, key_rnd),
        controllable=descent.begin(ngu.optimizer, parameters),
        distances=moments.init(),
    )


def embed(ngu: Ngu, state: State, features: jax.Array) -> jax.Array:
    """Embeds features, [N, F] -> [N, E]."""
    return _embedding(ngu, state.controllable.parameters, features)


def novelty(
    ngu: Ngu, state: State, embedding: jax.Array, earlier: jax.Array, count: jax.Array
) -> tuple[State, jax.Array]:
    """Returns how new each state is within its episode; updates the mean of squared distances.

    Novelty is 1 / (sqrt(sum of kernels over the 10 nearest) + c): 0.3 where all ten coincide with
    the state, about 30 at their mean distance, 1000 without any. It is higher with fewer than ten,
    as in Algorithm 1.

    Args:
      embedding: [N, E].
      earlier: [N, T, E] of the episode's earlier states; the first `count` are filled.
      count: [N] int.
    Returns:
      The state, and the novelty [N].
    """
    del ngu
    squared = jnp.sum((earlier - embedding[:, None]) ** 2, axis=-1)
    filled = jax.lax.broadcasted_iota(jnp.int32, squared.shape, 1) < count[:, None]
    nearest = smallest_k(jnp.where(filled, squared, jnp.inf), NUM_NEIGHBORS)
    found = jnp.isfinite(nearest)
    distances = moments.update(state.distances, nearest.reshape(-1), found.reshape(-1))
    relative = nearest / jnp.maximum(distances.mean, MEAN_FLOOR)
    kernel = KERNEL_WIDTH / (jnp.maximum(relative - CLUSTER_DISTANCE, 0.0) + KERNEL_WIDTH)
    similarity = jnp.sqrt(jnp.sum(kernel, axis=-1)) + PSEUDO_COUNT
    return state._replace(distances=distances), 1 / similarity


def reward(ngu: Ngu, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the stored novelty times RND's modulator, [B]; updates RND's normalisers first."""
    lifelong, error = rnd.advance(ngu.rnd, state.rnd, steps)
    std = jnp.sqrt(lifelong.errors.variance) + rnd.STD_FLOOR
    modulator = jnp.clip(1 + (error - lifelong.errors.mean) / std, 1.0, MODULATOR_LIMIT)
    return state._replace(rnd=lifelong), steps.episodic * modulator


def learn(ngu: Ngu, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """Takes one gradient step of RND's predictor, and one of the embedding and inverse model."""

    def loss(parameters):
        before = _embedding(ngu, parameters, steps.features)
        after = _embedding(ngu, parameters, steps.next_features)
        both = jnp.concatenate([before, after], axis=-1)
        guess = cast(jax.Array, ngu.inverse.apply(parameters.inverse, both))
        value = jnp.mean((guess - steps.action) ** 2)
        return value, {"bonus_inverse_error": value}

    controllable, metrics = descent.descend(ngu.optimizer, state.controllable, loss)
    lifelong, metrics_rnd = rnd.learn(ngu.rnd, state.rnd, steps, key)
    return state._replace(rnd=lifelong, controllable=controllable), metrics | metrics_rnd


def _embedding(ngu: Ngu, parameters: Parameters, features: jax.Array) -> jax.Array:
    inputs = protocol.scaled(ngu.setting, features)
    return cast(jax.Array, ngu.embedding.apply(parameters.embedding, inputs))
