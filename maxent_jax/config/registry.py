"""The registry of environments, bonuses and methods: what must be known before jax is loaded.

To add one to the package, write a module and add a row to a table here. From outside, call
`maxent_jax.envs.register`, `maxent_jax.intrinsic.register` or `register_method`; the new name then
begins with "user:". Loads no array library.
"""

import importlib
import importlib.util
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from maxent_jax.checks import check_choice
from maxent_jax.errors import ConfigError, ConfigTypeError

USER, BRAX, PLAYGROUND = "user:", "brax:", "playground:"
BY_METHOD = -1  # as a refresh period: the method's own
CORRECTIVE = "fully_corrective"
WEIGHTS = ("uniform", "geometric", "last", CORRECTIVE)
REFERENCES = ("mixture", "history")
STARTS = ("scratch", "last", "best")
BACKENDS = ("auto", "mjx", "mujoco", "warp")
PHYSICS = ("reference", "fast")


class EnvironmentRow(NamedTuple):
    """What is known of an environment."""

    entry: Any = None  # an envs.Entry, or where it is: "module:name"
    backends: tuple[str, ...] = ("auto",)
    physics: tuple[str, ...] = ("reference",)
    is_robot: bool = False  # an envs.task.MujocoEnv, with torques and a health test
    has_torso: bool = False  # a floating torso: it has a heading and can turn over
    in_metres: bool = False  # the grid's coordinates are a position in metres
    time_limit: int = 1000  # the paper's, in control steps


class BonusRow(NamedTuple):
    """A bonus: an intrinsic reward with a state."""

    make: Any  # intrinsic.Setting -> intrinsic.Bonus, or where it is: "module:name"
    num_neighbors: int = 0  # k within a batch; the batch must be larger
    baseline: bool = True  # also a method of the same name, which trains one policy


class MethodRow(NamedTuple):
    """A method: one field for each choice in which methods differ."""

    weights: str  # of the archived policies, one of WEIGHTS
    refresh_period: int  # vector steps between refreshes of the reward; 0: once per iteration
    reference: str  # the states that define the reward, one of REFERENCES
    start: str  # the agent that an iteration starts from, one of STARTS
    settings: Mapping[str, Any] = MappingProxyType({})  # its other settings, in every preset


def _robot(name: str, has_torso: bool) -> EnvironmentRow:
    where = f"maxent_jax.envs.{name}:ENTRY"
    return EnvironmentRow(where, BACKENDS, PHYSICS, True, has_torso, in_metres=True)


def _classic(name: str) -> EnvironmentRow:
    return EnvironmentRow(f"maxent_jax.envs.{name}:ENTRY", time_limit=200)


def _bonus(module: str, num_neighbors: int = 0, make: str = "make", **more: Any) -> BonusRow:
    return BonusRow(f"maxent_jax.intrinsic.{module}:{make}", num_neighbors, **more)


ENVIRONMENTS = {
    "ant": _robot("ant", has_torso=True),
    "walker2d": _robot("walker2d", has_torso=False),
    "humanoid": _robot("humanoid", has_torso=True),
    "pendulum": _classic("pendulum"),
    "mountain_car": _classic("mountain_car"),
}
BRAX_ENVS = (
    *("ant", "halfcheetah", "hopper", "humanoid", "humanoidstandup", "inverted_pendulum"),
    *("inverted_double_pendulum", "pusher", "reacher", "swimmer", "walker2d"),
)
# Those that leave their position in the plane out of an observation, unless they are told not to.
BRAX_HIDES_POSITION = ("ant", "halfcheetah", "hopper", "humanoid", "swimmer", "walker2d")
# Without the Reachers, which Playground 0.2 cannot load with MuJoCo 3.17.
PLAYGROUND_ENVS = (
    *("AcrobotSwingup", "AcrobotSwingupSparse", "BallInCup", "CartpoleBalance"),
    *("CartpoleBalanceSparse", "CartpoleSwingup", "CartpoleSwingupSparse", "CheetahRun"),
    *("FingerSpin", "FingerTurnEasy", "FingerTurnHard", "FishSwim", "HopperHop", "HopperStand"),
    *("HumanoidRun", "HumanoidStand", "HumanoidWalk", "PendulumSwingup", "PointMass"),
    *("SwimmerSwimmer6", "WalkerRun", "WalkerStand", "WalkerWalk"),
)
_BY_PREFIX = {
    **{
        f"{BRAX}{name}": EnvironmentRow(
            backends=("auto", "mjx"), in_metres=name in BRAX_HIDES_POSITION
        )
        for name in BRAX_ENVS
    },
    **{
        f"{PLAYGROUND}{name}": EnvironmentRow(backends=("auto", "mjx", "warp"))
        for name in PLAYGROUND_ENVS
    },
}
_USERS = EnvironmentRow(backends=BACKENDS, physics=PHYSICS)

METRA = "metra"
BONUSES = {
    "rnd": _bonus("rnd"),
    "icm": _bonus("icm"),
    "ngu": _bonus("ngu"),
    "re3": _bonus("re3", 3),
    "rise": _bonus("rise", 5),
    "renyi": _bonus("rise", 5, "make_renyi"),
    "vcse": _bonus("vcse", 12),
    "kmeans": _bonus("kmeans"),
    "apt": _bonus("apt", 12),
    "proto": _bonus("proto"),
    "giril": _bonus("giril"),
    "histogram": _bonus("histogram", baseline=False),
    METRA: _bonus("metra"),
}

# The learner's settings in methods as published by their authors, and in the baselines.
PLAIN: dict[str, Any] = {"shaping": 0.0, "return_steps": 1}
# A bonus is divided by its standard deviation; the distance to the reference has a scale instead.
_AS_PUBLISHED = PLAIN | {"episodic_weight": 0.0, "reward_scale": 1.0}


def _baseline(bonus: str) -> MethodRow:
    return MethodRow("last", 0, "mixture", "last", _AS_PUBLISHED | {"bonus": bonus})


def _metra() -> MethodRow:
    """Its authors' settings that do not depend on the budget."""
    own = {
        "skill_size": 2,
        "normalize_inputs": True,
        "policy_inputs": "state",
        "yaw_copies": 0,
        "alive_bonus": 0.0,
        "torque_limit": 1.0,
        "restart_temperature": False,
        "lagrangian_entropy": False,
        "critic_layer_norm": False,
        "actor_average": 0.0,
        "snapshots": 1,
        "initial_temperature": 0.01,
        "target_entropy_scale": 0.5,
    }
    row = _baseline(METRA)
    return row._replace(settings={**row.settings, **own})


TASK = "task"  # the method whose only reward is a task's

METHODS = {
    "h": MethodRow("geometric", 0, "mixture", "scratch"),
    "la": MethodRow("uniform", 1, "history", "last"),
    "v": MethodRow("uniform", 0, "mixture", "best"),
    "h-official": MethodRow(
        *("geometric", 0, "mixture", "scratch"),
        _AS_PUBLISHED | {"bonus": "histogram", "mixing": "step", "leave_own_out": False},
    ),
    **{name: _baseline(name) for name, row in BONUSES.items() if row.baseline},
    METRA: _metra(),
    TASK: MethodRow(
        *("last", 0, "history", "last"),
        dict(
            intrinsic_weight=0.0,
            shaping=0.0,
            episodic_weight=0.0,
            alive_bonus=0.0,
            snapshots=1,
            restart_temperature=False,
            random_baseline=False,
        ),
    ),
}

ENVS = tuple(ENVIRONMENTS)
MUJOCO_ENVS = tuple(name for name, row in ENVIRONMENTS.items() if row.is_robot)
CLASSIC_ENVS = tuple(name for name, row in ENVIRONMENTS.items() if not row.is_robot)
BASELINES = tuple(name for name, row in BONUSES.items() if row.baseline)

_REGISTERED_BY = {
    "environment": "maxent_jax.envs.register",
    "bonus": "maxent_jax.intrinsic.register",
    "method": "maxent_jax.config.register_method",
    "task": "maxent_jax.tasks.register",
}

in_use: set[tuple[str, str]] = set()
"""Kind and name of each environment and bonus that programs of this process were made of."""


def is_users(name: object) -> bool:
    """Whether a name has the form "user:NAME"."""
    return isinstance(name, str) and name.startswith(USER) and name != USER


def environment(name: str) -> EnvironmentRow:
    """Returns the row of an environment; a general row for a "user:" name not registered yet.

    Raises:
      ConfigError: the name is unknown.
    """
    if is_users(name):
        return ENVIRONMENTS.get(name, _USERS)
    check_choice("env", name, (*ENVS, *_BY_PREFIX))
    return _BY_PREFIX[name] if name in _BY_PREFIX else ENVIRONMENTS[name]


def method(name: str) -> MethodRow:
    """Returns the row of a method.

    Raises:
      ConfigError: the name is unknown or not registered.
    """
    return _row("method", name, METHODS)


def bonus(name: str) -> BonusRow:
    """Returns the row of a bonus.

    Raises:
      ConfigError: the name is unknown or not registered.
    """
    return _row("bonus", name, BONUSES)


def bonus_of(method_name: str) -> str | None:
    """Returns the bonus that a method sets; None if it sets none, or is not registered."""
    row = METHODS.get(method_name)
    return None if row is None else row.settings.get("bonus")


def check_name(kind: str, name: Any) -> None:
    """Raises ConfigError unless something can be registered under the name.

    What a program of this process was made of cannot change: the program would stay as it is.
    """
    if not isinstance(name, str) or not name:
        raise ConfigTypeError(f"the {kind}'s name is {name!r}, but must be a non-empty string.")
    if (kind, f"{USER}{name}") in in_use:
        raise ConfigError(
            f"{kind} '{USER}{name}' is already in use in this process: choose another name, or "
            f"restart Python."
        )


def register_environment(name: str, entry: Any, in_metres: bool) -> None:
    """Adds an environment of a user; see envs.register, which makes the envs.Entry."""
    ENVIRONMENTS[f"{USER}{name}"] = _USERS._replace(entry=entry, in_metres=in_metres)


def register_bonus(name: str, row: BonusRow) -> None:
    """Adds a bonus of a user, and a method of the same name; see intrinsic.register."""
    name = f"{USER}{name}"
    BONUSES[name], METHODS[name] = row, _baseline(name)


def register_method(
    name: str, weights: str, refresh_period: int, reference: str, start: str, **settings: Any
) -> None:
    """Registers a method as "user:NAME"; it is then trained like any other.

    Args:
      name: NAME, without "user:".
      weights: weights of the archived policies: uniform, geometric, last or fully_corrective.
      refresh_period: vector steps (steps of all environments) between refreshes of the reward; 0:
        one refresh per iteration.
      reference: the states that define the reward: mixture or history.
      start: the agent that an iteration starts from: scratch, last or best.
      **settings: other settings of `Config` that the method sets in every preset.
    Raises:
      ConfigError: a value is invalid.
    """
    check_name("method", name)
    check_choice("weights", weights, WEIGHTS)
    check_choice("reference", reference, REFERENCES)
    check_choice("start", start, STARTS)
    if isinstance(refresh_period, bool) or not isinstance(refresh_period, int):
        raise ConfigTypeError(f"refresh_period is {refresh_period!r}, but must be a whole number.")
    if refresh_period < 0:
        raise ConfigError(f"refresh_period is {refresh_period}, but must be 0 or more.")
    if weights == CORRECTIVE:  # computed by the program; the others are a table
        settings, weights = {"weights": CORRECTIVE, **settings}, "uniform"
    METHODS[f"{USER}{name}"] = MethodRow(weights, refresh_period, reference, start, settings)


def check_registered(env: str, method_name: str, bonus_name: str) -> None:
    """Raises ConfigError if a "user:" name is not registered, or an environment not installed."""
    if is_users(env) and env not in ENVIRONMENTS:
        raise not_registered("environment", env)
    check_installed(env)
    method(method_name)
    if bonus_name != "none":
        bonus(bonus_name)


def check_installed(env: str) -> None:
    """Raises ConfigError if the environment needs a package that is not installed."""
    if env.startswith(PLAYGROUND) and importlib.util.find_spec("mujoco_playground") is None:
        raise ConfigError(
            f"env '{env}' needs the package playground, which is in the extra 'playground': "
            f"install it."
        )


def resolve(where: Any) -> Any:
    """Returns the object at "module:name"; returns anything but a string as it is."""
    if not isinstance(where, str):
        return where
    module, name = where.split(":")
    return getattr(importlib.import_module(module), name)


def not_registered(kind: str, name: str) -> ConfigError:
    """Returns the error for a "user:" name that is not registered."""
    return ConfigError(
        f"{kind} '{name}' is not registered: call {_REGISTERED_BY[kind]} first; on a command line, "
        f"pass the module that calls it with --import."
    )


def _row(kind: str, name: str, table: Mapping[str, Any]) -> Any:
    if is_users(name) and name not in table:
        raise not_registered(kind, name)
    check_choice(kind, name, table)
    return table[name]
