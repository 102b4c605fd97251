"""A robot whose torso floats free: which way is up, how it looks from its own heading, and turns.

An observation begins with qpos, whose first seven entries are the torso's position and quaternion
(w, x, y, z), and qvel, whose first six are its velocity in the world's axes and its angular
velocity in its own.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

POSITION_UNIT = 10.0  # metres; a policy sees distances beyond it by their logarithm

Turn = Callable[[jax.Array, jax.Array], jax.Array]  # ([..., D], angle [...]) -> [..., D]


class Torso(NamedTuple):
    """What a floating torso offers beside its observation [..., D]."""

    num_seen: int  # entries of it, the first ones, that heading_inputs looks at
    flipped: Callable[[jax.Array], jax.Array]  # -> [...] bool: upside down
    heading_inputs: Callable[[jax.Array], jax.Array]  # -> [..., I], see heading_inputs
    rotate: Turn  # turns the world, see rotate; also takes the first num_seen entries alone


def make(num_positions: int, num_velocities: int, rotate_derived: Turn | None = None) -> Torso:
    """For an observation that begins with so many positions and velocities.

    Args:
      rotate_derived: turns what is observed beyond them, [..., D - positions - velocities].
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
    """[..., 3]: the torso's own vertical in the world's axes."""
    w, x, y, z = _quaternion(observation)
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)


def flipped(observation: jax.Array) -> jax.Array:
    """The torso's up-axis points down; health, a range of heights, need not notice."""
    return up_axis(observation)[..., 2] < 0


def heading_inputs(observation: jax.Array, num_positions: int, num_velocities: int) -> jax.Array:
    """The same state in the robot's own horizontal frame, where walking looks alike everywhere.

    Returns [..., 5 + num_positions + num_velocities]: position, position seen from the heading,
    direction outward, heading, height, up-axis, velocities and joints. A distance ρ from the
    origin enters as log(1 + ρ / POSITION_UNIT): a policy meets a state farther out than it has been
    as nearly one that it knows. What is observed beyond positions and velocities is left out.
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
    """The state with the world turned by `angle` [...] radians about the vertical at the origin.

    A symmetry of the dynamics: the same actions lead from turned states to turned states. Where
    the torso itself touches the ground it is one for quarter turns only, since MuJoCo's pyramid
    of friction at a sphere lies along the world's axes.
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
    """w, x, y, z of unit length; MuJoCo keeps the reset noise in it until the first step."""
    quaternion = observation[..., 3:7]
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    return tuple(jnp.moveaxis(quaternion, -1, 0))


def turn_vector(vector: jax.Array, angle: jax.Array) -> jax.Array:
    """[..., 2 or more]: the first two turned by an angle [...] in radians, the others as before."""
    x, y = vector[..., 0], vector[..., 1]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    horizontal = jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return jnp.concatenate([horizontal, vector[..., 2:]], axis=-1)
