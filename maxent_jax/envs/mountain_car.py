"""Mountain car: an engine too weak for its hill. MountainCarContinuous-v0's dynamics in plain jax.

| state | what              | unit         |
|-------|-------------------|--------------|
| 0     | position, in [-1.2, 0.6]  | -    |
| 1     | velocity, in [-0.07, 0.07]| per step |

An episode starts at rest near the bottom of the valley. It ends at the goal, position 0.45, or at
the time limit. The official MaxEnt-H experiments have a limit of 200 steps and count visits to
12 × 11 cells.
"""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from maxent_jax.density.histogram import Grid
from maxent_jax.envs import entries
from maxent_jax.envs.task import check_action
from maxent_jax.precision import in_32_bits

POSITION = (-1.2, 0.6)
MAX_SPEED = 0.07
POWER, GRAVITY = 0.0015, 0.0025
GOAL = 0.45
START = (-0.6, -0.4)
GRID = Grid(
    names=("position", "velocity"),
    low=(POSITION[0], -MAX_SPEED),
    high=(POSITION[1], MAX_SPEED),
    bins=(12, 11),
)


def reached(observation: jax.Array) -> jax.Array:
    """Returns whether the car is at its goal, [..., 2] -> [...] bool."""
    return (observation[..., 0] >= GOAL) & (observation[..., 1] >= 0)


class MountainCar(Env):
    """A brax environment; its pipeline state is the observation."""

    @in_32_bits
    def reset(self, rng: jax.Array) -> State:
        """Returns a start at rest, with a random position in [-0.6, -0.4]."""
        position = jax.random.uniform(rng, minval=START[0], maxval=START[1])
        zero = jnp.zeros(())
        start = jnp.stack([position, zero])
        return State(start, start, zero, zero)

    @in_32_bits
    def step(self, state: State, action: jax.Array) -> State:
        """Takes one step of a single episode; an action [1] of 1 is the engine's full force.

        Raises:
          ValueError: the action has the wrong size.
        """
        action = check_action(self, action)
        position, velocity = state.pipeline_state
        force = jnp.clip(action[0], -1, 1)
        velocity = velocity + (force * POWER - GRAVITY * jnp.cos(3 * position))
        velocity = jnp.clip(velocity, -MAX_SPEED, MAX_SPEED)
        position = jnp.clip(position + velocity, *POSITION)
        velocity = jnp.where((position == POSITION[0]) & (velocity < 0), 0.0, velocity)
        after = jnp.stack([position, velocity])
        done = reached(after).astype(jnp.float32)
        return state.replace(pipeline_state=after, obs=after, done=done)

    @property
    def observation_size(self) -> int:
        """The size of an observation, D."""
        return 2

    @property
    def action_size(self) -> int:
        """The size of an action, A."""
        return 1

    @property
    def backend(self) -> str:
        """The simulator: "jax"."""
        return "jax"


ENTRY = entries.of_class(MountainCar, GRID)
