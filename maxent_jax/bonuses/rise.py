"""RISE: a power of how far a state lies from its nearest in the batch; and Rényi's plain form.

Yuan, Pun & Wang 2022, "Rényi state entropy for exploration acceleration in reinforcement learning",
arXiv 2203.04297: R^(1 - α), R the distance to the k-th nearest. Images are embedded by a VAE that a
random policy trains; their code (github.com/yuanmingqi/RISE, `src/rise.py`) takes the states of
continuous control as they are, and so do we. Its k + 1 steps over the state itself and one more
neighbour; ours is the k-th. The paper's search for k is not in its code, and not here.
"""

import functools

import jax
import jax.numpy as jnp

from maxent_jax import rewards
from maxent_jax.bonuses import particles, protocol
from maxent_jax.bonuses.protocol import Bonus, Setting, State, Steps

NUM_NEIGHBORS, ORDER = 5, 0.1  # k and alpha of src/rise.py


def make(setting: Setting) -> Bonus:
    """The reward R^0.9, not negative."""
    return Bonus(
        init=protocol.no_state,
        reward=functools.partial(reward, setting),
        learn=protocol.no_learning,
    )


def make_renyi(setting: Setting) -> Bonus:
    """The reward 0.9 × -log of the kNN density, nats, of either sign.

    With R^(D (1 - α)) for R^(1 - α) RISE's reward would be its exponential, up to a factor.
    """
    return Bonus(
        init=protocol.no_state,
        reward=functools.partial(renyi_reward, setting),
        learn=protocol.no_learning,
    )


def reward(
    setting: Setting, state: State, steps: Steps, key: jax.Array, order: float = ORDER
) -> tuple[State, jax.Array]:
    """R^(1 - α): at order α = 0 linear in R; towards 1 it no longer tells states apart.

    Raises:
      ValueError: B <= 5.
    """
    del key
    states = protocol.scaled(setting, steps.next_observation)
    return state, particles.distances(states, NUM_NEIGHBORS)[:, -1] ** (1 - order)


def renyi_reward(
    setting: Setting, state: State, steps: Steps, key: jax.Array
) -> tuple[State, jax.Array]:
    """As rewards.renyi_reward, of each state among the others of the batch.

    Raises:
      ValueError: B <= 5.
    """
    del key
    states = protocol.scaled(setting, steps.next_observation)
    num_states = states.shape[0]
    particles.check(num_states, NUM_NEIGHBORS)
    own = jnp.arange(num_states)
    return state, rewards.renyi_reward(states, states, NUM_NEIGHBORS, ORDER, exclude=own)
