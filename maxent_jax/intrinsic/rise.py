"""RISE: a power of the distance from a state to its nearest in the batch; and Rényi's plain form.

Yuan, Pun & Wang 2022, "Rényi state entropy for exploration acceleration in reinforcement learning",
arXiv 2203.04297: R^(1 - α), R the distance to the k-th nearest. Images are embedded by a VAE, which
is trained on a random policy. Their code (github.com/yuanmingqi/RISE, `src/rise.py`) uses the
states of continuous control as they are; here they are φ, in its units. Its k + 1 skips the state
itself and one more neighbour; ours is the k-th. The paper's search for k is not in its code, and
not here.
"""

import functools

import jax

from maxent_jax import rewards
from maxent_jax.config.registry import BONUSES
from maxent_jax.intrinsic import particles, protocol
from maxent_jax.intrinsic.protocol import Bonus, Setting, State, Steps

NUM_NEIGHBORS, ORDER = BONUSES["rise"].num_neighbors, 0.1  # k and alpha of src/rise.py


def make(setting: Setting) -> Bonus:
    """Makes the bonus R^0.9, at least 0."""
    return Bonus(init=protocol.no_state, reward=functools.partial(reward, setting))


def make_renyi(setting: Setting) -> Bonus:
    """Makes the bonus 0.9 × -log of the kNN density, nats, of either sign.

    With R^(D (1 - α)) instead of R^(1 - α), RISE's reward would be its exponential, up to a factor.
    """
    return Bonus(init=protocol.no_state, reward=functools.partial(renyi_reward, setting))


def reward(
    setting: Setting, state: State, steps: Steps, order: float = ORDER
) -> tuple[State, jax.Array]:
    """Returns R^(1 - α), [B]: linear in R at α = 0, almost equal for all states as α nears 1.

    Raises:
      ValueError: B <= 5.
    """
    states = protocol.scaled(setting, steps.next_features)
    return state, particles.distances(states, steps.row, NUM_NEIGHBORS)[:, -1] ** (1 - order)


def renyi_reward(setting: Setting, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns (α - 1) log p of each state among the others of the batch, [B] nats.

    As rewards.renyi_reward.

    Raises:
      ValueError: B <= 5.
    """
    states = protocol.scaled(setting, steps.next_features)
    nearest = particles.distances(states, steps.row, NUM_NEIGHBORS)[:, -1]
    num_states, dims = states.shape
    log_p = rewards.floored_log_density(nearest, num_states - 1, NUM_NEIGHBORS, dims)
    return state, (ORDER - 1) * log_p
