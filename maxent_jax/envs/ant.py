"""Ant: a torso on four legs of two joints, 8 torques. Gymnasium's Ant-v4 with positions kept.

| state     | what                                            | unit  |
|-----------|-------------------------------------------------|-------|
| 0, 1, 2   | torso x, y, z                                   | m     |
| 3 .. 6    | torso orientation, quaternion (w, x, y, z)      | -     |
| 7 .. 14   | hip and ankle angles of the legs, in pairs      | rad   |
| 15, 16, 17| torso velocity in the world's axes              | m/s   |
| 18, 19, 20| torso angular velocity in the torso's axes      | rad/s |
| 21 .. 28  | hip and ankle velocities                        | rad/s |
"""

import jax
import jax.numpy as jnp

from maxent_jax.density.histogram import Grid
from maxent_jax.envs import entries, physics, torso
from maxent_jax.envs.physics import Derived, Options, PhysicsState
from maxent_jax.envs.task import Task

HEALTHY_HEIGHT = (0.2, 1.0)  # metres, Ant-v4
RESET_NOISE = 0.1  # Ant-v4: uniform in qpos, standard deviation in qvel


def reset(key: jax.Array, rest: PhysicsState) -> PhysicsState:
    """Draws Ant-v4's start: the rest pose with noise in every coordinate."""
    key_qpos, key_qvel = jax.random.split(key)
    noise = jax.random.uniform(key_qpos, rest.qpos.shape, minval=-RESET_NOISE, maxval=RESET_NOISE)
    velocity = RESET_NOISE * jax.random.normal(key_qvel, rest.qvel.shape)
    return rest._replace(qpos=rest.qpos + noise, qvel=velocity)


def observe(state: PhysicsState, _: Derived) -> jax.Array:
    """Returns qpos and qvel, [..., 29]."""
    return jnp.concatenate([state.qpos, state.qvel], axis=-1)


def healthy(observation: jax.Array) -> jax.Array:
    """Returns whether all is finite and the height healthy, [..., D] -> [...] bool."""
    low, high = HEALTHY_HEIGHT
    height = observation[..., 2]
    return jnp.isfinite(observation).all(-1) & (height >= low) & (height <= high)


TASK = Task(
    name="ant",
    xml=physics.gymnasium_xml("ant.xml"),
    frame_skip=5,
    reset=reset,
    observe=observe,
    healthy=healthy,
    grid=Grid(
        names=("x (m)", "y (m)"),
        coordinates=(0, 1),
        low=(-40.0, -40.0),
        high=(40.0, 40.0),
        bins=(100, 100),
    ),
    fast=Options("Euler", substeps=2, iterations=4, ls_iterations=8, max_contacts=6),
    torso=torso.make(num_positions=15, num_velocities=14),
)
ENTRY = entries.of_task(TASK)
