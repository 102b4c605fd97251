"""A robot with a floating torso: its up-axis, the view from its own heading, and rotations.

An observation begins with qpos and qvel. The first seven entries of qpos are the torso's position
and quaternion (w, x, y, z). The first six of qvel are its velocity in the world's axes and its
angular velocity in the torso's axes.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

POSITION_UNIT = 10.0  # metres; a policy sees larger distances by their logarithm

Turn = Callable[[jax.Array, jax.Array], jax.Array]  # ([..., D], angle [...]) -> [..., D]


class Torso(NamedTuple):
    """Functions of the observations [..., D] of a robot with a floating torso."""

    num_seen: int  # heading_inputs uses this many entries, from the first
    flipped: Callable[[jax.Array], jax.Array]  # -> [...] bool: upside down
    heading_inputs: Callable[[jax.Array], jax.Array]  # -> [..., I], see heading_inputs
    rotate: Turn  # turns the world, see rotate; also takes the first num_seen entries alone


def make(num_positions: int, num_velocities: int, rotate_derived: Turn | None = None) -> Torso:
    """Returns the Torso for observations that begin with positions and velocities.

    Args:
      num_positions: how many positions.
      num_velocities: how many velocities.
      rotate_derived: turns the entries after them, [..., D - num_positions - num_velocities].
    """
    num_seen = num_positions + num_velocities

    def rotate_all(observation: jax.Array, angle: jax.Array) -> jax.Array:
        turned = rotate(observation[..., :num_seen], angle, num_positions)
        if rotate_derived is None or observation.shape[-1] == num_seen:
            return turned
        derived = rotate_derived(observation[..., num_seen:], angle)
        return jnp.concatenate([turned, derived], axis=-1)

    return Torso(
        num_seen=num_seen,
        flipped=flipped,
        heading_inputs=functools.partial(
            heading_inputs, num_positions=num_positions, num_velocities=num_velocities
        ),
        rotate=rotate_all,
    )


def up_axis(observation: jax.Array) -> jax.Array:
    """Returns the torso's vertical axis in the world's axes, [..., D] -> [..., 3]."""
    w, x, y, z = _quaternion(observation)
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)


def flipped(observation: jax.Array) -> jax.Array:
    """Returns whether the torso is upside down, [..., D] -> [...] bool; it may still be healthy."""
    return up_axis(observation)[..., 2] < 0


def heading_inputs(observation: jax.Array, num_positions: int, num_velocities: int) -> jax.Array:
    """Returns the state in the robot's own horizontal frame, where walking looks alike everywhere.

    [..., D] -> [..., 5 + num_positions + num_velocities]: position, position seen from the heading,
    direction outward, heading, height, up-axis, velocities and joints. A distance ρ from the
    origin enters as log(1 + ρ / POSITION_UNIT), so that a state farther out than any before looks
    almost familiar to a policy. Entries after positions and velocities are left out.
    """
    w, x, y, z = _quaternion(observation)
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    position = observation[..., :2]
    seen = turn_vector(position, -yaw)
    radius = jnp.linalg.norm(position, axis=-1, keepdims=True)
    shrink = jnp.log1p(radius / POSITION_UNIT) / jnp.maximum(radius, 1e-6)
    up = up_axis(observation)
    velocity = observation[..., num_positions : num_positions + num_velocities]
    return jnp.concatenate(
        [
            shrink * position,
            shrink * seen,
            seen / (radius + 0.1),  # bounded, and continuous at the origin
            jnp.stack([jnp.sin(yaw), jnp.cos(yaw)], -1),
            observation[..., 2:3],
            turn_vector(up, -yaw),
            turn_vector(velocity[..., :3], -yaw),
            observation[..., 7:num_positions],
            velocity[..., 3:],
        ],
        axis=-1,
    )


def rotate(observation: jax.Array, angle: jax.Array, num_positions: int) -> jax.Array:
    """Returns the state with the world turned about the vertical at the origin.

    This is a symmetry of the dynamics: the same actions lead from turned states to turned states.
    Where the torso itself touches the ground, only quarter turns are, since MuJoCo's friction
    pyramid at a sphere lies along the world's axes.

    Args:
      observation: [..., num_positions + num_velocities].
      angle: [...] radians.
      num_positions: how many entries are positions.
    Returns:
      The turned observation, of the same shape.
    """
    half_cos, half_sin = jnp.cos(angle / 2), jnp.sin(angle / 2)
    w, x, y, z = _quaternion(observation)
    turned = jnp.stack(
        [
            half_cos * w - half_sin * z,
            half_cos * x - half_sin * y,
            half_cos * y + half_sin * x,
            half_cos * z + half_sin * w,
        ],
        axis=-1,
    )
    velocity = observation[..., num_positions:]
    return jnp.concatenate(
        [
            turn_vector(observation[..., :3], angle),
            turned,
            observation[..., 7:num_positions],
            turn_vector(velocity, angle),
        ],
        axis=-1,
    )


def _quaternion(observation: jax.Array) -> tuple[jax.Array, ...]:
    """w, x, y, z of unit length: MuJoCo keeps the reset noise in it until the first step."""
    quaternion = observation[..., 3:7]
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    return tuple(jnp.moveaxis(quaternion, -1, 0))


def turn_vector(vector: jax.Array, angle: jax.Array) -> jax.Array:
    """Turns the first two entries of vectors, and keeps the others.

    Args:
      vector: [..., 2 or more].
      angle: [...] radians.
    Returns:
      The turned vector, of the same shape.
    """
    x, y = vector[..., 0], vector[..., 1]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    horizontal = jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return jnp.concatenate([horizontal, vector[..., 2:]], axis=-1)
