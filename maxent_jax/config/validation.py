"""Checks the settings of a run, one by one and together. Loads no array library."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from maxent_jax.checks import NUM_SEEDS, check_choice, check_number, check_whole
from maxent_jax.config import names, presets, registry, tasks
from maxent_jax.config.registry import BY_METHOD, CORRECTIVE, EnvironmentRow
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
MOST = 2**31 - 1  # rows and steps are counted in 32 bits
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
    for name in (*_AT_LEAST_ONE, "yaw_copies", "refresh_period"):
        most = _UNROLLED.get(name, MOST)
        if settings[name] > most:
            raise ConfigError(f"{_flag(name)} is {settings[name]}, but must be at most {most}.")
    if settings["task"] != tasks.NONE:
        tasks.parse(settings["task"], env)
    _check_together(SimpleNamespace(**settings), row)


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


def _check_together(c: SimpleNamespace, row: EnvironmentRow) -> None:
    group = c.num_envs * c.num_segments
    updates = c.updates_per_step * c.num_envs
    policies = 1 + c.num_iterations * c.snapshots
    for wrong, sentence in (
        (
            registry.bonus_of(c.method) not in (None, c.bonus),
            f"method is {c.method}, but bonus is {c.bonus}: leave bonus out, the method sets it.",
        ),
        (
            c.bonus != "none" and (c.return_steps > 1 or c.shaping > 0 or c.episodic_weight > 0),
            f"bonus is {c.bonus}, which rewards single steps: return-steps must be 1, and shaping "
            f"and episodic-weight must be 0.",
        ),
        (
            c.bonus != "none" and c.plateau_segments,
            f"plateau-segments is {c.plateau_segments}, but must be 0 with bonus {c.bonus}: a "
            f"plateau is judged by the distance to the reference.",
        ),
        (
            c.mixing == "step" and (c.pooled or c.leave_own_out or c.weights == CORRECTIVE),
            "mixing is step, so no state belongs to one policy: pooled, leave-own-out and fully "
            "corrective weights need mixing episode.",
        ),
        (
            c.mixing == "step" and c.start == "best",
            "mixing is step, so no state belongs to one policy: start best needs mixing episode.",
        ),
        (
            c.pooled and c.weights == CORRECTIVE,
            "pooled needs weights before the rollouts, and fully corrective weights come after.",
        ),
        (
            c.torque_limit < 1 and not row.is_robot,
            f"torque-limit is {c.torque_limit}, but must be 1: {c.env} has no torques to limit.",
        ),
        (
            c.end_flipped and not row.has_torso,
            f"end-flipped is on, but {c.env} has no floating torso that can be upside down.",
        ),
        (
            not c.end_unhealthy and not row.is_robot,
            f"end-unhealthy is off, but {c.env} has no health termination.",
        ),
        (
            c.policy_inputs == "heading" and not row.has_torso,
            f"policy-inputs is heading, but {c.env} has no floating torso with a heading.",
        ),
        (
            c.yaw_copies and not row.has_torso,
            f"yaw-copies is {c.yaw_copies}, but must be 0: {c.env} cannot turn about the vertical.",
        ),
        (
            c.skill_size and (c.policy_inputs != "state" or c.yaw_copies),
            f"skill-size is {c.skill_size}, but needs policy-inputs state and yaw-copies 0: a "
            f"skill does not turn with the state.",
        ),
        (
            c.bonus == registry.METRA and not c.skill_size,
            f"bonus is {c.bonus}, which rewards skills: skill-size must be at least 1.",
        ),
        (
            2 * c.plateau_segments > c.num_segments,
            f"plateau-segments is {c.plateau_segments}, but must be at most half of num-segments = "
            f"{c.num_segments}.",
        ),
        (
            c.steps_per_iteration % group,
            f"steps-per-iteration is {c.steps_per_iteration}, but must be a multiple of "
            f"num-envs × num-segments = {group}.",
        ),
        (
            updates < 0.5 or abs(updates - round(updates)) > 1e-6,
            f"updates-per-step × num-envs is {updates:g}, but must be a whole number above 0.",
        ),
        (
            c.seed + c.num_seeds > NUM_SEEDS,
            f"seed + num-seeds is {c.seed + c.num_seeds}, but must not exceed 2^31.",
        ),
        (
            c.num_iterations * c.steps_per_iteration > MOST,
            f"num-iterations × steps-per-iteration is {c.num_iterations * c.steps_per_iteration}, "
            f"but must be at most {MOST}: steps are counted in 32 bits.",
        ),
        (
            c.num_iterations * c.steps_per_iteration * c.updates_per_step > MOST,
            f"num-iterations × steps-per-iteration × updates-per-step is "
            f"{c.num_iterations * c.steps_per_iteration * c.updates_per_step:g}, but must be at "
            f"most {MOST}: gradient steps are counted in 32 bits.",
        ),
        (
            c.mixture_episodes * c.episode_length > MOST,
            f"mixture-episodes × episode-length is {c.mixture_episodes * c.episode_length}, but "
            f"must be at most {MOST}: states are counted in 32 bits.",
        ),
        (
            c.num_neighbors >= c.reference_size,
            f"num-neighbors is {c.num_neighbors}, but must be below reference-size = "
            f"{c.reference_size}.",
        ),
        (
            c.batch_size > c.replay_size,
            f"batch-size is {c.batch_size}, but must not exceed replay-size = {c.replay_size}.",
        ),
        (
            updates * c.batch_size <= _neighbors_of(c.bonus),
            f"batch-size is {c.batch_size}, but bonus {c.bonus} needs more than "
            f"{_neighbors_of(c.bonus)} transitions in the {updates:g} batches of a vector step.",
        ),
        (
            c.intrinsic_weight == 0 and c.task == tasks.NONE,
            f"{'method is task' if c.method == registry.TASK else 'intrinsic-weight is 0'}, but "
            "task is none: name a task.",
        ),
        (
            c.plateau_segments and c.intrinsic_weight == 0,
            f"plateau-segments is {c.plateau_segments}, but must be 0 with intrinsic-weight 0: a "
            f"plateau is judged by the intrinsic reward.",
        ),
        (
            c.intrinsic_decay and c.intrinsic_weight == 0,
            f"intrinsic-decay is {c.intrinsic_decay}, but intrinsic-weight is 0: leave one out.",
        ),
        (
            c.start_from != "scratch" and not c.source,
            f"start-from is {c.start_from}, but there is no source: name the directory of a run.",
        ),
        (
            c.start_from in names.PLAYING and c.task == tasks.NONE,
            f"start-from is {c.start_from}, but task is none: name the task that is measured.",
        ),
        (
            c.cell_restarts and c.restart_share,
            f"cell-restarts is {c.cell_restarts} and restart-share is {c.restart_share}: episodes "
            "restart at states of cells or of the first episodes, so set one of them to 0.",
        ),
        (c.policy_lag > 1, f"policy-lag is {c.policy_lag}, but must be 0 or 1."),
        (
            4 * c.num_envs > c.replay_size,
            f"replay-size is {c.replay_size}, but must be at least 4 × num-envs = "
            f"{4 * c.num_envs}.",
        ),
        (
            c.yaw_copies and c.replay_dtype != "float32",
            f"replay-dtype is {c.replay_dtype}, but must be float32 with yaw-copies above 0.",
        ),
        (
            c.num_segments % c.snapshots > 0,
            f"snapshots is {c.snapshots}, but must divide num-segments = {c.num_segments}.",
        ),
        (
            c.snapshots > 1 and c.plateau_segments > 0,
            f"snapshots is {c.snapshots}, but must be 1 with plateau-segments above 0: "
            "an iteration that may end at a plateau archives one policy.",
        ),
        (
            c.mixture_episodes < policies,
            f"mixture-episodes is {c.mixture_episodes}, but must be at least {policies}, one for "
            f"each policy of the mixture.",
        ),
        (
            c.reference_size > c.mixture_episodes * c.episode_length,
            f"reference-size is {c.reference_size}, but must be at most mixture-episodes × "
            f"episode-length = {c.mixture_episodes * c.episode_length}.",
        ),
    ):
        if wrong:
            raise ConfigError(sentence)


def _neighbors_of(bonus: str) -> int:
    known = registry.BONUSES.get(bonus)
    return 0 if known is None else known.num_neighbors
