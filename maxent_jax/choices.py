"""The names that settings are chosen by, and the refusal of others. Loads no array library."""

import difflib
import operator
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

MUJOCO_ENVS = ("ant", "walker2d", "humanoid")
CLASSIC_ENVS = ("pendulum", "mountain_car")
ENVS = MUJOCO_ENVS + CLASSIC_ENVS
BRAX_ENVS = (
    *("ant", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum"),
    *("inverted_double_pendulum", "pusher", "reacher", "swimmer", "walker2d"),
)
TORSO_ENVS = ("ant", "humanoid")  # a floating torso has a heading, turns, can be upside down
BONUSES = ("rnd", "icm", "ngu", "re3", "rise", "renyi", "vcse", "kmeans", "apt", "histogram")
BASELINES = BONUSES[:-1]  # methods that one policy learns, paid by the bonus of that name
NEIGHBORS = {"re3": 3, "rise": 5, "renyi": 5, "vcse": 12, "apt": 12}  # k, within a batch
METHODS = ("h", "la", "v", "h-official", *BASELINES)
BACKENDS = ("auto", "mjx", "mujoco", "warp")
PHYSICS = ("reference", "fast")
REWARDS = ("log1p", "linear", "log", "paper")
INPUTS = ("state", "heading")
SPACES = ("features", "position")
REPLAY_DTYPES = ("float32", "float16")
CORRECTIVE = "fully_corrective"
WEIGHTS = ("method", "uniform", "geometric", "last", CORRECTIVE)
MIXINGS = ("episode", "step")
REFERENCES = ("method", "mixture", "history")
STARTS = ("method", "scratch", "last", "best")
BY_METHOD = -1


class UsageError(ValueError):
    """A command line that asks for something impossible; the message is one sentence."""


class ConfigError(ValueError):
    """A setting that no run can have; the message says which, and what to do."""


class ConfigTypeError(ConfigError, TypeError):
    """A setting of the wrong type, or one that does not exist."""


def check_whole(name: str, value: Any, least: int | None = None) -> int:
    """The value as an int.

    Raises:
      TypeError: it is no whole number.
      ValueError: it is below the least.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        whole = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {value!r}, but must be a whole number") from None
    if least is not None and whole < least:
        raise ValueError(f"{name} is {value}, but must be at least {least}")
    return whole


def check_number(name: str, value: Any) -> float:
    """The value as a float.

    Raises:
      TypeError: it is no real number.
    """
    try:
        if isinstance(value, str | bytes | bool):
            raise TypeError
        return float(value)
    except (TypeError, OverflowError):
        raise TypeError(f"{name} is {value!r}, but must be a number") from None


def check_path(name: str, value: Any) -> Path:
    """The value as a Path.

    Raises:
      TypeError: it is neither a string nor a path.
    """
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name} is {value!r}, but must be a string or a pathlib.Path")
    return Path(value)


def check_env(name: str) -> None:
    """Raises ConfigError unless an environment can have that name."""
    names = (*ENVS, *(f"brax:{env}" for env in BRAX_ENVS))
    if not (isinstance(name, str) and name.startswith("user:")):
        check_choice("env", name, names)


def check_physics(env: str, backend: str, physics: str) -> None:
    """Raises ConfigError where the environment has no such backend or physics."""
    check_choice("backend", backend, BACKENDS)
    check_choice("physics", physics, PHYSICS)
    if env in MUJOCO_ENVS or env.startswith("user:"):
        return
    backends = ("auto",) if env in CLASSIC_ENVS else ("auto", "mjx")
    if backend not in backends:
        raise ConfigError(f"backend is {backend}, but {env} has only: {', '.join(backends)}.")
    if physics != "reference":
        raise ConfigError(f"physics is {physics}, but {env} has only: reference.")


def check_choice(what: str, value: str, known: Collection[str]) -> None:
    """Raises ConfigError unless the value is among the known ones; it names the nearest."""
    if isinstance(value, str) and value in known:
        return
    shown = f"'{value[:80]}'" if isinstance(value, str) else repr(value)[:80]
    nearest = difflib.get_close_matches(shown.strip("'"), known, n=1, cutoff=0.4)
    hint = f"did you mean '{nearest[0]}'?" if nearest else f"choose one of {', '.join(known)}."
    raise ConfigError(f"unknown {what} {shown}: {hint}")
