"""Humanoid: 17 torques, 13 bodies. Gymnasium's Humanoid-v4 with positions kept.

| state      | what                                                       | unit         |
|------------|------------------------------------------------------------|--------------|
| 0, 1, 2    | torso x, y, z                                              | m            |
| 3 .. 6     | torso orientation, quaternion (w, x, y, z)                 | -            |
| 7 .. 23    | joint angles: abdomen, hips and knees, shoulders and elbows| rad          |
| 24, 25, 26 | torso velocity in the world's axes                         | m/s          |
| 27, 28, 29 | torso angular velocity in the torso's axes                 | rad/s        |
| 30 .. 46   | joint velocities                                           | rad/s        |
| 47 .. 186  | cinert: inertia (6), mass × offset (3), mass of each body  | kg m², kg m, kg |
| 187 .. 270 | cvel: angular and linear velocity of each body             | rad/s, m/s   |
| 271 .. 293 | qfrc_actuator: force along each degree of freedom          | N, N m       |
| 294 .. 377 | cfrc_ext: torque and force on each body from contacts      | N m, N       |

cinert, cvel and cfrc_ext count the world as one of 14 bodies; its entries are 0.
"""

import itertools

import jax
import jax.numpy as jnp

from maxent_jax.density.histogram import Grid
from maxent_jax.envs import entries, physics, task, torso
from maxent_jax.envs.physics import Derived, Options, PhysicsState
from maxent_jax.envs.task import Task

HEALTHY_HEIGHT = (1.0, 2.0)  # metres, Humanoid-v4
RESET_NOISE = 1e-2  # Humanoid-v4
DERIVED = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
NUM_BODIES, NUM_VELOCITIES = 14, 23


def observe(state: PhysicsState, derived: Derived) -> jax.Array:
    """Returns qpos, qvel and the derived fields, [..., 378]."""
    return jnp.concatenate([state.qpos, state.qvel, *(derived[name] for name in DERIVED)], axis=-1)


def rotate_derived(derived: jax.Array, angle: jax.Array) -> jax.Array:
    """Returns the derived fields with the world turned about the vertical.

    Actuator forces do not change. All other fields are tensors and vectors in the world's axes.

    Args:
      derived: [..., 331].
      angle: [...] radians.
    Returns:
      [..., 331].
    """
    ends = itertools.accumulate((10 * NUM_BODIES, 6 * NUM_BODIES, NUM_VELOCITIES))
    cinert, cvel, force, contact = jnp.split(derived, list(ends), -1)
    angle = angle[..., None]

    def turn_vectors(field: jax.Array) -> jax.Array:
        vectors = field.reshape(*field.shape[:-1], -1, 3)
        return torso.turn_vector(vectors, angle).reshape(field.shape)

    bodies = cinert.reshape(*cinert.shape[:-1], NUM_BODIES, 10)
    inertia, offset, mass = jnp.split(bodies, [6, 9], -1)
    turned = [_turn_inertia(inertia, angle), torso.turn_vector(offset, angle), mass]
    cinert = jnp.concatenate(turned, -1).reshape(cinert.shape)
    return jnp.concatenate([cinert, turn_vectors(cvel), force, turn_vectors(contact)], -1)


def _turn_inertia(inertia: jax.Array, angle: jax.Array) -> jax.Array:
    """[..., 6], in MuJoCo's order: the tensor's xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = jnp.moveaxis(inertia, -1, 0)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    mixed = 2 * cos * sin * xy
    turned = [
        cos**2 * xx + sin**2 * yy - mixed,
        sin**2 * xx + cos**2 * yy + mixed,
        zz,
        cos * sin * (xx - yy) + (cos**2 - sin**2) * xy,
        cos * xz - sin * yz,
        sin * xz + cos * yz,
    ]
    return jnp.stack(turned, -1)


def healthy(observation: jax.Array) -> jax.Array:
    """Returns whether the torso's height is healthy, [..., D] -> [...] bool."""
    low, high = HEALTHY_HEIGHT
    height = observation[..., 2]
    return (height > low) & (height < high)


TASK = Task(
    name="humanoid",
    xml=physics.gymnasium_xml("humanoid.xml"),
    frame_skip=5,
    reset=task.uniform_reset(RESET_NOISE),
    observe=observe,
    healthy=healthy,
    grid=Grid(
        names=("x (m)", "y (m)"),
        coordinates=(0, 1),
        low=(-10.0, -10.0),
        high=(10.0, 10.0),
        bins=(100, 100),
    ),
    derived=DERIVED,
    fast=Options("Euler", iterations=4, ls_iterations=8, max_contacts=8),
    torso=torso.make(24, NUM_VELOCITIES, rotate_derived),
)
ENTRY = entries.of_task(TASK)
