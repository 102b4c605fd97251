"""APT: the distance from a state to its nearest in the batch, in the embedding of ICM.

Liu & Abbeel 2021, "Behavior from the void: unsupervised active pre-training", arXiv 2103.04551
(MaxEnt-LA of our paper), as in URLB, which shares an author (`agent/icm_apt.py`, and `PBE` in
`utils.py`): log(1 + mean over the k nearest of max(R_i / m - 0.0001, 0)), with m the running mean
of all R_i. The paper embeds images by contrastive learning. URLB uses ICM, for states too; its 512
features are 50 here, see protocol. URLB rewards the state that a step left.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import moments
from maxent_jax.config.registry import BONUSES
from maxent_jax.intrinsic import icm, particles
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.icm import Icm
from maxent_jax.intrinsic.protocol import Bonus, Setting, Steps
from maxent_jax.moments import Moments
from maxent_jax.types import Metrics

NUM_NEIGHBORS = BONUSES["apt"].num_neighbors  # knn_k of URLB
DISTANCE_CLIP = 1e-4  # knn_clip of URLB, in running means
MEAN_FLOOR = 1e-8  # if all states so far are equal


class State(NamedTuple):
    """ICM's networks, and the running mean of the distances."""

    icm: Learned
    distances: Moments  # []


def make(setting: Setting) -> Bonus:
    """Makes the bonus log(1 + mean distance to the 12 nearest), positive."""
    fixed = icm.build(setting)
    return Bonus(
        init=functools.partial(init, fixed),
        reward=functools.partial(reward, fixed),
        learn=functools.partial(learn, fixed),
    )


def init(fixed: Icm, key: jax.Array) -> State:
    """Returns random networks and an empty running mean."""
    return State(icm.init(fixed, key), moments.init())


def reward(fixed: Icm, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the reward [B]; the running mean is updated before it is used.

    Raises:
      ValueError: B <= 12.
    """
    embedding = icm.embed(fixed, state.icm.parameters, steps.next_features)
    nearest = particles.distances(embedding, steps.row, NUM_NEIGHBORS)
    state = state._replace(distances=moments.update(state.distances, nearest.reshape(-1)))
    relative = nearest / jnp.maximum(state.distances.mean, MEAN_FLOOR)
    return state, jnp.log1p(jnp.mean(jnp.maximum(relative - DISTANCE_CLIP, 0.0), axis=-1))


def learn(fixed: Icm, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """Takes one gradient step of ICM; the running mean does not change."""
    learned, metrics = icm.learn(fixed, state.icm, steps, key)
    return state._replace(icm=learned), metrics
