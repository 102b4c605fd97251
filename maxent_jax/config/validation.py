"""Checks the settings of a run one by one. Loads no array library."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from maxent_jax.checks import check_choice, check_number, check_whole
from maxent_jax.config import compatibility, names, presets, registry, tasks
from maxent_jax.config.compatibility import MOST
from maxent_jax.config.registry import BY_METHOD
from maxent_jax.errors import ConfigError, ConfigTypeError

_CHOICES = {
    "mixing": names.MIXINGS,
    "preset": presets.PRESETS,
    "protocol": presets.PROTOCOLS,
    "reward": names.REWARDS,
    "policy_inputs": names.INPUTS,
    "shaping_space": names.SPACES,
    "replay_dtype": names.REPLAY_DTYPES,
    "weights": names.WEIGHTS,
    "reference": names.REFERENCES,
    "start": names.STARTS,
    "start_from": names.STARTED_FROM,
}
_AT_LEAST_ONE = (
    *("num_seeds", "num_iterations", "steps_per_iteration", "num_envs", "num_segments"),
    *("snapshots", "first_episodes"),
    *("episode_length", "num_starts", "num_neighbors", "reference_size", "mixture_episodes"),
    *("hidden_layers", "hidden_size", "batch_size", "replay_size", "return_steps"),
)
# Each is the length of an unrolled loop: the program grows with it.
_UNROLLED = {"hidden_layers": 64, "num_neighbors": 256, "return_steps": 256}
_POSITIVE = (
    *("updates_per_step", "torque_limit", "reward_distance", "reward_scale", "learning_rate"),
    *("soft_update_rate", "initial_temperature", "eta", "task_scale"),
)
_AT_MOST_ONE = (
    *("torque_limit", "discount", "soft_update_rate", "eta", "actor_average", "restart_share"),
    "cell_restarts",
)
_NOT_NEGATIVE = (
    *("seed", "plateau_segments", "plateau_tolerance", "shaping", "episodic_weight"),
    *("alive_bonus", "actor_average"),
    *("intrinsic_weight", "intrinsic_decay", "source_seed", "source_iterations"),
    *("critic_steps", "restart_share", "cell_restarts"),
    *("yaw_copies", "discount", "target_entropy_scale", "policy_lag", "skill_size"),
)


_TYPES: dict[Any, tuple[Callable[[str, Any], Any], str]] = {
    int: (check_whole, "a whole number"),
    float: (check_number, "a number"),
}


def of_type(name: str, value: Any, kind: Any) -> Any:
    """Returns the value, which may be numpy's or jax's, as that Python type.

    Raises:
      ConfigTypeError: the value has another type.
    """
    flag = _flag(name)
    if kind in _TYPES:
        convert, what = _TYPES[kind]
        try:
            return convert(flag, value)
        except TypeError:
            raise ConfigTypeError(f"{flag} is {value!r}, but must be {what}.") from None
    if kind is bool and str(getattr(value, "dtype", "")) == "bool":
        return bool(value)
    if not isinstance(value, kind):
        what = "True or False" if kind is bool else "a string"
        raise ConfigTypeError(f"{flag} is {value!r}, but must be {what}.")
    return value


def check(env: str, method: str, settings: Mapping[str, Any]) -> None:
    """Rejects settings that are invalid, alone or together.

    Raises:
      ConfigError: a setting is invalid; the message names the first.
    """
    row = registry.environment(env)
    if not registry.is_users(method):
        check_choice("method", method, registry.METHODS)
    if not registry.is_users(settings["bonus"]):
        check_choice("bonus", settings["bonus"], ("none", *registry.BONUSES))
    check_physics(env, settings["backend"], settings["physics"])
    for name, known in _CHOICES.items():
        check_choice(_flag(name), settings[name], known)
    bounds = (
        (_AT_LEAST_ONE, lambda x: x >= 1, "at least 1"),
        (_POSITIVE, lambda x: 0 < x < float("inf"), "a positive number"),
        (_AT_MOST_ONE, lambda x: x <= 1, "at most 1"),
        (_NOT_NEGATIVE, lambda x: 0 <= x < float("inf"), "0 or more"),
        (("refresh_period",), lambda x: x >= BY_METHOD, "-1, 0 or more"),
    )
    for bounded, holds, requirement in bounds:
        for name in bounded:
            if not holds(settings[name]):
                raise ConfigError(f"{_flag(name)} is {settings[name]}, but must be {requirement}.")
    for name, value in settings.items():
        most = _UNROLLED.get(name, MOST)
        if isinstance(value, int) and value > most:
            raise ConfigError(f"{_flag(name)} is {value}, but must be at most {most}.")
    if settings["task"] != tasks.NONE:
        tasks.parse(settings["task"], env)
    for sentence in compatibility.problems(SimpleNamespace(**settings), row):
        raise ConfigError(sentence)


def check_physics(env: str, backend: str, physics: str) -> None:
    """Raises ConfigError if the environment does not have the backend or the physics."""
    row = registry.environment(env)
    check_choice("backend", backend, registry.BACKENDS)
    check_choice("physics", physics, registry.PHYSICS)
    for name, value, known in (
        ("backend", backend, row.backends),
        ("physics", physics, row.physics),
    ):
        if value not in known:
            raise ConfigError(f"{name} is {value}, but {env} has only: {', '.join(known)}.")


def _flag(name: str) -> str:
    return name.replace("_", "-")
