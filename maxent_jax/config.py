"""Every setting of a run, its presets, and the checks of its values. Loads no array library."""

import dataclasses
import difflib
from collections.abc import Collection
from typing import Any

MUJOCO_ENVS = ("ant", "walker2d", "humanoid")
CLASSIC_ENVS = ("pendulum", "mountain_car")
ENVS = MUJOCO_ENVS + CLASSIC_ENVS
BRAX_ENVS = (
    *("ant", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum"),
    *("inverted_double_pendulum", "pusher", "reacher", "swimmer", "walker2d"),
)
TORSO_ENVS = ("ant", "humanoid")  # a floating torso has a heading, and can be upside down
TURNING_ENVS = ("ant",)  # whose observation we know how to turn about the vertical
BONUSES = ("rnd", "icm", "ngu", "re3", "rise", "renyi", "vcse", "kmeans", "apt", "histogram")
BASELINES = BONUSES[:-1]  # methods that one policy learns, paid by the bonus of that name
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


class ConfigError(ValueError):
    """A setting that no run can have; the message says which, and what to do."""


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
    stale_rewards: bool = False
    """Keep what a step was paid when it was taken, whatever becomes of the reference."""
    episodic_weight: float = 0.0
    """λ of the episodic term. 0: none."""
    bonus: str = "none"
    """What pays SAC in place of the distance to the reference: none, or a reward with a state of
    its own (maxent_jax/bonuses): rnd, icm, ngu, re3, rise, renyi, vcse, kmeans, apt, histogram."""

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
    restart_temperature: bool = False
    """Put α back to its initial value at the start of each iteration."""

    random_baseline: bool = True
    """Step a uniformly random policy beside the agent, for as many env steps, and log it."""

    def __post_init__(self):
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
        """P: the initial policy and one an iteration."""
        return self.num_iterations + 1

    @property
    def simulates_in_jax(self) -> bool:
        """Whether MJX or brax computes the physics, for all that is known before jax is loaded."""
        return self.backend == "mjx" or self.env.startswith("brax:")

    def program(self) -> "Config":
        """This config with all that is data, not program, at its default.

        Configs with equal programs share one compilation; the data enters the state in
        `algorithm.init`.
        """
        defaults: dict[str, Any] = {name: _DEFAULTS[name] for name in DATA_FIELDS}
        if self.weights == CORRECTIVE:  # a computation, not a table
            del defaults["weights"]
        return dataclasses.replace(self, **defaults)

    def deviations(self) -> dict[str, str]:
        """What this config does otherwise than the paper, by field."""
        paper = _PAPER | {"episode_length": _time_limit(self.env)}
        named = {name: why for name, (value, why) in paper.items() if getattr(self, name) != value}
        if self.shaping > 0 and self.shaping_space == "position":
            named["shaping_space"] = "the potential is measured in position alone"
        if self.reward != "paper":
            named["reward_distance"] = "the scale c of the reward's form"
        if self.episodic_weight == 0:
            named["episodic_weight"] = "no episodic term"
        for name in ("weights", "reference", "start", "refresh_period"):
            if getattr(self, name) != _DEFAULTS[name]:
                named[name] = "set apart from its method"
        return named


DATA_FIELDS = (
    *("method", "preset", "seed", "num_seeds"),
    *("weights", "eta", "reference", "refresh_period", "start"),
    *("plateau_segments", "plateau_tolerance"),
)
_DEFAULTS = {field.name: field.default for field in dataclasses.fields(Config)}

# What the paper does, and how a run that does otherwise says so.
_PAPER: dict[str, tuple[Any, str]] = {
    "physics": ("reference", "the physics is simplified"),
    "torque_limit": (1.0, "torques are limited to a share of the control range"),
    "end_flipped": (False, "an episode also ends upside down"),
    "end_unhealthy": (True, "an episode goes on where health fails"),
    "policy_inputs": ("state", "networks see the state in the heading's frame"),
    "yaw_copies": (0, "episodes turned by a random yaw are learned from too"),
    "reward": ("paper", "the reward's form is not p log R"),
    "reward_scale": (1.0, "the reward is scaled"),
    "stale_rewards": (False, "rewards are not those of the current reference"),
    "shaping": (0.0, "the reward is shaped by a potential"),
    "shaping_survives_death": (False, "the potential survives death: not policy-invariant"),
    "pooled": (False, "the reference is drawn from the pooled states of the mixture"),
    "bonus": ("none", "SAC is not paid by the distance to the reference"),
    "mixing": ("episode", "a policy of the mixture is drawn for each step"),
    "deterministic": (False, "policies are evaluated by their mean actions"),
    "eta": (0.1, "η is not 0.1"),
    "num_neighbors": (3, "k is not 3"),
    "leave_own_out": (False, "policies are scored without their own states"),
    "hidden_layers": (2, "networks do not have 2 hidden layers"),
    "hidden_size": (256, "hidden layers are not 256 wide"),
    "critic_layer_norm": (False, "critics have layer norm"),
    "learning_rate": (3e-4, "Adam's rate is not 3e-4"),
    "batch_size": (128, "the batch is not 128"),
    "replay_size": (1_000_000, "the replay does not hold 1e6 transitions"),
    "replay_dtype": ("float32", "states in the replay are rounded to 16 bits"),
    "discount": (0.99, "γ is not 0.99"),
    "return_steps": (1, "critics learn from returns of several steps"),
    "soft_update_rate": (0.005, "the soft update is not 0.005"),
    "initial_temperature": (0.2, "the temperature starts elsewhere than at 0.2"),
    "target_entropy_scale": (1.0, "the target entropy is not minus the number of actions"),
    "restart_temperature": (False, "the temperature restarts in each iteration"),
}

_FAST_LEARNER: dict[str, Any] = dict(
    critic_layer_norm=True,
    learning_rate=1e-3,
    return_steps=3,
    initial_temperature=0.1,
    restart_temperature=True,
)

PRESETS: dict[str, dict[str, Any]] = {
    "smoke": dict(
        num_iterations=2,
        steps_per_iteration=400,
        updates_per_step=0.25,
        num_envs=4,
        num_segments=2,
        episode_length=100,
        num_starts=64,
        reference_size=256,
        mixture_episodes=8,
        hidden_size=32,
        batch_size=32,
        replay_size=2_000,
    ),
    "quick": dict(
        num_envs=64,
        steps_per_iteration=120_000,
        updates_per_step=0.25,
        hidden_size=128,
        **_FAST_LEARNER,
        replay_size=240_000,
    ),
    "gpu": dict(
        num_iterations=20,
        num_envs=2048,
        steps_per_iteration=2_048_000,
        num_segments=20,
        updates_per_step=1 / 64,
        batch_size=4096,
        **_FAST_LEARNER,
        reference_size=131_072,
        mixture_episodes=256,
    ),
    "paper": dict(
        num_iterations=20,
        steps_per_iteration=150_000,
        updates_per_step=1.0,
        num_envs=16,
        num_segments=25,
        reward="paper",
        episodic_weight=0.1,
        leave_own_out=False,
        reference_size=16_384,
        mixture_episodes=64,
    ),
}

_LOCOMOTION = dict(
    shaping=100.0,
    shaping_space="position",
    shaping_survives_death=True,
    reward_distance=20.0,
    reward_scale=8.0,
)
_CLASSIC = dict(episode_length=200)
_ROBOTS: dict[str, dict[str, Any]] = {
    "ant": dict(
        torque_limit=0.4,
        end_flipped=True,
        policy_inputs="heading",
        yaw_copies=1,
        **_LOCOMOTION,
    ),
    "walker2d": _LOCOMOTION,
    "humanoid": dict(policy_inputs="heading", **_LOCOMOTION),
}

# What a preset does otherwise in some environment.
_IN_ENV: dict[tuple[str, str], dict[str, Any]] = {
    **{("quick", env): changes for env, changes in _ROBOTS.items()},
    **{("gpu", env): dict(physics="fast", **changes) for env, changes in _ROBOTS.items()},
    **{
        ("gpu", env): dict(reference_size=32_768, reward_distance=0.1, **_CLASSIC)
        for env in CLASSIC_ENVS
    },
    **{("paper", env): dict(reference_size=8_192, **_CLASSIC) for env in CLASSIC_ENVS},
    **{
        ("quick", env): dict(
            steps_per_iteration=19_200,
            reference_size=4_096,
            reward_distance=0.1,
            **_CLASSIC,
        )
        for env in CLASSIC_ENVS
    },
}

# What methods as their authors published them, and the baselines, do whatever the preset.
_AS_PUBLISHED: dict[str, Any] = dict(
    shaping=0.0, shaping_survives_death=False, episodic_weight=0.0, return_steps=1, reward_scale=1.0
)
# Factors that bring a bonus to a size of about 1, which the temperature is made for: measured on
# normal states of 29 dimensions, where rnd, icm, re3, vcse and apt pay 0.6 to 1.2 as they are.
_SIZES = {"kmeans": 50.0, "ngu": 0.03, "renyi": 0.03, "rise": 0.25}
_OF_METHOD: dict[str, dict[str, Any]] = {
    "h-official": _AS_PUBLISHED
    | dict(bonus="histogram", mixing="step", deterministic=True, leave_own_out=False),
    **{
        name: _AS_PUBLISHED | dict(bonus=name, reward_scale=_SIZES.get(name, 1.0))
        for name in BASELINES
    },
}


def preset(name: str, **changes: Any) -> Config:
    """The config of that preset, in its environment and for its method, with changes.

    Raises:
      ConfigError: an unknown preset, or a value that no run can have.
    """
    check_choice("preset", name, PRESETS)
    in_env = _IN_ENV.get((name, changes.get("env", Config.env)), {})
    of_method = _OF_METHOD.get(changes.get("method", Config.method), {})
    return Config(**{"preset": name, **PRESETS[name], **in_env, **of_method, **changes})


def check_env(name: str) -> None:
    """Raises ConfigError unless an environment can have that name."""
    names = (*ENVS, *(f"brax:{env}" for env in BRAX_ENVS))
    if not name.startswith("user:"):
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


def _time_limit(env: str) -> tuple[int, str]:
    steps = 200 if env in CLASSIC_ENVS else 1000
    return steps, f"the time limit is not {steps} steps"


def check_choice(what: str, value: str, known: Collection[str]) -> None:
    """Raises ConfigError unless the value is among the known ones; it names the nearest."""
    if value in known:
        return
    nearest = difflib.get_close_matches(value, known, n=1, cutoff=0.4)
    hint = f"did you mean '{nearest[0]}'?" if nearest else f"choose one of {', '.join(known)}."
    raise ConfigError(f"unknown {what} '{value}': {hint}")


_CHOICES = {
    "method": METHODS,
    "bonus": ("none", *BONUSES),
    "mixing": MIXINGS,
    "preset": PRESETS,
    "reward": REWARDS,
    "policy_inputs": INPUTS,
    "shaping_space": SPACES,
    "replay_dtype": REPLAY_DTYPES,
    "weights": WEIGHTS,
    "reference": REFERENCES,
    "start": STARTS,
}
_AT_LEAST_ONE = (
    *("num_seeds", "num_iterations", "steps_per_iteration", "num_envs", "num_segments"),
    *("episode_length", "num_starts", "num_neighbors", "reference_size", "mixture_episodes"),
    *("hidden_layers", "hidden_size", "batch_size", "replay_size", "return_steps"),
)
_POSITIVE = (
    *("updates_per_step", "torque_limit", "reward_distance", "reward_scale", "learning_rate"),
    *("soft_update_rate", "initial_temperature", "eta"),
)
_AT_MOST_ONE = ("torque_limit", "discount", "soft_update_rate", "eta")
_NOT_NEGATIVE = (
    *("seed", "plateau_segments", "plateau_tolerance", "shaping", "episodic_weight"),
    *("yaw_copies", "discount", "target_entropy_scale"),
)


def _check(config: Config) -> None:
    check_env(config.env)
    check_physics(config.env, config.backend, config.physics)
    for name, known in _CHOICES.items():
        check_choice(name.replace("_", "-"), getattr(config, name), known)
    bounds = (
        (_AT_LEAST_ONE, lambda x: x >= 1, "at least 1"),
        (_POSITIVE, lambda x: 0 < x < float("inf"), "a positive number"),
        (_AT_MOST_ONE, lambda x: x <= 1, "at most 1"),
        (_NOT_NEGATIVE, lambda x: 0 <= x < float("inf"), "0 or more"),
        (("refresh_period",), lambda x: x >= BY_METHOD, "-1, 0 or more"),
    )
    for names, holds, requirement in bounds:
        for name in names:
            if not holds(getattr(config, name)):
                flag = name.replace("_", "-")
                raise ConfigError(f"{flag} is {getattr(config, name)}, but must be {requirement}.")
    _check_together(config)


def _check_together(c: Config) -> None:
    group = c.num_envs * c.num_segments
    updates = c.updates_per_step * c.num_envs
    for wrong, sentence in (
        (
            c.bonus != _OF_METHOD.get(c.method, {}).get("bonus", c.bonus),
            f"method is {c.method}, but bonus is {c.bonus}: leave it to the method.",
        ),
        (
            c.bonus != "none" and (c.return_steps > 1 or c.shaping > 0 or c.episodic_weight > 0),
            f"bonus is {c.bonus}, which is paid by the step alone: return-steps must be 1, and "
            f"shaping and episodic-weight 0.",
        ),
        (
            c.mixing == "step" and (c.pooled or c.leave_own_out or c.weights == CORRECTIVE),
            "mixing is step, where no state belongs to a policy: pooled, leave-own-out and fully "
            "corrective weights need mixing episode.",
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
            c.end_flipped and c.env not in TORSO_ENVS,
            f"end-flipped is on, but {c.env} has no floating torso that could be upside down.",
        ),
        (
            not c.end_unhealthy and c.env not in MUJOCO_ENVS,
            f"end-unhealthy is off, but {c.env} has no health that could fail.",
        ),
        (
            c.policy_inputs == "heading" and c.env not in TORSO_ENVS,
            f"policy-inputs is heading, but {c.env} has no floating torso with a heading.",
        ),
        (
            c.yaw_copies and c.env not in TURNING_ENVS,
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
            c.num_neighbors >= c.reference_size,
            f"num-neighbors is {c.num_neighbors}, but must be below reference-size = "
            f"{c.reference_size}.",
        ),
        (
            c.batch_size > c.replay_size,
            f"batch-size is {c.batch_size}, but must not exceed replay-size = {c.replay_size}.",
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
