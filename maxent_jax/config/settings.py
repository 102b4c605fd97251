"""Every setting of a run, and the checks of their values. Loads no array library."""

import dataclasses
from collections.abc import Callable
from typing import Any

from maxent_jax import checks, errors
from maxent_jax.config import names, presets
from maxent_jax.config.names import BY_METHOD, CLASSIC_ENVS, CORRECTIVE, MUJOCO_ENVS
from maxent_jax.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of a run; frozen and hashable, changed with `dataclasses.replace`."""

    env: str = "ant"
    """Environment: ant, walker2d, humanoid, pendulum, mountain_car, brax:NAME, or user:NAME for one
    that maxent_jax.envs.register was told of."""
    method: str = "v"
    """h (Hazan 2019), la (Liu & Abbeel 2021) or v (Veritas), as the paper reads them; h-official or
    apt, the first two as their authors published them; or a baseline by the name of its bonus."""
    preset: str = "quick"
    """The values that the other flags start from: smoke, quick, gpu or paper."""
    backend: str = "auto"
    """Physics: mjx, mujoco (C MuJoCo), warp (MuJoCo Warp), or auto: mujoco on a CPU, else mjx."""
    physics: str = "reference"
    """reference (the options of Gymnasium's XML) or fast (cheaper ones, see the README)."""
    seed: int = 0
    """Of everything random but the feature projection."""
    num_seeds: int = 1
    """Runs trained side by side by vmap: seed, seed + 1, ..."""

    num_iterations: int = 6
    """T: policies trained after the initial one."""
    steps_per_iteration: int = 60_000
    """Env steps of training in an iteration, all envs together."""
    updates_per_step: float = 0.5
    """Gradient steps per env step."""
    num_envs: int = 32
    """N: environments stepped together."""
    num_segments: int = 15
    """Parts of an iteration; progress is shown after each."""
    snapshots: int = 1
    """Policies that an iteration archives, evenly over its segments, the last at its end."""
    plateau_segments: int = 0
    """End an iteration before its budget is spent once its reward has stopped rising, judged by
    means over so many segments; 0: never."""
    plateau_tolerance: float = 0.05
    """What still counts as rising: a share of all that the reward rose in the iteration."""

    episode_length: int = 1000
    """Time limit, control steps."""
    num_starts: int = 4096
    """Pool of random starts."""
    torque_limit: float = 1.0
    """Share of the control range that the agent may use; below 1 departs from the paper."""
    end_flipped: bool = False
    """End an episode upside down; departs from the paper."""
    end_unhealthy: bool = True
    """End an episode where the robot's health fails."""
    policy_inputs: str = "state"
    """What the networks see: state, or heading (the same in the agent's own horizontal frame)."""
    yaw_copies: int = 0
    """Copies of each episode, turned by a random yaw, that the learner draws like the others."""

    reward: str = "log1p"
    """log1p: log(1 + R/c); linear: R/c; log: log(R/c); paper: p log R."""
    reward_distance: float = 5.0
    """c, in feature units (metres for the first two features)."""
    reward_scale: float = 1.0
    """Factor on the whole reward that SAC sees."""
    shaping: float = 0.0
    """Potential-based shaping: the potential, as a multiple of the reward's form. 0: none."""
    shaping_space: str = "features"
    """Where the potential's distance is measured: features (it is R), or position (the first two
    alone: free of the noise of the joints)."""
    shaping_survives_death: bool = False
    """A state in which health fails keeps its potential: not policy-invariant."""
    alive_bonus: float = 0.0
    """Paid for each step that does not end in death, on the scale of what SAC is paid."""
    stale_rewards: bool = False
    """Keep what a step was paid when it was taken, whatever becomes of the reference."""
    episodic_weight: float = 0.0
    """λ of the episodic term. 0: none."""
    bonus: str = "none"
    """What pays SAC in place of the distance to the reference: none, or a reward of
    maxent_jax/intrinsic: rnd, icm, ngu, re3, rise, renyi, vcse, kmeans, apt, histogram."""

    num_neighbors: int = 3
    """k."""
    reference_size: int = 8192
    """M: states that define the reward."""
    mixture_episodes: int = 32
    """Episodes rolled out with the mixture for each refresh, and again for each evaluation."""
    mixing: str = "episode"
    """A policy of the mixture is drawn for each episode, or for each step."""
    pooled: bool = False
    """Draw the reference from the pooled states of the mixture, so that long-lived policies weigh
    more, instead of giving each policy its weight."""
    leave_own_out: bool = True
    """Score an archived policy without its own states in the reference."""
    deterministic: bool = False
    """The mixture's policies act by their mean where they are evaluated."""
    weights: str = "method"
    """Of the mixture: uniform, geometric, last (the newest policy alone), fully_corrective (the
    largest entropy that the archived policies can mix to, on the grid of the coverage), or as the
    method says."""
    eta: float = 0.1
    """η of the geometric weights."""
    reference: str = "method"
    """What the reward is measured against: mixture (its rollouts), history (a uniform sample of
    all states visited in training and, before there were any, in the first rollouts), or as the
    method says."""
    refresh_period: int = BY_METHOD
    """Steps of all envs between refreshes of the reward; 0: once an iteration; -1: as the method
    says. A mixture changes once an iteration, so that any period above 0 matters to history."""
    start: str = "method"
    """The agent that an iteration starts from: scratch, last, best, or as the method says."""

    hidden_layers: int = 2
    """Hidden layers of actor and critics."""
    hidden_size: int = 256
    """Units in each."""
    critic_layer_norm: bool = False
    """Layer norm in the critics; departs from the paper."""
    learning_rate: float = 3e-4
    """Adam, for actor, critics and temperature."""
    batch_size: int = 128
    """Transitions in a gradient step."""
    replay_size: int = 1_000_000
    """Env steps kept."""
    replay_dtype: str = "float32"
    """Of the states kept: float32, or float16 at half the memory (features and distances keep 32
    bits)."""
    discount: float = 0.99
    """γ."""
    return_steps: int = 1
    """n: rewards summed before the critics' estimate of what follows."""
    soft_update_rate: float = 0.005
    """Of the target critics."""
    initial_temperature: float = 0.2
    """α at the start."""
    target_entropy_scale: float = 1.0
    """Target entropy is minus this many nats per action dimension."""
    lagrangian_entropy: bool = False
    """Count the policy's entropy from its target in the soft return, so that at its target a policy
    neither gains nor loses by living."""
    normalize_inputs: bool = False
    """Networks see their inputs less the running mean of training, over its deviation."""
    actor_average: float = 0.0
    """Rate at which an average follows the actor, update by update; the average is archived. 0: the
    actor itself is."""
    restart_temperature: bool = False
    """Put α back to its initial value at the start of each iteration."""

    random_baseline: bool = True
    """Step a uniformly random policy beside the agent, for as many env steps, and log it."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = _of_type(field.name, getattr(self, field.name), field.type)
            object.__setattr__(self, field.name, value)
        _check(self)

    @property
    def vector_steps(self) -> int:
        """Steps of all envs in a segment."""
        return self.steps_per_iteration // (self.num_envs * self.num_segments)

    @property
    def updates_per_vector_step(self) -> int:
        """Gradient steps after each step of all envs."""
        return round(self.updates_per_step * self.num_envs)

    @property
    def archive_size(self) -> int:
        """P: the initial policy and those that each iteration archives."""
        return 1 + self.num_iterations * self.snapshots

    @property
    def simulates_in_jax(self) -> bool:
        """Whether MJX or brax computes the physics, for all that is known before jax is loaded."""
        return self.backend == "mjx" or self.env.startswith("brax:")

    def program(self) -> "Config":
        """This config with all that is data, not program, at its default.

        Configs with equal programs share one compilation; the data enters the state in
        `algorithm.init`.
        """
        defaults: dict[str, Any] = {name: DEFAULTS[name] for name in DATA_FIELDS}
        if self.weights == CORRECTIVE:  # a computation, not a table
            del defaults["weights"]
        return dataclasses.replace(self, **defaults)

    def deviations(self) -> dict[str, str]:
        """What this config does otherwise than the paper, by field."""
        paper = presets.PAPER | {"episode_length": _time_limit(self.env)}
        named = {name: why for name, (value, why) in paper.items() if getattr(self, name) != value}
        if self.shaping > 0 and self.shaping_space == "position":
            named["shaping_space"] = "the potential is measured in position alone"
        if self.reward != "paper":
            named["reward_distance"] = "the scale c of the reward's form"
        if self.episodic_weight == 0:
            named["episodic_weight"] = "no episodic term"
        for name in ("weights", "reference", "start", "refresh_period"):
            if getattr(self, name) != DEFAULTS[name]:
                named[name] = "set apart from its method"
        return named


DATA_FIELDS = (
    *("method", "preset", "seed", "num_seeds"),
    *("weights", "eta", "reference", "refresh_period", "start"),
    *("plateau_segments", "plateau_tolerance"),
)
DEFAULTS = {field.name: field.default for field in dataclasses.fields(Config)}


def preset(name: str, **changes: Any) -> Config:
    """The config of that preset, in its environment and for its method, with changes.

    Raises:
      ConfigError: an unknown preset or setting, or a value that no run can have.
    """
    checks.check_choice("preset", name, presets.PRESETS)
    for change in changes:
        try:
            checks.check_choice("setting", change, DEFAULTS)
        except ConfigError as error:
            raise errors.ConfigTypeError(str(error)) from None
    env, method = changes.get("env", Config.env), changes.get("method", Config.method)
    names.check_env(env)
    checks.check_choice("method", method, names.METHODS)
    in_env = presets.IN_ENV.get((name, env), {})
    of_method = presets.OF_METHOD.get(method, {})
    of_both = presets.OF_METHOD_IN_ENV.get((name, env, method), {})
    settings = presets.PRESETS[name] | in_env | of_method | of_both
    return Config(**{"preset": name, **settings, **changes})


def _time_limit(env: str) -> tuple[int, str]:
    steps = 200 if env in CLASSIC_ENVS else 1000
    return steps, f"the time limit is not {steps} steps"


_CHOICES = {
    "method": names.METHODS,
    "bonus": ("none", *names.BONUSES),
    "mixing": names.MIXINGS,
    "preset": presets.PRESETS,
    "reward": names.REWARDS,
    "policy_inputs": names.INPUTS,
    "shaping_space": names.SPACES,
    "replay_dtype": names.REPLAY_DTYPES,
    "weights": names.WEIGHTS,
    "reference": names.REFERENCES,
    "start": names.STARTS,
}
_AT_LEAST_ONE = (
    *("num_seeds", "num_iterations", "steps_per_iteration", "num_envs", "num_segments"),
    "snapshots",
    *("episode_length", "num_starts", "num_neighbors", "reference_size", "mixture_episodes"),
    *("hidden_layers", "hidden_size", "batch_size", "replay_size", "return_steps"),
)
# Each is a loop that is written out in the program, which grows with it.
_UNROLLED = {"hidden_layers": 64, "num_neighbors": 256, "return_steps": 256}
MOST = 2**31 - 1  # rows and steps are counted in 32 bits
_POSITIVE = (
    *("updates_per_step", "torque_limit", "reward_distance", "reward_scale", "learning_rate"),
    *("soft_update_rate", "initial_temperature", "eta"),
)
_AT_MOST_ONE = ("torque_limit", "discount", "soft_update_rate", "eta", "actor_average")
_NOT_NEGATIVE = (
    *("seed", "plateau_segments", "plateau_tolerance", "shaping", "episodic_weight"),
    *("alive_bonus", "actor_average"),
    *("yaw_copies", "discount", "target_entropy_scale"),
)


_TYPES: dict[Any, tuple[Callable[[str, Any], Any], str]] = {
    int: (checks.check_whole, "a whole number"),
    float: (checks.check_number, "a number"),
}


def _of_type(name: str, value: Any, kind: Any) -> Any:
    """The value as that type of Python's, also where it is numpy's or jax's.

    Raises:
      ConfigTypeError: it is no such value.
    """
    flag = name.replace("_", "-")
    if kind in _TYPES:
        convert, what = _TYPES[kind]
        try:
            return convert(flag, value)
        except TypeError:
            raise errors.ConfigTypeError(f"{flag} is {value!r}, but must be {what}.") from None
    if kind is bool and str(getattr(value, "dtype", "")) == "bool":
        return bool(value)
    if not isinstance(value, kind):
        what = "True or False" if kind is bool else "a string"
        raise errors.ConfigTypeError(f"{flag} is {value!r}, but must be {what}.")
    return value


def _check(config: Config) -> None:
    names.check_env(config.env)
    names.check_physics(config.env, config.backend, config.physics)
    for name, known in _CHOICES.items():
        checks.check_choice(name.replace("_", "-"), getattr(config, name), known)
    bounds = (
        (_AT_LEAST_ONE, lambda x: x >= 1, "at least 1"),
        (_POSITIVE, lambda x: 0 < x < float("inf"), "a positive number"),
        (_AT_MOST_ONE, lambda x: x <= 1, "at most 1"),
        (_NOT_NEGATIVE, lambda x: 0 <= x < float("inf"), "0 or more"),
        (("refresh_period",), lambda x: x >= BY_METHOD, "-1, 0 or more"),
    )
    for bounded, holds, requirement in bounds:
        for name in bounded:
            if not holds(getattr(config, name)):
                flag = name.replace("_", "-")
                raise ConfigError(f"{flag} is {getattr(config, name)}, but must be {requirement}.")
    for name in (*_AT_LEAST_ONE, "yaw_copies", "refresh_period"):
        most = _UNROLLED.get(name, MOST)
        if getattr(config, name) > most:
            raise ConfigError(
                f"{name.replace('_', '-')} is {getattr(config, name)}, but must be at most {most}."
            )
    _check_together(config)


def _check_together(c: Config) -> None:
    group = c.num_envs * c.num_segments
    updates = c.updates_per_step * c.num_envs
    for wrong, sentence in (
        (
            c.bonus != presets.OF_METHOD.get(c.method, {}).get("bonus", c.bonus),
            f"method is {c.method}, but bonus is {c.bonus}: leave it to the method.",
        ),
        (
            c.bonus != "none" and (c.return_steps > 1 or c.shaping > 0 or c.episodic_weight > 0),
            f"bonus is {c.bonus}, which is paid by the step alone: return-steps must be 1, and "
            f"shaping and episodic-weight 0.",
        ),
        (
            c.bonus != "none" and c.plateau_segments,
            f"plateau-segments is {c.plateau_segments}, but is judged by the distance to the "
            f"reference, which bonus {c.bonus} does not pay.",
        ),
        (
            c.mixing == "step" and (c.pooled or c.leave_own_out or c.weights == CORRECTIVE),
            "mixing is step, where no state belongs to a policy: pooled, leave-own-out and fully "
            "corrective weights need mixing episode.",
        ),
        (
            c.mixing == "step" and c.start == "best",
            "mixing is step, where no state belongs to a policy: none is the best to start from.",
        ),
        (
            c.pooled and c.weights == CORRECTIVE,
            "pooled draws policies by their weights, which fully corrective ones only get later.",
        ),
        (
            c.torque_limit < 1 and c.env not in MUJOCO_ENVS,
            f"torque-limit is {c.torque_limit}, but {c.env} has no torques to limit.",
        ),
        (
            c.end_flipped and c.env not in names.TORSO_ENVS,
            f"end-flipped is on, but {c.env} has no floating torso that could be upside down.",
        ),
        (
            not c.end_unhealthy and c.env not in MUJOCO_ENVS,
            f"end-unhealthy is off, but {c.env} has no health that could fail.",
        ),
        (
            c.policy_inputs == "heading" and c.env not in names.TORSO_ENVS,
            f"policy-inputs is heading, but {c.env} has no floating torso with a heading.",
        ),
        (
            c.yaw_copies and c.env not in names.TORSO_ENVS,
            f"yaw-copies is {c.yaw_copies}, but {c.env} cannot be turned about the vertical.",
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
            f"updates-per-step × num-envs is {updates:g}, but must be a whole number from 1 up.",
        ),
        (
            c.seed + c.num_seeds > 2**31,
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
            updates * c.batch_size <= names.NEIGHBORS.get(c.bonus, 0),
            f"batch-size is {c.batch_size}, but bonus {c.bonus} needs more than "
            f"{names.NEIGHBORS.get(c.bonus)} transitions in the {updates:g} batches of a step.",
        ),
        (
            4 * c.num_envs > c.replay_size,
            f"replay-size is {c.replay_size}, but must hold four steps of all envs, "
            f"{4 * c.num_envs}.",
        ),
        (
            c.yaw_copies and c.replay_dtype != "float32",
            f"replay-dtype is {c.replay_dtype}, but yaw copies need states in float32.",
        ),
        (
            c.num_segments % c.snapshots > 0,
            f"snapshots is {c.snapshots}, but must divide num-segments, {c.num_segments}.",
        ),
        (
            c.snapshots > 1 and c.plateau_segments > 0,
            f"snapshots is {c.snapshots}, but must be 1 with plateau-segments above 0: "
            "an iteration that may end at a plateau archives one policy.",
        ),
        (
            c.mixture_episodes < c.archive_size,
            f"mixture-episodes is {c.mixture_episodes}, but each of the {c.archive_size} policies "
            f"of the mixture needs one.",
        ),
        (
            c.reference_size > c.mixture_episodes * c.episode_length,
            f"reference-size is {c.reference_size}, but mixture-episodes × episode-length gives at "
            f"most {c.mixture_episodes * c.episode_length} states.",
        ),
    ):
        if wrong:
            raise ConfigError(sentence)
