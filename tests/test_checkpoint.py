"""What is saved comes back to the bit, wherever in an iteration a run was stopped."""

import shutil
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import maxent_jax
from maxent_jax import algorithm, envs, errors
from maxent_jax.commands import train
from maxent_jax.config import preset
from maxent_jax.density import plane
from maxent_jax.envs.pendulum import Pendulum
from maxent_jax.runs import checkpoint, driver, files, integrity
from maxent_jax.runs.checkpoint import Progress
from maxent_jax.runs.signals import Interrupted, Interruption

GOLDEN = Path(__file__).parent / "golden"


def arrays(state):
    return jax.tree.map(np.asarray, state._replace(key=jax.random.key_data(state.key)))


def timeless(directory):
    rows = files.read_metrics(directory)
    return [{k: v for k, v in row.items() if not k.startswith("wall_")} for row in rows]


def restored(directory):
    name, _ = integrity.find(directory)
    return arrays(checkpoint.restore(directory, name, files.read_config(directory)))


class StopAt(Interruption):
    """As if a signal came before the n-th boundary."""

    def __init__(self, boundaries):
        self.boundaries = boundaries

    @property
    def received(self):
        self.boundaries -= 1
        return 15 if self.boundaries <= 0 else None


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        dict(method="h"),
        dict(method="la", refresh_period=10),
        dict(normalize_inputs=True, actor_average=0.01, snapshots=2),
        dict(env="ant", normalize_inputs=True, policy_lag=1),
        dict(episode_length=20, reference_size=128, cell_restarts=0.9),
    ],
    ids=["h", "la", "v", "lag", "cells"],
)
def test_a_run_stopped_anywhere_ends_as_one_that_was_not(tmp_path, monkeypatch, changes):
    config = preset("smoke", **{"env": "pendulum", "num_seeds": 2, **changes})
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for directory in (whole, broken):
        directory.mkdir()
    driver.train(config, whole, time.perf_counter())
    seen = []
    for boundary in (1, 1, 2, 1):  # begun; a segment; the iteration's end; begun again
        monkeypatch.setattr(driver, "Interruption", lambda n=boundary: StopAt(n))
        with pytest.raises(Interrupted) as stopped:
            driver.train(config, broken, time.perf_counter())
        assert stopped.value.exit_code == 143
        seen += integrity.checkpoints(broken)[-1:]
    monkeypatch.setattr(driver, "Interruption", lambda: StopAt(3))  # at the end
    assert driver.train(config, broken, time.perf_counter()) == (True, 15)
    assert driver.train(config, broken, time.perf_counter()) == (False, None)
    assert seen == ["0+0", "0+1", "1", "1+0"]
    assert timeless(broken) == timeless(whole)
    pairs = zip(jax.tree.leaves(restored(broken)), jax.tree.leaves(restored(whole)), strict=True)
    assert all(x.tobytes() == y.tobytes() for x, y in pairs)


def test_a_checkpoint_holds_all_that_was_measured(tmp_path):
    config = preset("smoke", env="pendulum")
    files.write_config(tmp_path, config, {}, {})
    state = algorithm.start(config)
    begun = {"weights": np.array([1, 0], np.float32), "num": np.array(3)}
    segments = [{"reward": np.array(np.nan, np.float32)}, {"reward": np.array(0.1, np.float32)}]
    saved = Progress([{"iteration": 1, "x": None}], begun, segments, {"parts": {"a": 0.1}})
    for name in ("1+2", "1+2"):  # the second takes the first one's place
        checkpoint.save(tmp_path, state, saved, {"device": "abacus"})
        assert integrity.checkpoints(tmp_path) == [name]
    progress, computed_with = checkpoint.read_progress(tmp_path, "1+2")
    assert progress.rows == saved.rows and progress.clock == saved.clock
    np.testing.assert_equal((progress.begun, progress.segments), (begun, segments))
    assert progress.segments[0]["reward"].dtype == np.float32
    assert computed_with["device"] == "abacus"
    assert computed_with["jax"] == jax.__version__
    back = checkpoint.restore(tmp_path, "1+2", config)
    pairs = zip(jax.tree.leaves(arrays(back)), jax.tree.leaves(arrays(state)), strict=True)
    assert all(x.tobytes() == y.tobytes() for x, y in pairs)


def test_two_checkpoints_are_kept(tmp_path):
    config = preset("smoke", env="pendulum")
    files.write_config(tmp_path, config, {}, {})
    state = algorithm.start(config)
    for i in range(4):
        checkpoint.save(tmp_path, state, Progress([{}] * i, None, [], {}), {})
    assert integrity.checkpoints(tmp_path) == ["2", "3"]


def test_a_checkpoint_of_another_config_does_not_fit(tmp_path):
    config = preset("smoke", env="pendulum")
    files.write_config(tmp_path, config, {}, {})
    checkpoint.save(tmp_path, algorithm.start(config), Progress([], None, [], {}), {})
    with pytest.raises(errors.CheckpointError, match="does not match its config"):
        checkpoint.restore_results(tmp_path, "0", preset("smoke", env="pendulum", hidden_size=16))


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_a_plane_of_what_is_no_position_in_metres_is_dropped(tmp_path, num_seeds):
    config = preset("smoke", env="pendulum", num_seeds=num_seeds)
    files.write_config(tmp_path, config, {}, {})
    state = algorithm.start(config)
    assert state.learner.plane is None
    visited = jnp.zeros((plane.SIDE, plane.SIDE) if num_seeds == 1 else (2, 4, 4), bool)
    older = state._replace(learner=state.learner._replace(plane=visited))
    checkpoint.save(tmp_path, older, Progress([], None, [], {}), {})
    back = checkpoint.restore(tmp_path, "0", config)
    assert back.learner.plane is None
    pairs = zip(jax.tree.leaves(arrays(back)), jax.tree.leaves(arrays(state)), strict=True)
    assert all(x.tobytes() == y.tobytes() for x, y in pairs)


@pytest.mark.parametrize("schema", files.READABLE)
def test_a_run_of_each_schema_loads(tmp_path, schema):
    """The first release with the schema made it; see golden/README.md."""
    directory = tmp_path / "golden"
    shutil.copytree(GOLDEN / str(schema), directory)
    run = maxent_jax.load_run(directory)
    expected = np.load(GOLDEN / "expected.npz")
    states = jax.numpy.asarray(expected["states"])
    np.testing.assert_array_equal(run.histogram, expected["histogram"])
    for i in range(run.num_policies):
        actions = run.policy(i)(states, jax.random.key(0))
        np.testing.assert_allclose(actions, expected["actions"][i], atol=1e-5)
    assert sum(path.stat().st_size for path in GOLDEN.rglob("*") if path.is_file()) < 1e6
    again = ["--resume", "--out", str(directory)]
    if schema in files.RESUMABLE:
        assert restored(directory).learner.env_steps == 400
        assert train.read_arguments(again).config == run.config
    else:
        with pytest.raises(errors.RunError, match=f"it has schema {schema}, and this release"):
            train.read_arguments(again).claim.check()


@jax.tree_util.register_pytree_node_class
class Pair:
    """A node that jax knows by a registration of its own."""

    def __init__(self, left, right):
        self.left, self.right = left, right

    def tree_flatten(self):
        return (self.left, self.right), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(*children)


class Strange(Pendulum):
    """Whose state holds what environments of others may hold: brax's ant on MJX has no contacts,
    an array without elements."""

    def reset(self, rng):
        info = {
            "none": None,
            "nothing": {},
            "empty": jnp.zeros((0, 3)),
            "key": jax.random.fold_in(rng, 1),
            "a/b": {"c": jnp.ones(2, jnp.bfloat16)},
            "a.b": (jnp.int8(3), [jnp.zeros(0, bool)], Pair(jnp.ones(1), jnp.zeros((2, 0)))),
            "7": jnp.array(True),
        }
        return super().reset(rng).replace(info=info)


def test_any_pytree_of_states_is_saved_and_comes_back(tmp_path):
    envs.register("strange", lambda backend, physics: Strange())
    config = preset("smoke", env="user:strange", num_iterations=1)
    state = algorithm.start(config)
    files.write_config(tmp_path, config, {}, {})
    checkpoint.save(tmp_path, state, Progress([], {}, [], {}), {})
    back = checkpoint.restore(tmp_path, integrity.find(tmp_path)[0], config)
    assert jax.tree.structure(back) == jax.tree.structure(state)
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(state), strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        if jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other)
    assert back.learner.episodes.env.info["empty"].shape == (4 * 2, 0, 3)
