"""The task rewards by name: which environments have them, and what numbers they take.

A name is that of a family, followed by its numbers if it has any: `stand`, `run:90`, `goal:15,0`.
`user:NAME` is a reward that was added by `maxent_jax.tasks.register`. Loads no array library.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from maxent_jax.checks import check_choice
from maxent_jax.config import registry
from maxent_jax.config.registry import ENVS, MUJOCO_ENVS
from maxent_jax.errors import ConfigError, ConfigTypeError

NONE, OWN = "none", "environment"


class Family(NamedTuple):
    """Tasks that differ in a few numbers."""

    envs: tuple[str, ...]
    numbers: tuple[str, ...] = ()  # "place" stands for the coordinates that the robot has
    defaults: tuple[float, ...] = ()  # of the last numbers
    sparse: bool = False  # 0 or 1: an episode with a reward is a success
    settings: Mapping[str, Any] = MappingProxyType({})  # what the task needs


_ON_A_PLANE = ("ant", "humanoid")

# docs/how-to/finetune.md describes each reward.
FAMILIES = {
    "gymnasium": Family(ENVS),
    "forward": Family(MUJOCO_ENVS),
    "backward": Family(MUJOCO_ENVS),
    "run": Family(_ON_A_PLANE, ("degrees",)),
    "reach": Family(MUJOCO_ENVS, ("place",)),
    "goal": Family(MUJOCO_ENVS, ("place", "radius"), defaults=(2.0,), sparse=True),
    "stand": Family(MUJOCO_ENVS),
    "jump": Family(MUJOCO_ENVS),
    "flip": Family(("walker2d",), settings={"end_unhealthy": False}),
    OWN: Family(()),  # of every environment that is not one of ENVS
}


class Task(NamedTuple):
    """A task reward of one environment."""

    family: str
    numbers: tuple[float, ...]
    sparse: bool
    settings: Mapping[str, Any]


class _Users(NamedTuple):
    reward: Callable[..., Any]
    sparse: bool


USERS: dict[str, _Users] = {}
"""The rewards that `maxent_jax.tasks.register` added, by "user:NAME"."""


def parse(name: str, env: str) -> Task:
    """Returns the task of a name in an environment; a "user:" name need not be registered yet.

    Raises:
      ConfigError: the task is unknown, of another environment, or has wrong numbers.
    """
    if registry.is_users(name):
        known = USERS.get(name)
        return Task(name, (), known is not None and known.sparse, {})
    kind, _, text = name.partition(":")
    check_choice("task", kind, FAMILIES)
    family = FAMILIES[kind]
    if not _has(env, kind):
        raise ConfigError(f"task is {name}, but {env} has only: {', '.join(of_environment(env))}.")
    names = _names(family, env)
    try:
        numbers = tuple(float(word) for word in text.split(",")) if text else ()
    except ValueError:
        numbers = (float("nan"),) * len(names)
    usable = all(abs(number) < float("inf") for number in numbers)
    missing = len(names) - len(numbers)
    if not usable or not 0 <= missing <= len(family.defaults):
        with_them = "with numbers" if names else "without numbers"
        raise ConfigError(f"task is {name}, but must be {_form(kind, env)}, {with_them}.")
    numbers += family.defaults[len(family.defaults) - missing :]
    if kind == "goal" and numbers[-1] <= 0:
        raise ConfigError(f"task is {name}, but its radius must be a positive number.")
    return Task(kind, numbers, family.sparse, family.settings)


def of_environment(env: str) -> list[str]:
    """Returns the forms of the names of an environment's tasks, such as goal:X,Y,RADIUS."""
    forms = [_form(kind, env) for kind in FAMILIES if _has(env, kind)]
    return [*forms, "user:NAME"]


def _has(env: str, kind: str) -> bool:
    return env not in ENVS if kind == OWN else env in FAMILIES[kind].envs


def settings(name: str, env: str) -> Mapping[str, Any]:
    """Returns the settings that a task needs; none for `none`."""
    return {} if name == NONE else parse(name, env).settings


def _names(family: Family, env: str) -> tuple[str, ...]:
    place = ("x", "y") if env in _ON_A_PLANE else ("x",)
    return tuple(n for name in family.numbers for n in (place if name == "place" else (name,)))


def _form(kind: str, env: str) -> str:
    names = _names(FAMILIES[kind], env)
    return kind + (":" + ",".join(names).upper() if names else "")


def check_registered(name: str) -> None:
    """Raises ConfigError if the task begins with "user:" and is not registered."""
    if registry.is_users(name) and name not in USERS:
        raise registry.not_registered("task", name)


def register(name: str, reward: Callable[..., Any], sparse: bool) -> None:
    """Adds a reward of a user; see maxent_jax.tasks.register.

    Raises:
      ConfigError: the name is already in use, or the reward is not a function.
    """
    registry.check_name("task", name)
    if not callable(reward):
        raise ConfigTypeError(f"reward is {reward!r}, but must be a function.")
    USERS[f"{registry.USER}{name}"] = _Users(reward, sparse)
