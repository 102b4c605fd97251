"""The components of a config: what it makes once and every step uses."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import envs, intrinsic, rewards, tasks
from maxent_jax.config import Config, registry
from maxent_jax.config import tasks as task_names
from maxent_jax.density.histogram import Grid
from maxent_jax.envs import skills
from maxent_jax.envs.base import Env
from maxent_jax.envs.entries import Entry
from maxent_jax.envs.torso import Torso
from maxent_jax.errors import ConfigError, ConfigTypeError
from maxent_jax.features import make_feature_map
from maxent_jax.intrinsic import Bonus, Setting
from maxent_jax.precision import in_32_bits
from maxent_jax.sac import agent
from maxent_jax.types import Features


class Components(NamedTuple):
    """Static: no component changes during a run or depends on a config's data fields."""

    config: Config
    env: Env
    grid: Grid
    torso: Torso | None
    num_seen: int  # the networks see this many entries of a state, from the first
    sac: agent.Sac
    phi: Features
    bonus: Bonus | None = None
    task: tasks.Task | None = None

    @property
    def in_metres(self) -> bool:
        """Whether the grid's coordinates are metres, so that unit cells mean something."""
        return registry.environment(self.config.env).in_metres

    def unshaped_reward(self, distance: jax.Array) -> jax.Array:
        """Returns r_t of states at a distance from the reference, [...] -> [...]."""
        own = self.config.intrinsic
        return rewards.of_distance(distance, own.reward, own.reward_distance, len(self.phi.names))


@in_32_bits
def make(config: Config) -> Components:
    """Returns the components of the config's program; each program makes them once."""
    return _make(config.program())


@functools.lru_cache(maxsize=8)
def _make(config: Config) -> Components:
    with jax.ensure_compile_time_eval():  # the first call may come during a trace
        env = _make_env(config)
    num_dims = _num_dims(config.env, env)  # outside, where no operation of a reset is compiled
    with jax.ensure_compile_time_eval():
        found = _make_around(config, env, num_dims)
    registry.in_use.update({("environment", config.env), ("bonus", config.intrinsic.bonus)})
    return found


def _make_env(config: Config) -> Env:
    deviations: dict[str, Any] = {}
    if registry.environment(config.env).is_robot:
        deviations = {name: config[name] for name in envs.DEVIATIONS}
    own = config.environment
    return envs.entry(config.env).make(own.backend, own.physics, **deviations)


def _num_dims(name: str, env: Env) -> int:
    """D of an environment, from shapes alone.

    Raises:
      ConfigError: a user's `make` returned none, or one with states that cannot be trained on.
    """
    if not isinstance(env, Env):
        raise ConfigTypeError(f"{name} is {env!r}, but its `make` must return a brax Env.")
    observation = jax.eval_shape(env.reset, jax.random.key(0)).obs
    shape = getattr(observation, "shape", None)  # brax also knows dictionaries
    if shape is None or len(shape) != 1 or shape[0] < 2:
        what = "no array" if shape is None else f"an array {list(shape)}"
        raise ConfigError(
            f"an observation of {name} is {what}, but must be an array [D], D at least 2."
        )
    return shape[0]


def _check_maps(name: str, phi: Features, grid: Grid, num_dims: int) -> None:
    """Raises ConfigError unless a user's feature map and grid fit the states [num_dims]."""
    state = jax.ShapeDtypeStruct((num_dims,), jnp.float32)
    located = jax.eval_shape(grid.transform or (lambda s: s), state).shape
    if max(grid.coordinates) >= located[-1]:
        raise ConfigError(
            f"the grid of {name} has coordinates {grid.coordinates}, but there are {located[-1]}."
        )
    found = jax.eval_shape(phi, state).shape
    if found != (len(phi.names),):
        raise ConfigError(
            f"phi of {name} returns features {list(found)}, but has {len(phi.names)} names."
        )


def _make_around(config: Config, env: Env, num_dims: int) -> Components:
    """The components, given the environment without skills, whose states are [num_dims]."""
    entry = envs.entry(config.env)
    phi, grid = make_feature_map(config.env, num_dims), entry.grid
    if registry.is_users(config.env):
        _check_maps(config.env, phi, grid, num_dims)
    if size := config.environment.skill_size:
        env, phi = skills.WithSkill(env, size), skills.BareFeatures(phi, size)
        grid, num_dims = skills.bare_grid(grid, size), num_dims + size
    num_seen, inputs = num_dims, lambda observation: observation
    if config.learner.policy_inputs == "heading":
        assert entry.torso is not None  # checked by Config
        inputs, num_seen = entry.torso.heading_inputs, entry.torso.num_seen
    sac = agent.make(config, num_dims, env.action_size, inputs)
    bonus = None
    if config.intrinsic.bonus != "none":
        setting = Setting(
            num_features=len(phi.names),
            action_size=env.action_size,
            scale=_units(config, entry, len(phi.names)),
            learning_rate=config.learner.learning_rate,
            num_cells=grid.num_cells,
            state_size=num_seen - size,
            skill_size=size,
            hidden_size=config.learner.hidden_size,
        )
        bonus = intrinsic.make(config.intrinsic.bonus, setting)
    found = Components(config, env, grid, entry.torso, num_seen, sac, phi, bonus)
    return with_task(found, config.downstream.task)


@functools.lru_cache(maxsize=8)
def with_task(components: Components, name: str) -> Components:
    """Returns the components with the task of a name; with `none`, without a task.

    Raises:
      ConfigError: a user's task does not give each transition one reward.
    """
    if name == task_names.NONE:
        return components._replace(task=None)
    task = tasks.make(name, components.config.env, components.env)
    size = components.config.environment.skill_size
    if name in task_names.USERS:
        num_dims = components.sac.observation_size - size
        _check_reward(name, task.reward, num_dims, components.sac.action_size)
    if size and task.reward:
        task = task._replace(reward=skills.bare_reward(task.reward, size))
    registry.in_use.add(("task", name))
    return components._replace(task=task)


def _check_reward(name: str, reward: Any, num_dims: int, num_actions: int) -> None:
    """Raises ConfigError unless a user's reward maps transitions with any leading axes to [...]."""
    lead = (3, 2)
    state, action = (
        jax.ShapeDtypeStruct((*lead, size), jnp.float32) for size in (num_dims, num_actions)
    )
    found = getattr(jax.eval_shape(reward, state, action, state), "shape", None)
    if found != lead:
        what = "no array" if found is None else f"an array {list(found)}"
        raise ConfigError(
            f"the reward of task {name} is {what} for transitions {list(lead)}, but must have the "
            f"same shape: one number for each."
        )


def _units(config: Config, entry: Entry, num_features: int) -> jax.Array:
    """[F] the units of a bonus: an eighth of the grid's side for features in metres, else 1."""
    sides, grid = [1.0, 1.0], entry.grid
    of_grid = entry.phi is None and grid.coordinates == (0, 1) and grid.transform is None
    if of_grid and registry.environment(config.env).in_metres:
        sides = [(high - low) / 8 for low, high in zip(grid.low, grid.high, strict=True)]
    return jnp.asarray((sides + [1.0] * num_features)[:num_features])
