"""Every setting of a run, in groups. Loads no array library."""

import dataclasses
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Annotated, Any

import tyro

from maxent_jax.checks import check_choice
from maxent_jax.config import (
    compatibility,
    names,
    paper,
    presets,
    registry,
    tasks,
    validation,
)
from maxent_jax.config.registry import BY_METHOD, CORRECTIVE
from maxent_jax.errors import ConfigError, ConfigTypeError


class _Checked:
    """A group of settings, each converted to the type of its field."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            kind = getattr(field.type, "__origin__", field.type)  # of Annotated
            value = validation.of_type(field.name, getattr(self, field.name), kind)
            object.__setattr__(self, field.name, value)


@dataclasses.dataclass(frozen=True)
class Budget(_Checked):
    """How long to train, and in what portions."""

    num_iterations: int = 6
    """T: iterations of the outer loop; each trains a policy and adds it to the mixture."""
    steps_per_iteration: int = 60_000
    """Env steps of training per iteration, summed over environments."""
    updates_per_step: float = 0.5
    """Gradient steps per env step."""
    num_envs: int = 32
    """N: environments stepped in parallel."""
    num_segments: int = 15
    """Segments of an iteration; progress is shown after each."""
    plateau_segments: int = 0
    """End an iteration when its mean reward over this many segments stops rising; 0: never."""
    plateau_tolerance: float = 0.05
    """A rise up to this share of the iteration's whole rise in reward counts as a plateau."""


@dataclasses.dataclass(frozen=True)
class Environment(_Checked):
    """The environment: its physics, and how its episodes start and end."""

    backend: str = "auto"
    """Physics: mjx, mujoco (C MuJoCo), warp (MuJoCo Warp), or auto: mujoco on a CPU, else mjx."""
    physics: str = "reference"
    """reference (Gymnasium's XML options), or fast (cheaper, see docs/concepts/environments.md)."""
    episode_length: int = 1000
    """Time limit of an episode, in control steps."""
    num_starts: int = 4096
    """Random start states in the pool that episodes start from."""
    cell_restarts: float = 0.0
    """Share of the training episodes that begin at a state of a visited cell (Go-Explore); a cell
    is drawn in proportion to 1 / its visits. Departs from the paper."""
    torque_limit: float = 1.0
    """Fraction of the control range that the agent may use; below 1 departs from the paper."""
    end_flipped: bool = False
    """End an episode when the robot is upside down; departs from the paper."""
    end_unhealthy: bool = True
    """End an episode when the robot's health fails (health termination)."""
    skill_size: int = 0
    """Z: entries of the skill that each episode is given, a random unit vector that the networks
    see; 0: none."""


@dataclasses.dataclass(frozen=True)
class Intrinsic(_Checked):
    """The intrinsic reward that SAC receives in place of a reward from the environment."""

    reward: str = "log1p"
    """log1p: log(1 + R/c); linear: R/c; log: log(R/c); paper: p log R. R: k-NN distance."""
    reward_distance: float = 5.0
    """c: scale of the distance R, in feature units (metres for the first two features)."""
    reward_scale: float = 1.0
    """Factor on the intrinsic reward, but not on --alive-bonus."""
    num_neighbors: int = 3
    """k: R is the distance to the k-th nearest reference state."""
    shaping: float = 0.0
    """Potential-based shaping: the potential is this factor times the reward; 0: none."""
    shaping_space: str = "features"
    """Distance of the potential: in features (R), or in position (first two, no joint noise)."""
    shaping_survives_death: bool = False
    """Keep the potential at health termination; shaping may then change the optimal policy."""
    alive_bonus: float = 0.0
    """Reward added to each step without health termination; --reward-scale does not apply."""
    stale_rewards: bool = False
    """Keep the reward that each step had when it was taken, although the reference changes."""
    episodic_weight: float = 0.0
    """λ: weight of the episodic term; 0: none."""
    bonus: str = "none"
    """Bonus that replaces the distance to the reference: none, rnd, icm, ngu,
    re3, rise, renyi, vcse, kmeans, apt, proto, giril, metra, histogram, or user:NAME."""


@dataclasses.dataclass(frozen=True)
class Mixture(_Checked):
    """The archive of policies, and the reference: the states that define the reward."""

    snapshots: int = 1
    """Policies archived per iteration, evenly over its segments, the last at its end."""
    weights: str = "method"
    """Weights of the policies: method (its own choice), uniform, geometric,
    last (newest policy only), or fully_corrective (largest entropy of the
    mixture on the coverage grid)."""
    eta: float = names.ETA
    """η of the geometric weights."""
    mixing: str = "episode"
    """How often the mixture draws a policy: for each episode, or for each step."""
    pooled: bool = False
    """Draw policies by weight and pool their states: those with long episodes then weigh more."""
    reference: str = "method"
    """States that define the reward: method (its own choice), mixture (its
    rollouts), or history (uniform sample of all states visited in training,
    before training in the first rollouts)."""
    reference_size: int = 8192
    """M: reference states."""
    refresh_period: int = BY_METHOD
    """Vector steps between refreshes of the reward; 0: once per iteration; -1:
    the method's choice. Above 0 it affects history only, because a mixture
    changes once per iteration. A vector step is one step of all environments."""
    mixture_episodes: int = 32
    """Episodes of the mixture for each refresh, and again for each evaluation."""
    start: str = "method"
    """Agent that an iteration starts from: method (its own choice), scratch, last or best."""
    leave_own_out: bool = True
    """Score an archived policy without its own states in the reference."""


@dataclasses.dataclass(frozen=True)
class Learner(_Checked):
    """SAC: the inputs and the size of its networks, and how they learn."""

    policy_inputs: str = "state"
    """Inputs of the networks: state, or heading (the state in the robot's horizontal frame)."""
    yaw_copies: int = 0
    """Copies of each episode, turned by a random yaw, from which SAC also learns."""
    normalize_inputs: bool = False
    """Normalise network inputs by their running mean and standard deviation."""
    hidden_layers: int = 2
    """Hidden layers of the actor and of each critic."""
    hidden_size: int = 256
    """Units in each hidden layer."""
    critic_layer_norm: bool = False
    """Use layer norm in the critics; departs from the paper."""
    learning_rate: float = 3e-4
    """Adam's learning rate, for actor, critics and temperature."""
    batch_size: int = 128
    """Transitions per gradient step."""
    replay_size: int = 1_000_000
    """Env steps that the replay buffer holds."""
    replay_dtype: str = "float32"
    """States in the replay: float32, or float16 (half the memory; the rest keeps 32 bits)."""
    discount: float = 0.99
    """γ: discount factor."""
    return_steps: int = 1
    """n: rewards summed before the critics' estimate of the rest (n-step returns)."""
    soft_update_rate: float = 0.005
    """Soft update rate of the target critics."""
    initial_temperature: float = 0.2
    """Initial temperature α."""
    target_entropy_scale: float = 1.0
    """The target entropy is minus this many nats per action dimension."""
    lagrangian_entropy: bool = False
    """Count entropy relative to its target, so that survival is neutral at the target entropy."""
    restart_temperature: bool = False
    """Reset α to its initial value at the start of each iteration."""
    policy_lag: int = 0
    """Vector steps by which gradient steps lag behind the environments: 0, or 1, so that
    C MuJoCo and the gradient steps run at the same time."""
    actor_average: float = 0.0
    """Rate per update of the actor's moving average, which is archived; 0: archive the actor."""


@dataclasses.dataclass(frozen=True)
class Downstream(_Checked):
    """A task, and the run whose policies solve it (docs/how-to/finetune.md)."""

    task: str = tasks.NONE
    """Task that is rewarded too: none, gymnasium, forward, run:DEGREES, goal:X,Y, ... (all of them:
    docs/how-to/finetune.md) or user:NAME."""
    task_scale: float = 1.0
    """Scale of the task's reward."""
    intrinsic_weight: float = 1.0
    """β: factor on the intrinsic reward."""
    intrinsic_decay: int = 0
    """Env steps over which β falls linearly to 0; 0: β is constant."""
    source: str = ""
    """Directory of the run to start from."""
    source_seed: int = 0
    """Which seed of that run, from 0, if it has several."""
    source_iterations: int = 0
    """Use only the policies of that run's first N iterations; 0: of all iterations."""
    restart_share: float = 0.0
    """Share of the episodes that begin at a state of the best tenth of the first episodes."""
    critic_steps: int = 0
    """Env steps at the beginning in which only the critics learn."""
    restart_critics: bool = True
    """Start with new critics: those of that run have learned another reward."""
    start_from: Annotated[str, tyro.conf.arg(aliases=("--from",))] = "scratch"
    """What to take from that run: scratch (nothing), last (its newest agent), best (the agent with
    the highest return in the first episodes), mixture (those episodes, for the replay), or both."""
    first_episodes: int = 2
    """Episodes that each policy of that run plays first, for best, mixture and both."""


@dataclasses.dataclass(frozen=True)
class Evaluation(_Checked):
    """What is measured in addition to training."""

    deterministic: bool = False
    """Evaluate the policies of the mixture with their mean actions."""
    random_baseline: bool = True
    """Also step a uniformly random policy for as many env steps as the agent, and log it."""


@dataclasses.dataclass(frozen=True)
class Config(_Checked):
    """Settings of a run."""

    env: str = "ant"
    """ant, walker2d, humanoid, pendulum, mountain_car, brax:NAME, playground:NAME, or user:NAME
    (see --import)."""
    method: str = "v"
    """h (Hazan 2019), la (Liu & Abbeel 2021), v (Veritas), h-official, a bonus as a baseline, or
    task (one policy, rewarded by --task alone)."""
    preset: str = "quick"
    """Defaults of the other flags: smoke, quick, gpu or paper (docs/concepts/presets.md)."""
    protocol: str = "own"
    """own, or metra: episodes of 200 steps that health does not end, and 48 deterministic ones to
    evaluate, as METRA and its successors are compared (docs/results/rivals.md)."""
    seed: int = 0
    """Seed of everything random except the feature projection."""
    num_seeds: int = 1
    """Seeds trained together by vmap: seed, seed + 1, ..."""

    budget: Budget = Budget()
    environment: Environment = Environment()
    intrinsic: Intrinsic = Intrinsic()
    mixture: Mixture = Mixture()
    learner: Learner = Learner()
    downstream: Downstream = Downstream()
    evaluation: Evaluation = Evaluation()

    def __post_init__(self) -> None:
        super().__post_init__()
        validation.check(self.env, self.method, self.flat())

    @property
    def vector_steps(self) -> int:
        """Vector steps (steps of all environments) per segment."""
        budget = self.budget
        return budget.steps_per_iteration // (budget.num_envs * budget.num_segments)

    @property
    def updates_per_vector_step(self) -> int:
        """Gradient steps after each vector step."""
        return round(self.budget.updates_per_step * self.budget.num_envs)

    @property
    def archive_size(self) -> int:
        """P: policies in a full archive, the initial one and those of each iteration."""
        return 1 + self.budget.num_iterations * self.mixture.snapshots

    @property
    def explores(self) -> bool:
        """Whether the agent gets an intrinsic reward, not that of a task alone."""
        return self.downstream.intrinsic_weight > 0

    @property
    def simulates_in_jax(self) -> bool:
        """Whether MJX or brax computes the physics, as far as is known before jax is loaded."""
        theirs = (registry.BRAX, registry.PLAYGROUND)
        return self.environment.backend == "mjx" or self.env.startswith(theirs)

    @property
    def own_bonus(self) -> str:
        """For titles: the bonus, if it is set apart from the method; else nothing."""
        bonus = self.intrinsic.bonus
        of_method = registry.bonus_of(self.method) or "none"
        return "" if bonus == of_method else f" with bonus {bonus}"

    @property
    def title(self) -> str:
        """The method for titles, with its bonus if that is set apart from the method."""
        name = f"MaxEnt-{self.method.upper()}" if self.method in ("h", "la", "v") else self.method
        return ("SAC" if name == registry.TASK else name) + self.own_bonus

    def flat(self) -> dict[str, Any]:
        """Returns every setting by name, without groups. No two groups share a name."""
        return {name: self[name] for name in DEFAULTS}

    def __getitem__(self, name: str) -> Any:
        return getattr(getattr(self, GROUPS[name]) if name in GROUPS else self, name)

    def replace(self, **changes: Any) -> "Config":
        """Returns this config with some settings changed, by name, whatever their group.

        A preset, a protocol, a method or a task brings other settings along only in `preset(...)`.

        Raises:
          ConfigTypeError: a setting does not exist, or a value has the wrong type.
          ConfigError: a value is invalid.
        """
        return from_flat({**self.flat(), **changes})

    def check_new(self) -> None:
        """Raises ConfigError if a setting has no effect, or not the one that it should have."""
        for sentence in compatibility.problems_of_new_runs(SimpleNamespace(**self.flat())):
            raise ConfigError(sentence)

    def check_registered(self) -> None:
        """Raises ConfigError if a user's environment, method, bonus or task is not registered."""
        registry.check_registered(self.env, self.method, self.intrinsic.bonus)
        tasks.check_registered(self.downstream.task)

    def program(self) -> "Config":
        """Returns this config with the settings that are data, not program, at their defaults.

        Configs with equal programs share one compilation; the data enters the state in
        `algorithm.init`.
        """
        defaults = {name: DEFAULTS[name] for name in DATA_FIELDS}
        if self.mixture.weights == CORRECTIVE:  # a computation, not a table
            del defaults["weights"]
        return self.replace(**defaults)

    def deviations(self) -> dict[str, str]:
        """Returns, by setting, a phrase on each departure of this config from the paper."""
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
    *("method", "preset", "protocol", "seed", "num_seeds"),
    *("weights", "eta", "reference", "refresh_period", "start"),
    *("plateau_segments", "plateau_tolerance"),
    *("source", "source_seed", "source_iterations", "start_from", "first_episodes"),
)


def from_flat(settings: Mapping[str, Any]) -> Config:
    """Makes a config from settings by name; all others keep their defaults.

    Raises:
      ConfigTypeError: a setting does not exist, or a value has the wrong type.
      ConfigError: a value is invalid.
    """
    _check_settings(settings)
    own: dict[str, Any] = {name: x for name, x in settings.items() if name not in GROUPS}
    for group in dataclasses.fields(Config):
        if dataclasses.is_dataclass(group.type):
            given = {n: x for n, x in settings.items() if GROUPS.get(n) == group.name}
            own[group.name] = group.type(**given)  # type: ignore[operator]
    return Config(**own)


def preset(name: str, **changes: Any) -> Config:
    """Makes the config of a preset, for an environment and a method, with changes.

    Args:
      name: smoke, quick, gpu or paper.
      **changes: settings by name, whatever their group.
    Raises:
      ConfigError: the preset or a setting is unknown, or a value is invalid.
    """
    check_choice("preset", name, presets.PRESETS)
    _check_settings(changes)
    env, method = changes.get("env", Config.env), changes.get("method", Config.method)
    registry.environment(env)
    in_env = presets.IN_ENV.get((name, env), {})
    of_method = registry.method(method).settings
    of_both = presets.OF_METHOD_IN_ENV.get((name, env, method), {})
    of_protocol = presets.of_protocol(changes.get("protocol", Config.protocol), env)
    of_task = tasks.settings(changes.get("task", tasks.NONE), env)
    settings = {**presets.PRESETS[name], **in_env, **of_method, **of_both, **of_protocol, **of_task}
    config = from_flat({"preset": name, **settings, **changes})
    config.check_new()
    return config


def _check_settings(settings: Mapping[str, Any]) -> None:
    for name in settings:
        try:
            check_choice("setting", name, DEFAULTS)
        except ConfigError as error:
            raise ConfigTypeError(str(error)) from None
