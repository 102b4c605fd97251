"""Task rewards, for runs that have a task.

A task is a pure function of a transition (observation, action, next observation), so transitions
that were collected for one task can be rewarded for another. The exception is `environment`: the
reward that an environment of brax, Playground or the user returns itself. The names are those of
`config.tasks.FAMILIES`.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from maxent_jax.config import tasks as names
from maxent_jax.config.registry import MUJOCO_ENVS
from maxent_jax.envs import mjx_backend, mountain_car, pendulum
from maxent_jax.envs import torso as torsos
from maxent_jax.envs.base import Env
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.precision import in_32_bits

REACH_SCALE = 5.0  # metres, at which the dense reward of a place has fallen to 1/e


class Reward(Protocol):
    """A reward as a function of transitions."""

    def __call__(
        self, observation: jax.Array, action: jax.Array, next_observation: jax.Array, /
    ) -> jax.Array:
        """Rewards transitions: [..., D], [..., A] in [-1, 1], [..., D] -> [...]."""


class Task(NamedTuple):
    """A task of an environment."""

    reward: Reward | None  # None: the environment's own
    sparse: bool  # the reward is 0 or 1, and an episode with a 1 is a success

    def pay(
        self,
        observation: jax.Array,
        action: jax.Array,
        next_observation: jax.Array,
        own: jax.Array,
    ) -> jax.Array:
        """Rewards transitions.

        Args:
          observation: [..., D] the state left.
          action: [..., A] in [-1, 1].
          next_observation: [..., D] the state reached.
          own: [...] the environment's own reward.
        Returns:
          The rewards [...].
        """
        return own if self.reward is None else self.reward(observation, action, next_observation)


def register(name: str, reward: Reward, sparse: bool = False) -> None:
    """Registers a user's task as `user:NAME`.

    Args:
      name: NAME.
      reward: a pure jax function of transitions, for any leading axes, see Reward.
      sparse: whether the reward is 0 or 1, and an episode with a 1 is a success.
    Raises:
      ConfigError: the name is already in use in this process.
      ConfigTypeError (a ValueError and a TypeError): an argument has the wrong type.
    """
    names.register(name, reward, sparse)


@in_32_bits
def make(name: str, env_name: str, env: Env) -> Task:
    """Makes the task of a name.

    Args:
      name: as in `config.tasks`.
      env_name: the name of the environment.
      env: the environment; rewards use its time step and control range.
    Raises:
      ConfigError: the environment has no such task, or it is not registered.
    """
    task = names.parse(name, env_name)
    names.check_registered(name)
    if name in names.USERS:
        return Task(names.USERS[name].reward, task.sparse)
    if task.family == names.OWN:
        return Task(None, task.sparse)
    if env_name not in MUJOCO_ENVS:
        return Task(_CLASSIC[env_name], task.sparse)
    robot = env.unwrapped
    assert isinstance(robot, MujocoEnv)
    return Task(_FAMILIES[task.family](_ROBOTS[env_name], robot, *task.numbers), task.sparse)


class _Robot(NamedTuple):
    """Where a robot's observation has what tasks read."""

    axes: tuple[int, ...]  # entries of its position in the plane, metres
    height: int  # entry of the torso's height, metres
    velocity: slice  # of the torso, metres per second, the vertical included
    upright: Callable[[jax.Array], jax.Array]  # [..., D] -> [...] cosine with the vertical
    forward: float  # Gymnasium's weight of the forward velocity
    survival: float  # Gymnasium's reward of a step
    effort: float  # Gymnasium's weight of the squared controls


def _upright_torso(observation: jax.Array) -> jax.Array:
    return torsos.up_axis(observation)[..., 2]


_ROBOTS = {
    "ant": _Robot((0, 1), 2, slice(15, 18), _upright_torso, 1.0, 1.0, 0.5),
    "humanoid": _Robot((0, 1), 2, slice(24, 27), _upright_torso, 1.25, 5.0, 0.1),
    "walker2d": _Robot((0,), 1, slice(9, 11), lambda s: jnp.cos(s[..., 2]), 1.0, 1.0, 1e-3),
}


def _gymnasium(robot: _Robot, env: MujocoEnv) -> Reward:
    """The reward of Gymnasium's v4 tasks: forward velocity, survival, and effort.

    Survival is also rewarded in the step that ends an episode. Where health ends no episode, only
    healthy states are rewarded for it. The velocity is that of the torso,
    in Humanoid that of the centre of mass, between two steps. In Ant and Humanoid, Gymnasium reads
    positions that MuJoCo computed within the last step of the integrator; here they are those of
    the state reached.
    """
    place = lambda observation: observation[..., 0]
    if robot is _ROBOTS["humanoid"]:
        center = mjx_backend.center_of_mass(env.model)
        place = lambda observation: center(observation[..., : env.model.nq])[..., 0]

    def reward(observation, action, next_observation):
        velocity = (place(next_observation) - place(observation)) / env.dt
        effort = jnp.sum(env.control(action) ** 2, axis=-1)
        is_paid = True if env.end_unhealthy else env.task.healthy(next_observation)
        return robot.forward * velocity + robot.survival * is_paid - robot.effort * effort

    return reward


def _run(robot: _Robot, env: MujocoEnv, degrees: float) -> Reward:
    angle = jnp.deg2rad(degrees)
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)])[: len(robot.axes)]

    def reward(observation, action, next_observation):
        del action
        moved = _position(robot, next_observation) - _position(robot, observation)
        return jnp.matmul(moved, direction, precision="highest") / env.dt

    return reward


def _forward(robot: _Robot, env: MujocoEnv) -> Reward:
    return _run(robot, env, 0.0)


def _backward(robot: _Robot, env: MujocoEnv) -> Reward:
    return _run(robot, env, 180.0)


def _reach(robot: _Robot, env: MujocoEnv, *place: float) -> Reward:
    """Laid out as AntMaze's dense reward in D4RL, exp(-distance), which has a scale of 1 m."""
    del env
    return lambda observation, action, next_observation: jnp.exp(
        -_distance(robot, next_observation, place) / REACH_SCALE
    )


def _goal(robot: _Robot, env: MujocoEnv, *place_and_radius: float) -> Reward:
    del env
    *place, radius = place_and_radius

    def reward(observation, action, next_observation):
        del observation, action
        return (_distance(robot, next_observation, place) <= radius).astype(jnp.float32)

    return reward


def _stand(robot: _Robot, env: MujocoEnv) -> Reward:
    del env

    def reward(observation, action, next_observation):
        del observation, action
        speed = jnp.linalg.norm(next_observation[..., robot.velocity], axis=-1)
        return jnp.maximum(robot.upright(next_observation), 0.0) / (1.0 + speed)

    return reward


def _jump(robot: _Robot, env: MujocoEnv) -> Reward:
    rest = env.model.qpos0[robot.height]
    return lambda observation, action, next_observation: jnp.maximum(
        next_observation[..., robot.height] - rest, 0.0
    )


def _flip(robot: _Robot, env: MujocoEnv) -> Reward:
    del robot

    def reward(observation, action, next_observation):
        del action
        return (next_observation[..., 2] - observation[..., 2]) / env.dt

    return reward


_FAMILIES: dict[str, Callable[..., Reward]] = {
    "gymnasium": _gymnasium,
    "forward": _forward,
    "backward": _backward,
    "run": _run,
    "reach": _reach,
    "goal": _goal,
    "stand": _stand,
    "jump": _jump,
    "flip": _flip,
}


def _position(robot: _Robot, observation: jax.Array) -> jax.Array:
    return observation[..., jnp.asarray(robot.axes)]


def _distance(robot: _Robot, observation: jax.Array, place) -> jax.Array:
    position = _position(robot, observation)
    target = jnp.broadcast_to(jnp.asarray(place, position.dtype), position.shape)
    return jnp.linalg.norm(position - target, axis=-1)


def _of_pendulum(observation, action, next_observation):
    """Pendulum-v1: angle, angular velocity and torque cost, at the state that the step left."""
    del next_observation
    cos, sin, speed = jnp.moveaxis(observation, -1, 0)
    torque = pendulum.MAX_TORQUE * jnp.clip(action[..., 0], -1, 1)
    return -(jnp.arctan2(sin, cos) ** 2 + 0.1 * speed**2 + 0.001 * torque**2)


def _of_mountain_car(observation, action, next_observation):
    """MountainCarContinuous-v0: 100 at the goal, less the effort."""
    del observation
    reached = mountain_car.reached(next_observation)
    return 100.0 * reached - 0.1 * jnp.clip(action[..., 0], -1, 1) ** 2


_CLASSIC: dict[str, Reward] = {"pendulum": _of_pendulum, "mountain_car": _of_mountain_car}
