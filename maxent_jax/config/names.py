"""The names that settings are chosen by, and the refusal of others. Loads no array library."""

from maxent_jax.checks import check_choice
from maxent_jax.errors import ConfigError

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
