"""Walker2d: two legs of three joints in a plane, 6 torques. Gymnasium's Walker2d-v4, x kept.

| state   | what                                          | unit  | clipped |
|---------|-----------------------------------------------|-------|---------|
| 0, 1    | torso x, z                                    | m     |         |
| 2       | torso pitch                                   | rad   |         |
| 3 .. 8  | thigh, leg and foot angles, right then left   | rad   |         |
| 9, 10   | torso velocity, x and z                       | m/s   | ±10     |
| 11      | torso angular velocity                        | rad/s | ±10     |
| 12 .. 17| joint velocities                              | rad/s | ±10     |
"""

import jax
import jax.numpy as jnp

from maxent_jax.density.histogram import Grid
from maxent_jax.envs import entries, physics, task
from maxent_jax.envs.physics import Derived, Options, PhysicsState
from maxent_jax.envs.task import Task

HEALTHY_HEIGHT = (0.8, 2.0)  # metres, Walker2d-v4
HEALTHY_PITCH = (-1.0, 1.0)  # radians, Walker2d-v4
LARGEST_VELOCITY = 10.0  # observed; m/s and rad/s, Walker2d-v4
RESET_NOISE = 5e-3  # Walker2d-v4


def observe(state: PhysicsState, _: Derived) -> jax.Array:
    """Returns qpos and the clipped qvel, [..., 18]."""
    velocity = jnp.clip(state.qvel, -LARGEST_VELOCITY, LARGEST_VELOCITY)
    return jnp.concatenate([state.qpos, velocity], axis=-1)


def healthy(observation: jax.Array) -> jax.Array:
    """Returns whether height and pitch are healthy, [..., D] -> [...] bool."""
    height, pitch = observation[..., 1], observation[..., 2]
    (low, high), (back, front) = HEALTHY_HEIGHT, HEALTHY_PITCH
    # >= instead of Gymnasium's >: float32 rounds 0.8 up, so this is `> 0.8` of the exact number.
    return (height >= low) & (height < high) & (pitch > back) & (pitch < front)


TASK = Task(
    name="walker2d",
    xml=physics.gymnasium_xml("walker2d.xml"),
    frame_skip=4,
    reset=task.uniform_reset(RESET_NOISE),
    observe=observe,
    healthy=healthy,
    grid=Grid(
        names=("x (m)", "z (m)"),
        coordinates=(0, 1),
        low=(-20.0, 0.5),
        high=(5.0, 2.0),
        bins=(100, 100),
    ),
    fast=Options("Euler", iterations=4, ls_iterations=8, max_contacts=4),
)
ENTRY = entries.of_task(TASK)
