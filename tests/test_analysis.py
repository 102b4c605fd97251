"""A run, loaded for analysis: its columns, features, exported policies and paths."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import commands
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from untrained import make_run

import maxent_jax
from maxent_jax import analysis, features
from maxent_jax.analysis import Paths
from maxent_jax.commands import evaluate
from maxent_jax.config import preset
from maxent_jax.errors import ConfigError
from maxent_jax.moments import Moments
from maxent_jax.runs import checkpoint, files, integrity


@pytest.fixture(scope="module")
def directory(smoke_run, tmp_path_factory):
    """A copy, because `evaluate` writes into it."""
    return Path(shutil.copytree(smoke_run, tmp_path_factory.mktemp("runs") / "ant"))


@pytest.fixture(scope="module")
def run(directory):
    return maxent_jax.load_run(directory)


@pytest.fixture(scope="module")
def visited(run):
    return run.occupancy(episodes_per_policy=2, seed=3)


def test_the_frame_has_a_column_for_each_number(run):
    frame = run.frame()
    assert len(frame) == 2 and frame["iteration"].tolist() == [1, 2]
    np.testing.assert_array_equal(frame["mixture_coverage"], run.metrics["mixture_coverage"])
    weights = frame[["weights_0", "weights_1", "weights_2"]]
    np.testing.assert_array_equal(weights, run.metrics["weights"])
    assert frame.shape[1] == sum(values[0].size for values in run.metrics.values())


def test_a_metric_of_more_axes_is_named_by_its_indices(run):
    cube = np.arange(12.0).reshape(2, 2, 3)
    frame = dataclasses.replace(run, metrics={"cube": cube}).frame()
    assert [*frame] == [f"cube_{i}_{j}" for i in range(2) for j in range(3)]
    np.testing.assert_array_equal(frame["cube_1_2"], cube[:, 1, 2])


def test_a_run_that_trains_meanwhile_is_loaded(copy_of_smoke_run, monkeypatch):
    restore = checkpoint.restore_results

    def slow(directory, name, config):
        if name == "2":  # saved again and again meanwhile, as "3" and "4"
            integrity.remove(directory, "2")
        return restore(directory, name, config)

    monkeypatch.setattr(checkpoint, "restore_results", slow)
    assert maxent_jax.load_run(copy_of_smoke_run).checkpoint == "1"


def test_a_column_that_an_older_release_did_not_measure_is_there(copy_of_smoke_run):
    folder = copy_of_smoke_run / integrity.FOLDER / "2"
    rows = files.read_metrics(folder)
    last = {name: rows[-1][name] for name in ("cells_1m", "segment_reward")}
    for name in last:
        del rows[0][name]
    files.write_metrics(folder, rows)
    (folder / integrity.MANIFEST).unlink()
    integrity.seal(folder)
    metrics = maxent_jax.load_run(copy_of_smoke_run).metrics
    for name, value in last.items():
        np.testing.assert_array_equal(metrics[name], [np.full_like(value, np.nan, float), value])


def test_a_frame_without_pandas_is_one_sentence(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        run.frame()


def test_features_are_the_environments(run, visited):
    phi = features.make_feature_map("ant")
    found = run.features(np.asarray(visited.states[:5]))
    assert found.shape == (5, len(run.components.phi.names)) == (5, 7)
    np.testing.assert_array_equal(found, phi(visited.states[:5]))


ELSEWHERE = """
import sys
from pathlib import Path
import jax, numpy as np
from jax import export
policy = export.deserialize(Path(sys.argv[1], "policy").read_bytes())
mean = export.deserialize(Path(sys.argv[1], "mean").read_bytes())
states = np.load(Path(sys.argv[1], "states.npy"))
drawn = [policy.call(states[:b], jax.random.key(7)) for b in (1, 3, 64)]
np.savez(Path(sys.argv[1], "found"), *drawn, mean.call(states))
assert not [name for name in sys.modules if name.startswith(("maxent_jax", "flax", "brax"))]
"""


def test_an_exported_policy_acts_without_this_package(run, visited, tmp_path):
    states = np.asarray(visited.states[:64])
    exported = run.export_policy(2)
    assert set(exported.platforms) == {"cpu", "cuda", "tpu"}
    (tmp_path / "policy").write_bytes(exported.serialize())
    (tmp_path / "mean").write_bytes(run.export_policy(2, deterministic=True).serialize())
    np.save(tmp_path / "states", states)
    line = [sys.executable, "-W", "error", "-c", ELSEWHERE, str(tmp_path)]
    subprocess.run(line, check=True, cwd=tmp_path)
    found = [*np.load(tmp_path / "found.npz").values()]
    for drawn in found[:-1]:
        expected = run.policy(2)(states[: len(drawn)], jax.random.key(7))
        # Compiled by itself: sums of 32 products may round in another order.
        np.testing.assert_allclose(drawn, expected, atol=1e-5)
    keys = jax.random.split(jax.random.key(8), 4000)
    below = jax.vmap(lambda key: run.policy(2)(states, key) < found[-1])(keys).mean(0)
    # Half of all draws lie below the action at the Gaussian's mean, whatever its spread; 5 standard
    # deviations of 0.5 / sqrt(4000).
    np.testing.assert_allclose(below, 0.5, atol=0.04)


def test_an_exported_policy_sees_inputs_normalized_by_its_own_moments():
    run = make_run(env="pendulum", normalize_inputs=True)
    plain = make_run(env="pendulum")  # the same weights
    mean, deviation = jnp.array([[0.5, -0.2, 3.0]]), jnp.array([[0.5, 0.25, 2.0]])
    stacked = (run.num_policies, 1)
    seen = Moments(
        jnp.tile(mean, stacked), jnp.tile(deviation**2, stacked), jnp.full(run.num_policies, 9.0)
    )
    archive = run.mixture._replace(parameters=run.mixture.parameters._replace(moments=seen))
    run = dataclasses.replace(run, mixture=archive)
    states = jax.random.normal(jax.random.key(3), (16, 3))
    found = run.export_policy(1, deterministic=True).call(states)
    by_hand = (states - mean) / deviation
    expected = plain.export_policy(1, deterministic=True).call(by_hand)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(found - plain.export_policy(1, deterministic=True).call(states)).max() > 0.01


def test_an_exported_policy_has_32_bits_in_a_program_with_64():
    run = make_run(env="pendulum")
    with jax.enable_x64(True):
        exported = run.export_policy(1, deterministic=True)
    assert {str(x.dtype) for x in (*exported.in_avals, *exported.out_avals)} == {"float32"}
    assert "f64" not in exported.mlir_module()


def test_a_run_equals_itself_and_no_other(run, directory):
    assert run == run and run != maxent_jax.load_run(directory) and run in {run}


def test_no_such_policy_is_exported(run):
    with pytest.raises(IndexError, match="policy is 3, but the mixture has 3"):
        run.export_policy(3)


def test_the_occupancy_of_paths_is_that_which_they_came_from(run, visited):
    again = run.occupancy_of(analysis.paths(visited))
    for mine, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(visited), strict=True):
        # Compiled apart from the rollout: features and sums of weights round differently.
        np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6)


def test_the_mixtures_cells_are_those_of_numpys_histogram(run, visited):
    grid = run.components.grid
    expected, *_ = np.histogram2d(
        *np.asarray(visited.states)[:, :2].T,
        bins=grid.bins,
        range=list(zip(grid.low, grid.high, strict=True)),
        weights=np.asarray(visited.weight),
    )
    # Derived: sums of at most 600 float32 weights, each rounded by 2^-24 of the sum.
    np.testing.assert_allclose(run.mixture_cells(visited), expected, rtol=1e-4)


def test_distances_of_ends_are_taken_from_each_start(run):
    states = np.zeros((6, 100, 29), np.float32)
    states[:, :, :2] = [1.0, -2.0]
    states[:, 4, :2] = [[4, 2], [1, 3], [1, -2], [2, -2], [1, -2], [1, 10]]
    alive = np.tile(np.arange(100) < 5, (6, 1))
    distances = analysis.mean_end_distances(run, Paths(states, alive, np.repeat(range(3), 2)))
    np.testing.assert_allclose(distances, [5, 0.5, 6])


def torques_of(paths):
    """Gymnasium's Pendulum-v1 solved for the action in [-1, 1] of each step, [E, T - 1]."""
    _, sin, speed = np.moveaxis(np.float64(paths.states), -1, 0)
    assert (np.abs(speed) < 8).all()  # where it is not clipped
    return (np.diff(speed) / 0.05 - 15 * sin[:, :-1]) / 6


def make_pushing(**changes):
    """Three policies: they push by about -0.3, 0 and 0.3 of the torque, and draw widely or not."""
    run = make_run(env="pendulum", episode_length=20, reference_size=100, **changes)
    output = run.mixture.parameters.actor["params"]["Dense_0"]
    push = jnp.array([[-0.3], [0.0], [0.3]])
    output["kernel"] = jnp.zeros_like(output["kernel"])
    output["bias"] = jnp.concatenate([jnp.arctanh(push), jnp.full_like(push, -2.0)], axis=1)
    return run


def test_a_run_that_is_evaluated_by_means_is_analysed_by_them():
    run = make_pushing(deterministic=True)
    expected = np.repeat([-0.3, 0.0, 0.3], 2)[:, None]
    # float32 speeds below 8, divided by 0.05 s and by the torque's 6.
    near = dict(atol=1e-5 / 0.05 / 6, rtol=0)
    for played in (run.rollout(2), analysis.paths(run.occupancy(2))):
        np.testing.assert_allclose(torques_of(played) - expected, 0, **near)
    assert np.std(torques_of(run.rollout(2, deterministic=False)) - expected) > 0.01
    plain = make_pushing()
    assert np.std(torques_of(plain.rollout(2)) - expected) > 0.01
    np.testing.assert_allclose(
        torques_of(plain.rollout(2, deterministic=True)) - expected, 0, **near
    )


def test_evaluate_measures_what_training_measured(tmp_path):
    # The pendulum always starts hanging, so by mean actions a policy has one episode.
    flags = ("--preset", "smoke", "--env", "pendulum", "--deterministic", "--out", tmp_path)
    commands.call("train", *flags)
    commands.call("evaluate", tmp_path, "--episodes", 1, "--seed", 9)
    report = json.loads((tmp_path / "evaluation.json").read_text())
    last = files.read_metrics(tmp_path)[-1]
    for name in ("mixture_coverage", "mixture_entropy", "evaluation_episode_length"):
        # Weights of the states are summed over other numbers of equal episodes.
        assert report[name] == pytest.approx(last[name], rel=1e-5)


def test_a_policy_acts_by_its_mean_on_demand(run, visited):
    states, key = np.asarray(visited.states[:8]), jax.random.key(1)
    mean = run.policy(1, deterministic=True)(states, key)
    exported = run.export_policy(1, deterministic=True).call(states)
    np.testing.assert_allclose(mean, exported, atol=1e-5)  # compiled apart
    assert np.abs(mean - run.policy(1)(states, key)).max() > 0.01


def test_a_mixture_that_draws_a_policy_at_each_step_is_played_so():
    run = make_pushing(mixing="step", leave_own_out=False, start="scratch", deterministic=True)
    whole, each = run.occupancies(4)
    pushes = torques_of(analysis.paths(whole)).round(1)
    # 19 draws of three policies miss one of them with probability below 2e-3.
    assert all(set(np.abs(episode)) == {0.0, 0.3} for episode in pushes)
    assert set(whole.episode_policy.tolist()) == {-1}
    np.testing.assert_allclose(whole.weight, 1 / len(whole.weight), rtol=1e-6)
    alone = torques_of(analysis.paths(each)).round(1)
    np.testing.assert_array_equal(alone, np.repeat([-0.3, 0.0, 0.3], 4)[:, None] + 0 * alone)
    assert len(run.summaries(each)) == 3
    with pytest.raises(ValueError, match=r"of policies \[-1\], but must be of all policies"):
        run.summaries(whole)
    assert run.measures(whole)["evaluation_episode_length"] == 20


def lived(lengths, policies):
    """Paths [E, 20] of the pendulum at rest, each over after a length."""
    states = np.tile(np.array([-1.0, 0.0, 0.0], np.float32), (len(lengths), 20, 1))
    return Paths(states, np.arange(20) < np.array(lengths)[:, None], np.array(policies))


@pytest.mark.parametrize("pooled", [False, True])
def test_states_weigh_by_policy_or_by_number(pooled):
    run = make_pushing(pooled=pooled)
    found = run.occupancy_of(lived([5, 5, 10, 20], [0, 0, 1, 2])).weight.reshape(20, 4)
    # Of 1/3 each: shared by 10, 10 and 20 states; or to each episode's states alike, where policy 0
    # played twice: 5, 10 and 20 states of an episode.
    by_policy = np.array([1 / 30, 1 / 30, 1 / 30, 1 / 60])
    expected = np.array([1 / 70, 1 / 70, 1 / 35, 1 / 35]) if pooled else by_policy
    np.testing.assert_allclose(found[0], expected, rtol=1e-5)


def test_a_pooled_mixture_is_played_by_weight():
    run = make_pushing(pooled=True, weights="geometric", eta=0.5)
    weights = np.array([4, 7, 13]) / 24  # 1/8, 1/4, 1/2 projected on the simplex
    visited, each = run.occupancies(20)
    drawn = np.bincount(visited.episode_policy, minlength=3)
    np.testing.assert_allclose(drawn, 60 * weights, atol=1)
    assert np.bincount(each.episode_policy).tolist() == [20, 20, 20]
    # Episodes of equal length: both estimate the same shares.
    of_policy = np.bincount(each.policy, np.asarray(each.weight))
    np.testing.assert_allclose(of_policy, weights, atol=1e-5)


def test_episodes_of_weightless_policies_do_not_count():
    run = make_pushing(weights="last")
    visited = run.occupancy_of(lived([5, 10, 18, 20], [0, 1, 2, 2]))
    visited = visited._replace(task_return=jnp.array([1.0, 2.0, 3.0, 5.0]))
    measured = run.measures(visited)
    assert measured["evaluation_episode_length"] == 19
    assert measured["mixture_coverage"] == 1


@pytest.mark.slow
def test_evaluate_measures_the_gap_to_gymnasium(run, directory, capsys):
    evaluate.main([str(directory), "--episodes", "1", "--gymnasium"])
    printed = capsys.readouterr().out
    report = json.loads((directory / "evaluation.json").read_text())["gymnasium"]
    assert report["environment"] == "Ant-v4" and "in Ant-v4" in printed
    distances = {f"policy_{i}_end_distance" for i in range(3)}
    assert {"mixture_coverage", "evaluation_episode_length"} | distances <= {*report["measures"]}
    for name, gap in report["measures"].items():
        assert gap["gymnasium"] - gap["ours"] == pytest.approx(gap["difference"])
        assert gap["chance"] >= 0 and name in printed


def test_evaluate_says_where_gymnasium_has_no_such_environment(tmp_path):
    files.write_config(tmp_path, preset("smoke", env="pendulum"), {}, {})
    (tmp_path / "checkpoints" / "1").mkdir(parents=True)
    with pytest.raises(ConfigError, match="pendulum is not played in Gymnasium"):
        evaluate.main([str(tmp_path), "--gymnasium"])
