"""Every setting of a run, in groups. Loads no array library."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from maxent_jax.checks import check_choice
from maxent_jax.config import paper, presets, registry, validation
from maxent_jax.config.registry import BY_METHOD, CORRECTIVE
from maxent_jax.errors import ConfigError, ConfigTypeError


class _Checked:
    """A group whose values are of the types that its fields say."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = validation.of_type(field.name, getattr(self, field.name), field.type)
            object.__setattr__(self, field.name, value)


@dataclasses.dataclass(frozen=True)
class Budget(_Checked):
    """How much is trained, and in what portions."""

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


@dataclasses.dataclass(frozen=True)
class Environment(_Checked):
    """The episodes that states come from."""

    backend: str = "auto"
    """Physics: mjx, mujoco (C MuJoCo), warp (MuJoCo Warp), or auto: mujoco on a CPU, else mjx."""
    physics: str = "reference"
    """reference (the options of Gymnasium's XML) or fast (cheaper ones, see the README)."""
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


@dataclasses.dataclass(frozen=True)
class Intrinsic(_Checked):
    """The intrinsic reward that SAC is paid, in place of a reward from the environment."""

    reward: str = "log1p"
    """log1p: log(1 + R/c); linear: R/c; log: log(R/c); paper: p log R."""
    reward_distance: float = 5.0
    """c, in feature units (metres for the first two features)."""
    reward_scale: float = 1.0
    """Factor on the whole reward that SAC sees."""
    num_neighbors: int = 3
    """k."""
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


@dataclasses.dataclass(frozen=True)
class Mixture(_Checked):
    """The archive of policies, and the reference: the states that define the reward."""

    snapshots: int = 1
    """Policies that an iteration archives, evenly over its segments, the last at its end."""
    weights: str = "method"
    """Of the mixture: uniform, geometric, last (the newest policy alone), fully_corrective (the
    largest entropy that the archived policies can mix to, on the grid of the coverage), or as the
    method says."""
    eta: float = 0.1
    """η of the geometric weights."""
    mixing: str = "episode"
    """A policy of the mixture is drawn for each episode, or for each step."""
    pooled: bool = False
    """Draw the reference from the pooled states of the mixture, so that long-lived policies weigh
    more, instead of giving each policy its weight."""
    reference: str = "method"
    """What the reward is measured against: mixture (its rollouts), history (a uniform sample of
    all states visited in training and, before there were any, in the first rollouts), or as the
    method says."""
    reference_size: int = 8192
    """M: states that define the reward."""
    refresh_period: int = BY_METHOD
    """Steps of all envs between refreshes of the reward; 0: once an iteration; -1: as the method
    says. A mixture changes once an iteration, so that any period above 0 matters to history."""
    mixture_episodes: int = 32
    """Episodes rolled out with the mixture for each refresh, and again for each evaluation."""
    start: str = "method"
    """The agent that an iteration starts from: scratch, last, best, or as the method says."""
    leave_own_out: bool = True
    """Score an archived policy without its own states in the reference."""


@dataclasses.dataclass(frozen=True)
class Learner(_Checked):
    """SAC: what its networks see, their size, and how they learn."""

    policy_inputs: str = "state"
    """What the networks see: state, or heading (the same in the agent's own horizontal frame)."""
    yaw_copies: int = 0
    """Copies of each episode, turned by a random yaw, that the learner draws like the others."""
    normalize_inputs: bool = False
    """Networks see their inputs less the running mean of training, over its deviation."""
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
    restart_temperature: bool = False
    """Put α back to its initial value at the start of each iteration."""
    actor_average: float = 0.0
    """Rate at which an average follows the actor, update by update; the average is archived. 0: the
    actor itself is."""


@dataclasses.dataclass(frozen=True)
class Evaluation(_Checked):
    """What is measured beside training."""

    deterministic: bool = False
    """The mixture's policies act by their mean where they are evaluated."""
    random_baseline: bool = True
    """Step a uniformly random policy beside the agent, for as many env steps, and log it."""


@dataclasses.dataclass(frozen=True)
class Config(_Checked):
    """Settings of a run."""

    env: str = "ant"
    """ant, walker2d, humanoid, pendulum, mountain_car, brax:NAME, or user:NAME (see --import)."""
    method: str = "v"
    """h (Hazan 2019), la (Liu & Abbeel 2021), v (Veritas), h-official, or a bonus as a baseline."""
    preset: str = "quick"
    """The values that the other flags start from: smoke, quick, gpu or paper."""
    seed: int = 0
    """Of everything random but the feature projection."""
    num_seeds: int = 1
    """Seeds trained side by side by vmap: seed, seed + 1, ..."""

    budget: Budget = Budget()
    environment: Environment = Environment()
    intrinsic: Intrinsic = Intrinsic()
    mixture: Mixture = Mixture()
    learner: Learner = Learner()
    evaluation: Evaluation = Evaluation()

    def __post_init__(self) -> None:
        super().__post_init__()
        validation.check(self.env, self.method, self.flat())

    @property
    def vector_steps(self) -> int:
        """Steps of all envs in a segment."""
        budget = self.budget
        return budget.steps_per_iteration // (budget.num_envs * budget.num_segments)

    @property
    def updates_per_vector_step(self) -> int:
        """Gradient steps after each step of all envs."""
        return round(self.budget.updates_per_step * self.budget.num_envs)

    @property
    def archive_size(self) -> int:
        """P: the initial policy and those that each iteration archives."""
        return 1 + self.budget.num_iterations * self.mixture.snapshots

    @property
    def simulates_in_jax(self) -> bool:
        """Whether MJX or brax computes the physics, for all that is known before jax is loaded."""
        return self.environment.backend == "mjx" or self.env.startswith("brax:")

    def flat(self) -> dict[str, Any]:
        """Every setting by its name, without its group. No two groups share a name."""
        return {name: self[name] for name in DEFAULTS}

    def __getitem__(self, name: str) -> Any:
        return getattr(getattr(self, GROUPS[name]) if name in GROUPS else self, name)

    def replace(self, **changes: Any) -> "Config":
        """This config with some settings changed, each by its name, whatever its group.

        Raises:
          ConfigTypeError: no such setting, or a value of the wrong type.
          ConfigError: a value that no run can have.
        """
        return from_flat({**self.flat(), **changes})

    def check_registered(self) -> None:
        """Raises ConfigError where a user's environment, method or bonus is not registered."""
        registry.check_registered(self.env, self.method, self.intrinsic.bonus)

    def program(self) -> "Config":
        """This config with all that is data, not program, at its default.

        Configs with equal programs share one compilation; the data enters the state in
        `algorithm.init`.
        """
        defaults = {name: DEFAULTS[name] for name in DATA_FIELDS}
        if self.mixture.weights == CORRECTIVE:  # a computation, not a table
            del defaults["weights"]
        return self.replace(**defaults)

    def deviations(self) -> dict[str, str]:
        """What this config does otherwise than the paper: by setting, in words."""
        return paper.deviations(self.env, self.flat(), DEFAULTS)


GROUPS = {
    setting.name: group.name
    for group in dataclasses.fields(Config)
    if dataclasses.is_dataclass(group.type)
    for setting in dataclasses.fields(group.type)
}
"""The group of each setting that has one."""
DEFAULTS: dict[str, Any] = {
    field.name: field.default
    for group in (Config, *(f.type for f in dataclasses.fields(Config)))
    if dataclasses.is_dataclass(group)
    for field in dataclasses.fields(group)
    if not dataclasses.is_dataclass(field.type)
}
"""The value of each setting in `Config()`."""
DATA_FIELDS = (
    *("method", "preset", "seed", "num_seeds"),
    *("weights", "eta", "reference", "refresh_period", "start"),
    *("plateau_segments", "plateau_tolerance"),
)


def from_flat(settings: Mapping[str, Any]) -> Config:
    """The config with these settings, each by its name, and all others at their defaults.

    Raises:
      ConfigTypeError: no such setting, or a value of the wrong type.
      ConfigError: a value that no run can have.
    """
    _check_settings(settings)
    own: dict[str, Any] = {name: x for name, x in settings.items() if name not in GROUPS}
    for group in dataclasses.fields(Config):
        if dataclasses.is_dataclass(group.type):
            given = {n: x for n, x in settings.items() if GROUPS.get(n) == group.name}
            own[group.name] = group.type(**given)  # type: ignore[operator]
    return Config(**own)


def preset(name: str, **changes: Any) -> Config:
    """The config of that preset, in its environment and for its method, with changes.

    Args:
      name: smoke, quick, gpu or paper.
      **changes: settings by name, whatever their group.
    Raises:
      ConfigError: an unknown preset or setting, or a value that no run can have.
    """
    check_choice("preset", name, presets.PRESETS)
    _check_settings(changes)
    env, method = changes.get("env", Config.env), changes.get("method", Config.method)
    registry.environment(env)
    in_env = presets.IN_ENV.get((name, env), {})
    of_method = registry.method(method).settings
    of_both = presets.OF_METHOD_IN_ENV.get((name, env, method), {})
    settings = {**presets.PRESETS[name], **in_env, **of_method, **of_both}
    return from_flat({"preset": name, **settings, **changes})


def _check_settings(settings: Mapping[str, Any]) -> None:
    for name in settings:
        try:
            check_choice("setting", name, DEFAULTS)
        except ConfigError as error:
            raise ConfigTypeError(str(error)) from None
