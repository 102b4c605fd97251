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
from maxent_jax.envs.physics import PhysicsState
from maxent_jax.envs.task import Task

HEALTHY_HEIGHT = (0.2, 1.0)  # metres, Ant-v4
RESET_NOISE = 0.1  # Ant-v4: uniform in qpos, standard deviation in qvel
POSITION_UNIT = 10.0  # metres that count as 1 among the policy's inputs
NUM_POSITIONS = 15


def reset(key: jax.Array, rest: PhysicsState) -> PhysicsState:
    """Ant-v4's start: the rest pose with noise in every coordinate."""
    key_qpos, key_qvel = jax.random.split(key)
    noise = jax.random.uniform(key_qpos, rest.qpos.shape, minval=-RESET_NOISE, maxval=RESET_NOISE)
    velocity = RESET_NOISE * jax.random.normal(key_qvel, rest.qvel.shape)
    return rest._replace(qpos=rest.qpos + noise, qvel=velocity)


def observe(state: PhysicsState) -> jax.Array:
    return jnp.concatenate([state.qpos, state.qvel], axis=-1)


def healthy(observation: jax.Array) -> jax.Array:
    low, high = HEALTHY_HEIGHT
    height = observation[..., 2]
    return jnp.isfinite(observation).all(-1) & (height >= low) & (height <= high)


def up_axis(observation: jax.Array) -> jax.Array:
    """[..., 3]: the torso's own vertical in the world's axes."""
    w, x, y, z = _quaternion(observation)
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)


def flipped(observation: jax.Array) -> jax.Array:
    """The torso's up-axis points down; health, a range of heights, does not notice."""
    return up_axis(observation)[..., 2] < 0


def heading_inputs(observation: jax.Array) -> jax.Array:
    """The same state in the ant's own horizontal frame, where walking looks alike everywhere.

    Returns [..., 34]: position, position seen from the heading, direction outward, heading,
    height, up-axis, velocities and joints; lengths of tens of metres are brought to order 1.
    """
    w, x, y, z = _quaternion(observation)
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    position = observation[..., :2]
    seen = _turn(position, -yaw)
    radius = jnp.sqrt(jnp.sum(position**2, -1, keepdims=True))
    up, velocity = up_axis(observation), observation[..., 15:18]
    return jnp.concatenate(
        [
            position / POSITION_UNIT,
            seen / POSITION_UNIT,
            seen / (radius + 0.1),  # bounded, and continuous at the origin
            jnp.stack([jnp.sin(yaw), jnp.cos(yaw)], -1),
            observation[..., 2:3],
            _turn(up[..., :2], -yaw),
            up[..., 2:],
            _turn(velocity[..., :2], -yaw),
            velocity[..., 2:],
            observation[..., 7:15],
            observation[..., 18:],
        ],
        axis=-1,
    )


def rotate(observation: jax.Array, angle: jax.Array) -> jax.Array:
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
    return jnp.concatenate(
        [
            _turn(observation[..., :2], angle),
            observation[..., 2:3],
            turned,
            observation[..., 7:15],
            _turn(observation[..., 15:17], angle),
            observation[..., 17:],
        ],
        axis=-1,
    )


def _quaternion(observation: jax.Array) -> tuple[jax.Array, ...]:
    """w, x, y, z of unit length; MuJoCo keeps the reset noise in it until the first step."""
    quaternion = observation[..., 3:7]
    quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    return tuple(jnp.moveaxis(quaternion, -1, 0))


def _turn(vector: jax.Array, angle: jax.Array) -> jax.Array:
    x, y = vector[..., 0], vector[..., 1]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


TASK = Task(
    name="ant",
    xml="ant.xml",
    frame_skip=5,
    reset=reset,
    observe=observe,
    healthy=healthy,
    flipped=flipped,
    heading_inputs=heading_inputs,
    rotate=rotate,
    grid=Grid(coordinates=(0, 1), low=(-40.0, -40.0), high=(40.0, 40.0), bins=(100, 100)),
)
