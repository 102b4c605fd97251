"""APT: how far a state lies from its nearest in the batch, in the embedding of ICM.

Liu & Abbeel 2021, "Behavior from the void: unsupervised active pre-training", arXiv 2103.04551
(MaxEnt-LA of our paper), as in URLB, which has an author in common (`agent/icm_apt.py`, and `PBE`
in `utils.py`): log(1 + mean over the k nearest of max(R_i / m - 0.0001, 0)), with m the running
mean of all the R_i. The paper embeds images by contrastive learning; URLB, for states too, by ICM,
whose 512 features are 50 here, see protocol. URLB pays for the state left.
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
MEAN_FLOOR = 1e-8  # where all states met so far are one


class State(NamedTuple):
    """The embedding and its models, and the running mean of the distances."""

    icm: Learned
    distances: Moments  # []


def make(setting: Setting) -> Bonus:
    """The reward log(1 + mean distance to the 12 nearest), positive."""
    fixed = icm.build(setting)
    return Bonus(
        init=functools.partial(init, fixed),
        reward=functools.partial(reward, fixed),
        learn=functools.partial(learn, fixed),
    )


def init(fixed: Icm, key: jax.Array) -> State:
    """A fresh embedding, and a mean of nothing."""
    return State(icm.init(fixed, key), moments.init())


def reward(fixed: Icm, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """The running mean advances before it is used.

    Raises:
      ValueError: B <= 12.
    """
    embedding = icm.embed(fixed, state.icm.parameters, steps.next_observation)
    nearest = particles.distances(embedding, steps.row, NUM_NEIGHBORS)
    state = state._replace(distances=moments.update(state.distances, nearest.reshape(-1)))
    relative = nearest / jnp.maximum(state.distances.mean, MEAN_FLOOR)
    return state, jnp.log1p(jnp.mean(jnp.maximum(relative - DISTANCE_CLIP, 0.0), axis=-1))


def learn(fixed: Icm, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """One gradient step of ICM; the running mean stays."""
    learned, metrics = icm.learn(fixed, state.icm, steps, key)
    return state._replace(icm=learned), metrics
