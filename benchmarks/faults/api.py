"""Does every wrong argument of the Python API raise one sentence, of the right exception class?"""

# Arguments are wrong on purpose.
# mypy: disable-error-code="arg-type,operator"

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from maxent_jax import components, envs, features, load_run, mixture, rewards
from maxent_jax.analysis import Paths, Run
from maxent_jax.config import from_flat, preset
from maxent_jax.density import entropy, histogram, knn
from maxent_jax.density.histogram import Grid
from maxent_jax.errors import CheckpointError, ConfigError, ConfigTypeError, RunError
from maxent_jax.runs import files
from maxent_jax.sac import agent
from maxent_jax.theory import bounds

LONGEST = 1200  # letters of a sentence; the longest names every environment
POINTS = np.zeros((5, 3), np.float32)
GRID = Grid(("x", "y"), (0.0, 0.0), (1.0, 1.0), (10, 10))
NAN = float("nan")


class Places(NamedTuple):
    """Paths and a run for the calls."""

    folder: Path  # without a run; with the files that `places` makes
    begun: Path  # a run without a checkpoint
    run: Run  # two untrained policies on the pendulum


class Fault(NamedTuple):
    """A wrong call, and the exception that it must raise."""

    what: str
    call: Callable[[Places], Any]
    kind: type[Exception]
    says: str


def places(folder: Path) -> Places:
    """Makes the places in a folder."""
    begun = folder / "begun"
    begun.mkdir()
    files.write_config(begun, preset("smoke"), {}, {})
    (folder / "broken.xml").write_text("<mujoco><nonsense/></mujoco>", encoding="utf-8")
    mesh = "<asset><mesh name='a' file='none.obj'/></asset>"
    geom = "<worldbody><geom type='mesh' mesh='a'/></worldbody>"
    (folder / "mesh.xml").write_text(f"<mujoco>{mesh}{geom}</mujoco>", encoding="utf-8")
    newer = folder / "newer"
    newer.mkdir()
    content = json.dumps({"schema": 99, "config": {}})
    (newer / files.CONFIG).write_text(content, encoding="utf-8")
    config = preset("smoke", env="pendulum", num_iterations=1)
    sac = components.make(config).sac
    agents = [agent.init(sac, key).parameters for key in jax.random.split(jax.random.key(0))]
    archive = mixture.init(agents[0], config.archive_size)
    for parameters in agents:
        archive = mixture.append(archive, parameters)
    none = np.zeros(components.make(config).grid.bins, np.int32)
    return Places(folder, begun, Run(folder, config, {}, config.seed, archive, none, none))


def knn_of(what: str, kind: type[Exception], says: str, *args: Any, **kwargs: Any) -> Fault:
    """A wrong search for neighbours."""
    return Fault(f"knn_distances: {what}", lambda _: knn.knn_distances(*args, **kwargs), kind, says)


def config_of(kind: type[Exception], says: str, **settings: Any) -> Fault:
    """Wrong settings."""
    return Fault(f"from_flat({settings})", lambda _: from_flat(settings), kind, says)


def of(call: Callable[[Places], Any], kind: type[Exception], says: str) -> Fault:
    """A wrong call, named by the sentence that it raises."""
    return Fault(says, call, kind, says)


def _paths_of(policies: list[int]) -> Paths:
    count = len(policies)
    return Paths(np.zeros((count, 4, 3)), np.ones((count, 4), bool), np.array(policies))


FAULTS: tuple[Fault, ...] = (
    of(lambda p: load_run(p.folder / "no"), RunError, "not the directory of a run"),
    of(lambda p: load_run(p.folder / "newer"), RunError, "schema 99"),
    of(lambda p: load_run("a\0b"), RunError, "a\0b is not the directory"),
    of(lambda _: load_run(None), TypeError, "path is None"),
    of(lambda _: load_run(3), TypeError, "path is 3"),
    of(lambda p: load_run(p.begun), CheckpointError, "holds no complete checkpoint"),
    of(lambda p: load_run(p.begun, seed_index=3), RunError, "seed_index is 3, but"),
    of(lambda p: load_run(p.begun, seed_index=-1), RunError, "seed_index is -1, but"),
    of(lambda p: load_run(p.begun, seed_index="a"), TypeError, "seed_index is 'a'"),
    of(lambda p: load_run(p.begun, seed_index=0.5), TypeError, "seed_index is 0.5"),
    of(lambda p: p.run.policy(99), IndexError, "policy is 99, but the mixture has 2"),
    of(lambda p: p.run.policy(-3), IndexError, "policy is -3, but the mixture has 2"),
    of(lambda p: p.run.policy(1.5), TypeError, "policy is 1.5"),
    of(lambda p: p.run.policy(None), TypeError, "policy is None"),
    of(lambda p: p.run.export_policy(2), IndexError, "policy is 2"),
    of(lambda p: p.run.act(np.zeros(5), jax.random.key(0)), ValueError, "(5,), but must be"),
    of(lambda p: p.run.act(0.0, jax.random.key(0)), ValueError, "(), but must be"),
    of(lambda p: p.run.act(np.zeros(3), jax.random.key(0), 9), IndexError, "policy is 9"),
    of(lambda p: p.run.dataset(0), ValueError, "at least 1 transition, not 0"),
    of(lambda p: p.run.dataset(-1), ValueError, "at least 1 transition, not -1"),
    of(lambda p: p.run.dataset(2.5), TypeError, "n is 2.5"),
    of(lambda p: p.run.dataset(10**13), ConfigError, "10000000000000 transitions need"),
    of(lambda p: p.run.rollout(0), ValueError, "episodes_per_policy is 0"),
    of(lambda p: p.run.rollout(-1), ValueError, "episodes_per_policy is -1"),
    of(lambda p: p.run.rollout(1.5), TypeError, "episodes_per_policy is 1.5"),
    of(lambda p: p.run.rollout(10**10), ConfigError, "episodes of 100 steps"),
    of(lambda p: p.run.rollout(1, seed=-1), ConfigError, "seed is -1, but must be 0 or more"),
    of(lambda p: p.run.occupancy(1, seed=2**32), ConfigError, "seed is 4294967296"),
    of(lambda p: p.run.dataset(9, seed=10**20), ConfigError, "seed is 100000000000000000000"),
    of(lambda p: p.run.dataset(9, seed=0.5), TypeError, "seed is 0.5"),
    of(lambda p: p.run.occupancy_of(_paths_of([0, 0])), ValueError, "of policies [0]"),
    of(lambda p: p.run.occupancy_of(_paths_of([0, 1, 7])), ValueError, "policies [0, 1, 7]"),
    of(lambda _: envs.make("antt"), ConfigError, "unknown env 'antt': did you mean 'ant'?"),
    of(lambda _: envs.make("brax:antt"), ConfigError, "did you mean 'brax:ant'?"),
    of(lambda _: envs.make(""), ConfigError, "unknown env ''"),
    of(lambda _: envs.make(None), ConfigError, "unknown env None"),
    of(lambda _: envs.make("user:none"), ConfigError, "'user:none' is not registered"),
    of(lambda _: envs.make("ant", backend="mjxx"), ConfigError, "unknown backend 'mjxx'"),
    of(lambda _: envs.make("ant", backend=None), ConfigError, "unknown backend None"),
    of(lambda _: envs.make("ant", physics="fats"), ConfigError, "unknown physics 'fats'"),
    of(lambda _: envs.make("pendulum", "mjx"), ConfigError, "pendulum has only: auto"),
    of(lambda _: envs.make("ant", nosuch=1), ConfigTypeError, "ant has no deviation 'nosuch'"),
    of(lambda _: envs.make("pendulum", torque_limit=1), ConfigTypeError, "pendulum has no dev"),
    of(lambda _: envs.make("ant", torque_limit=-1), ConfigError, "torque_limit is -1"),
    of(lambda _: envs.make("ant", torque_limit="a"), TypeError, "torque_limit is 'a'"),
    of(lambda _: envs.make("walker2d", end_flipped=True), ConfigError, "no floating torso"),
    of(lambda _: envs.register("", POINTS), ConfigTypeError, "name is ''"),
    of(lambda _: envs.register(3, POINTS), ConfigTypeError, "name is 3"),
    of(lambda _: envs.register("a", 3), ConfigTypeError, "make is 3"),
    of(lambda _: envs.register("a", print, grid=3), ConfigTypeError, "grid is 3"),
    of(lambda _: envs.register("a", print, phi=3), ConfigTypeError, "phi is 3"),
    of(lambda p: envs.from_xml(p.folder / "no.xml", 5), ConfigError, "no.xml"),
    of(lambda p: envs.from_xml(p.folder / "broken.xml", 5), ConfigError, "broken.xml"),
    of(lambda p: envs.from_xml(p.folder / "mesh.xml", 5), ConfigError, "mesh.xml"),
    of(lambda p: envs.from_xml(p.folder, 5), ConfigError, "MuJoCo cannot read"),
    of(lambda p: envs.from_xml(p.folder / "mesh.xml", 0), ConfigError, "frame_skip is 0"),
    of(lambda p: envs.from_xml(p.folder / "mesh.xml", 1.5), TypeError, "frame_skip is 1.5"),
    of(lambda _: envs.from_xml(None, 5), TypeError, "xml is None"),
    of(lambda _: features.make_feature_map("antt"), ConfigError, "unknown env 'antt'"),
    of(lambda _: features.make_feature_map("ant")(np.zeros(5)), ValueError, "[..., 29]"),
    knn_of("k of 0", ValueError, "k is 0", POINTS, POINTS, 0),
    knn_of("negative k", ValueError, "k is -1", POINTS, POINTS, -1),
    knn_of("k above the points", ValueError, "number of points, 5", POINTS, POINTS, 9),
    knn_of("k of 1.5", TypeError, "k is 1.5", POINTS, POINTS, 1.5),
    knn_of("k of True", TypeError, "k is True", POINTS, POINTS, True),
    knn_of("other features", ValueError, "(5, 4)", POINTS, np.zeros((5, 4)), 1),
    knn_of("one axis", ValueError, "(3,)", np.zeros(3), POINTS, 1),
    knn_of("NaN in a query", ValueError, "queries hold a number", POINTS * NAN, POINTS, 1),
    knn_of("NaN in a point", ValueError, "points hold a number", POINTS, POINTS * NAN, 1),
    knn_of("complex numbers", TypeError, "complex64", POINTS * 1j, POINTS, 1),
    knn_of("text", TypeError, "array of numbers", "a", POINTS, 1),
    knn_of("ragged rows", TypeError, "cannot be converted to", [[1.0], [1.0, 2.0]], POINTS, 1),
    knn_of("few to exclude", ValueError, "exclude has shape", POINTS, POINTS, 1, np.arange(3)),
    knn_of("floats to exclude", TypeError, "exclude is of dtype", POINTS, POINTS, 1, np.ones(5)),
    knn_of("few labels", ValueError, "labels has shape", POINTS, POINTS, 1, labels=np.arange(3)),
    knn_of("count above the points", ValueError, "count is 9", POINTS, POINTS, 1, count=9),
    knn_of("count of 2.5", TypeError, "count is 2.5", POINTS, POINTS, 1, count=2.5),
    of(lambda _: entropy.knn_entropy(POINTS, 5), ValueError, "5 samples are too few for 5"),
    of(lambda _: entropy.knn_entropy(POINTS, 0), ValueError, "k is 0"),
    of(lambda _: entropy.knn_entropy(np.zeros(5), 1), ValueError, "must be [N, F]"),
    of(lambda _: entropy.knn_entropy(POINTS, 1, 9), ValueError, "count is 9"),
    of(lambda _: entropy.knn_density(POINTS, POINTS, 0), ValueError, "k is 0"),
    of(lambda _: histogram.count(np.zeros(3), GRID), ValueError, "states have shape (3,)"),
    of(lambda _: histogram.count(np.zeros((3, 1)), GRID), ValueError, "shape (3, 1)"),
    of(lambda _: histogram.count(POINTS, GRID, np.ones(4)), ValueError, "weights have shape"),
    of(lambda _: histogram.count(POINTS, "ant"), TypeError, "grid is 'ant'"),
    of(lambda _: mixture.uniform_weights(0), ValueError, "at least 1 policy, not 0"),
    of(lambda _: mixture.uniform_weights(2.5), TypeError, "n is 2.5"),
    of(lambda _: mixture.geometric_weights(5, 0), ValueError, "eta is 0"),
    of(lambda _: mixture.geometric_weights(5, 1.5), ValueError, "eta is 1.5"),
    of(lambda _: mixture.geometric_weights(5, NAN), ValueError, "eta is nan"),
    of(lambda _: mixture.geometric_weights(5, "a"), TypeError, "eta is 'a'"),
    of(lambda _: mixture.fully_corrective_weights(POINTS, 0), ValueError, "smoothing is 0"),
    of(lambda _: mixture.fully_corrective_weights(POINTS[0], 1), ValueError, "[n, S]"),
    of(lambda _: mixture.fully_corrective_weights(POINTS - 1, 1), ValueError, "negative"),
    of(
        lambda _: mixture.fully_corrective_weights(POINTS, 1, np.ones(3)),
        ValueError,
        "start has shape (3,)",
    ),
    of(lambda _: rewards.knn_reward(POINTS, POINTS, 1, form="liner"), ValueError, "'liner'"),
    of(lambda _: rewards.knn_reward(POINTS, POINTS, 1, scale=0), ValueError, "scale is 0"),
    of(lambda _: rewards.renyi_reward(POINTS, POINTS, 1, 2.0), ValueError, "alpha is 2.0"),
    of(lambda _: rewards.renyi_reward(POINTS, POINTS, 1, "a"), TypeError, "alpha is 'a'"),
    of(lambda _: rewards.hazan_reward(POINTS, POINTS, 9), ValueError, "k is 9"),
    of(
        lambda _: rewards.episodic_bonus(
            POINTS, jnp.zeros((5, 4, 2)), jnp.zeros(5, jnp.int32), num_neighbors=1
        ),
        ValueError,
        "earlier (5, 4, 2)",
    ),
    of(lambda _: bounds.eta_upper_bound(1), ValueError, "num_states is 1"),
    of(lambda _: bounds.eta_upper_bound("a"), TypeError, "num_states is 'a'"),
    of(lambda _: bounds.eta_upper_bound(NAN), ValueError, "num_states is nan"),
    of(lambda _: bounds.min_iterations(10, 99), ValueError, "tolerance is 99"),
    of(lambda _: bounds.veritas_epsilon(-1, 1, 1), ValueError, "T is -1"),
    of(lambda _: bounds.veritas_epsilon(1.5, 1, 1), TypeError, "T is 1.5"),
    of(lambda _: bounds.veritas_epsilon(1, NAN, 1), ValueError, "B is nan"),
    of(lambda _: bounds.veritas_epsilon(1, 1, 1, eps0=[1]), ValueError, "eps0 has 1 entries"),
    of(lambda _: bounds.veritas_epsilon(1, 1, 1, form="a"), ValueError, "unknown form 'a'"),
    of(lambda _: bounds.hazan_epsilon(1, 1, 1, 2), ValueError, "eta is 2"),
    of(lambda _: bounds.harmonic(0), ValueError, "n is 0"),
    of(lambda _: preset("x"), ConfigError, "unknown preset 'x'"),
    of(lambda _: preset(None), ConfigError, "unknown preset None"),
    of(lambda _: preset("quick", num_env=1), ConfigTypeError, "did you mean 'num_envs'?"),
    of(lambda _: preset("quick", env=["ant"]), ConfigError, "unknown env ['ant']"),
    config_of(ConfigTypeError, "num-envs is '3'", num_envs="3"),
    config_of(ConfigTypeError, "num-envs is 2.5", num_envs=2.5),
    config_of(ConfigTypeError, "num-envs is True", num_envs=True),
    config_of(ConfigTypeError, "num-envs is None", num_envs=None),
    config_of(ConfigTypeError, "num-envs is nan", num_envs=NAN),
    config_of(ConfigTypeError, "learning-rate is 'a'", learning_rate="a"),
    config_of(ConfigTypeError, "learning-rate is True", learning_rate=True),
    config_of(ConfigTypeError, "env is 3", env=3),
    config_of(ConfigTypeError, "method is None", method=None),
    config_of(ConfigTypeError, "pooled is 'yes'", pooled="yes"),
    config_of(ConfigTypeError, "pooled is 1", pooled=1),
    config_of(ConfigError, "seed is 2147483648, but must be at most", seed=2**31),
    config_of(ConfigError, "seed + num-seeds is", seed=2**31 - 1, num_seeds=2),
    config_of(ConfigError, "replay-size is 4000000000", replay_size=4 * 10**9),
    config_of(ConfigError, "hidden-size is 1000", hidden_size=10**30),
    config_of(ConfigError, "hidden-layers is 1000", hidden_layers=1000),
    config_of(ConfigError, "steps are counted in 32 bits", num_iterations=10**6),
)


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields one row; it lists the faults with a wrong result."""
    made = places(folder)
    faults = FAULTS[:: 20 if short else 1]
    wrong = []
    for fault in faults:
        started = time.perf_counter()
        what = meet(fault, made)
        seconds = time.perf_counter() - started
        common.progress({"fault": fault.what, "seconds": seconds, "wrong": what})
        wrong += [f"{fault.what}: {what}"] * bool(what)
    yield {
        "fault": "a wrong argument of the API",
        "times": len(faults),
        "met by one sentence of its class": len(faults) - len(wrong),
        "wrong": wrong,
        "passed": not wrong,
    }


def meet(fault: Fault, made: Places) -> str:
    """Causes a fault and returns what is wrong with the result, or ""."""
    try:
        fault.call(made)
    except fault.kind as error:
        said = str(error)
        if fault.says not in said:
            return f"said: {said}"
        if "\n" in said or len(said) > LONGEST:
            return f"no single sentence: {said[:300]}"
        return ""
    except Exception as error:
        return f"raised {type(error).__name__}: {error}"
    return "was accepted"
