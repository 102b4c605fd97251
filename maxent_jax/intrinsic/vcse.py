"""VCSE: the entropy of states among those of the same value.

Kim et al. 2023, "Accelerating reinforcement learning with value-conditional state entropy
exploration", arXiv 2305.19476: ψ(n + 1) / D + log 2ε. ε is the distance to the k-th nearest, where
a distance is the larger of that between states and that between values; n counts the values nearer
than ε (after Kraskov, Stögbauer & Grassberger 2004). As in their code
(github.com/kingdy2002/VCSE, `VCSE_SAC`), states are also divided by D, values are normalised over
the batch, and 1e-5 is added inside the logarithm. Their k and n count the state itself; ours do
not, nor do Kraskov's. Their value is that of the mean action, from a critic of the task's reward
alone. Here no such reward exists: the value is the learner's, of a drawn action, with its entropy.
"""

import functools

import jax
import jax.numpy as jnp
from jax.scipy.special import digamma

from maxent_jax.config.registry import BONUSES
from maxent_jax.density.knn import smallest_k
from maxent_jax.intrinsic import particles, protocol
from maxent_jax.intrinsic.protocol import Bonus, Setting, State, Steps

NUM_NEIGHBORS = BONUSES["vcse"].num_neighbors  # knn_k of VCSE_SAC/config/agent/sac.yaml
LOG_OFFSET = 1e-5  # of their code
VARIANCE_FLOOR = 1e-5  # of the values; from their layer norm
ROUNDING = 1e-6
ROWS = 256  # states measured at once, so that memory grows with B, not with its square


def make(setting: Setting) -> Bonus:
    """Makes the bonus ψ(n + 1) / D + log(2ε + 1e-5), nats per dimension, of either sign."""
    return Bonus(init=protocol.no_state, reward=functools.partial(reward, setting))


def reward(setting: Setting, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the reward of each state among the others of the batch, [B].

    Raises:
      ValueError: B <= 12.
    """
    dims = setting.num_features
    states = protocol.scaled(setting, steps.next_features) / dims
    deviation = steps.value - jnp.mean(steps.value)
    values = deviation / jnp.sqrt(jnp.mean(deviation**2) + VARIANCE_FLOOR)
    distance, count = joint_neighbors(states, values, steps.row, NUM_NEIGHBORS)
    spread = digamma(count.astype(jnp.float32) + 1) / dims
    return state, spread + jnp.log(2 * distance + LOG_OFFSET)


def joint_neighbors(
    states: jax.Array, values: jax.Array, rows: jax.Array, num_neighbors: int
) -> tuple[jax.Array, jax.Array]:
    """Returns the terms of Kraskov's first estimator, of each row among the others.

    Args:
      states: [B, F].
      values: [B].
      rows: [B] int32, equal for copies of one transition, which do not count as others.
      num_neighbors: k.
    Returns:
      [B] ε, to the k-th nearest in max(distance of states, distance of values), or to the farthest
        if copies leave fewer than k others; and [B] int32, how many values are nearer than ε.
    Raises:
      ValueError: B <= k.
    """
    particles.check(states.shape[0], num_neighbors)

    def measure(one):
        state, value, own = one
        apart = jnp.sqrt(jnp.sum((states - state[None]) ** 2, axis=-1))
        value_apart = jnp.abs(values - value)
        other = rows != own
        joint = jnp.where(other, jnp.maximum(apart, value_apart), jnp.inf)
        distance = particles.filled(smallest_k(joint, num_neighbors))[-1]
        # ε is often a distance of values itself, whose last bit XLA may compute differently here.
        nearer = value_apart < distance * (1 - ROUNDING)
        return distance, jnp.sum(other & nearer, dtype=jnp.int32)

    return jax.lax.map(measure, (states, values, rows), batch_size=ROWS)
