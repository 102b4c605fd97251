"""RE3: the distance from a state to its nearest in the batch, in a random embedding.

Seo et al. 2021, "State entropy maximization with random encoders for efficient exploration", arXiv
2102.09430: log(1 + R), R the distance to the k-th nearest. Their off-policy code
(github.com/younggyoseo/RE3, `rad_re3`) searches the whole replay, not the batch, and its reward is
R / std(R), without the logarithm. Their encoder is convolutional and ends with layer norm and tanh.
Ours, for states, is the one that the code of k-means MaxEnt compares with
(github.com/axnedergaard/kme): two hidden layers, and neither of those.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from maxent_jax.config.registry import BONUSES
from maxent_jax.intrinsic import particles, protocol
from maxent_jax.intrinsic.protocol import (
    EMBEDDING_SIZE,
    HIDDEN_LAYERS,
    HIDDEN_SIZE,
    Bonus,
    Setting,
    Steps,
)
from maxent_jax.sac.networks import Mlp

NUM_NEIGHBORS = BONUSES["re3"].num_neighbors  # k of rad_re3/config.yaml


class Re3(NamedTuple):
    """The static part; the state is the encoder's weights."""

    setting: Setting
    encoder: Mlp


def make(setting: Setting) -> Bonus:
    """Makes the bonus log(1 + distance to the third nearest), positive."""
    re3 = Re3(setting, Mlp(HIDDEN_LAYERS, HIDDEN_SIZE, EMBEDDING_SIZE))
    return Bonus(init=functools.partial(init, re3), reward=functools.partial(reward, re3))


def init(re3: Re3, key: jax.Array) -> Any:
    """Returns a random encoder."""
    return re3.encoder.init(key, jnp.zeros((1, re3.setting.num_features)))


def reward(re3: Re3, state: Any, steps: Steps) -> tuple[Any, jax.Array]:
    """Returns log(1 + R), [B].

    Raises:
      ValueError: B <= 3.
    """
    inputs = protocol.scaled(re3.setting, steps.next_features)
    embedding = cast(jax.Array, re3.encoder.apply(state, inputs))
    return state, jnp.log1p(particles.distances(embedding, steps.row, NUM_NEIGHBORS)[:, -1])
