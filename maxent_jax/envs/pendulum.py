"""Pendulum: a rod on a hinge with a weak motor. Gymnasium's Pendulum-v1 in plain jax.

| state | what             | unit  |
|-------|------------------|-------|
| 0, 1  | cos θ, sin θ; θ = 0 points up | - |
| 2     | angular velocity, at most 8   | rad/s |

An episode starts hanging at rest and ends only at the time limit. The official MaxEnt-H experiments
start there too, have a limit of 200 steps, and count visits to 8 × 8 cells of |θ| and angular
velocity.
"""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from maxent_jax.density.histogram import Grid
from maxent_jax.envs import entries
from maxent_jax.envs.task import check_action
from maxent_jax.precision import in_32_bits

TIME_STEP = 0.05  # seconds
GRAVITY, MASS, LENGTH = 10.0, 1.0, 1.0  # m/s², kg, m
MAX_SPEED = 8.0  # rad/s
MAX_TORQUE = 2.0  # N m


def observe(angle_and_speed: jax.Array) -> jax.Array:
    """Returns the observation [3] of an angle and an angular velocity [2]."""
    angle, speed = angle_and_speed
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), speed])


def absolute_angle_and_speed(observation: jax.Array) -> jax.Array:
    """Returns |θ| in [0, π] and the angular velocity, [..., 3] -> [..., 2]."""
    cos, sin, speed = jnp.moveaxis(observation, -1, 0)
    return jnp.stack([jnp.arctan2(jnp.abs(sin), cos), speed], axis=-1)


GRID = Grid(
    names=("|θ| (rad)", "angular velocity (rad/s)"),
    low=(0.0, -MAX_SPEED),
    high=(float(jnp.pi), MAX_SPEED),
    bins=(8, 8),
    transform=absolute_angle_and_speed,
)


class Pendulum(Env):
    """A brax environment; its pipeline state is [θ in [-π, π], angular velocity]."""

    @in_32_bits
    def reset(self, rng: jax.Array) -> State:
        """Returns the start: hanging at rest, whatever the key."""
        del rng
        hanging, zero = jnp.array([jnp.pi, 0.0]), jnp.zeros(())
        return State(hanging, observe(hanging), zero, zero)

    @in_32_bits
    def step(self, state: State, action: jax.Array) -> State:
        """Takes one step of 0.05 s of a single episode; an action [1] of 1 is the full torque.

        Raises:
          ValueError: the action has the wrong size.
        """
        action = check_action(self, action)
        angle, speed = state.pipeline_state
        torque = MAX_TORQUE * jnp.clip(action[0], -1, 1)
        pull = 3 * GRAVITY / (2 * LENGTH) * jnp.sin(angle) + 3 / (MASS * LENGTH**2) * torque
        speed = jnp.clip(speed + pull * TIME_STEP, -MAX_SPEED, MAX_SPEED)
        angle = angle + speed * TIME_STEP
        angle = angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))  # else it loses precision
        after = jnp.stack([angle, speed])
        return state.replace(pipeline_state=after, obs=observe(after))

    @property
    def observation_size(self) -> int:
        """The size of an observation, D."""
        return 3

    @property
    def action_size(self) -> int:
        """The size of an action, A."""
        return 1

    @property
    def backend(self) -> str:
        """The simulator: "jax"."""
        return "jax"


ENTRY = entries.of_class(Pendulum, GRID)
