"""The command line, end to end at toy size: files, resume, analysis, mistakes."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import ROOT, call, in_subprocess

import maxent_jax
from benchmarks import common
from benchmarks.gpu import parts
from maxent_jax import envs, errors, training
from maxent_jax.commands import train
from maxent_jax.config import preset
from maxent_jax.runs import driver, files, integrity
from maxent_jax.runs.claim import Claim
from maxent_jax.visual import plotting

NO_RENDERING = Path(__file__).parent / "no_rendering"
TINY = ("--preset", "smoke", "--num-segments", "1", "--mixture-episodes", "6")


def benchmark(name, *arguments):
    """What it prints at toy size where no library can render."""
    line = [sys.executable, "-m", f"benchmarks.{name}", "--toy", *map(str, arguments)]
    path = os.pathsep.join(filter(None, (str(NO_RENDERING), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"PYTHONPATH": path}
    return subprocess.run(
        line, cwd=ROOT, check=True, capture_output=True, text=True, env=environment
    ).stdout


@pytest.fixture
def finished(smoke_run):
    return smoke_run


def test_a_run_leaves_its_files(finished):
    names = {str(p.relative_to(finished)) for p in finished.rglob("*") if p.is_file()}
    figures = {f"figures/{name}.png" for name in ("curves", "occupancy", "fireworks")}
    assert {"config.json", "metrics.jsonl"} | figures <= names
    assert not [name for name in names if "tmp" in name]
    content = json.loads((finished / "config.json").read_text())
    assert content["method"] == {
        "weights": "uniform",
        "refresh_period": 0,
        "reference": "mixture",
        "start": "best",
    }
    assert content["deviations_from_the_paper"]["reward"]["value"] == "log1p"
    assert content["budget"] == {"env_steps": 800, "gradient_steps": 200}


def test_metrics_hold_one_line_an_iteration_and_mark_the_clock(finished):
    rows = files.read_metrics(finished)
    assert [row["iteration"] for row in rows] == [1, 2]
    assert [row["env_steps"] for row in rows] == [400, 800]
    assert all(0 < row["wall_begin"] < row["wall_seconds"] for row in rows)
    assert rows[0]["wall_seconds"] < rows[1]["wall_seconds"]
    for name in ("cumulative", "random", "mixture"):
        assert all(row[f"{name}_coverage"] >= 1 for row in rows)


def test_a_run_loads_for_analysis(finished):
    run = maxent_jax.load_run(finished)
    assert run.config == preset("smoke")
    assert run.num_policies == 3
    np.testing.assert_allclose(run.weights, 1 / 3, rtol=1e-6)
    assert run.histogram.sum() == 800
    assert run.metrics["cumulative_coverage"][-1] == (run.histogram > 0).sum()
    state, key = jax.numpy.zeros((5, 29)).at[:, 3].set(1.0), jax.random.key(0)
    actions = [run.policy(i)(state, key) for i in range(3)]
    assert all(a.shape == (5, 8) and (np.abs(a) <= 1).all() for a in actions)
    assert not np.allclose(actions[0], actions[2])
    assert run.act(state, key).shape == (5, 8)
    paths = run.rollout(episodes_per_policy=2)
    assert paths.states.shape == (6, 100, 29)
    assert paths.policy.tolist() == [0, 0, 1, 1, 2, 2]
    assert (paths.alive.sum(1) >= 1).all()
    with pytest.raises(IndexError):
        run.policy(3)


def test_evaluate_reports_each_policy(finished):
    printed = call("evaluate", finished, "--episodes", 1).stdout
    report = json.loads((finished / "evaluation.json").read_text())
    assert len(report["policies"]) == 3
    assert report["training_coverage"] == (maxent_jax.load_run(finished).histogram > 0).sum()
    assert "mixture_coverage" in printed and len(printed.splitlines()) > 4


def test_resuming_a_finished_run_changes_nothing(finished):
    def contents():
        return {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()}

    before = contents()
    done = call("train", "--preset", "smoke", "--out", finished, "--resume")
    assert "complete" in done.stdout
    assert contents() == before


def test_a_run_killed_before_its_figures_gets_them_on_resume(finished):
    (finished / "figures" / "curves.png").unlink()
    call("train", "--preset", "smoke", "--out", finished, "--resume")
    assert (finished / "figures" / "curves.png").exists()


@pytest.mark.parametrize("trained", [True, False])
def test_figures_are_drawn_anew_unless_nothing_was_trained(copy_of_smoke_run, monkeypatch, trained):
    directory = copy_of_smoke_run
    paths = [directory / "figures" / f"{name}.png" for name in plotting.NAMES]
    for path in paths:
        path.write_bytes(b"by evaluate, while the run was training")
    monkeypatch.setattr(driver, "train", lambda *_: driver.Ended(trained))
    training.run_to_end(preset("smoke"), directory, time.perf_counter(), driver.AS_USUAL)
    assert all(path.read_bytes().startswith(b"\x89PNG") == trained for path in paths)


def test_the_evaluation_of_another_seed_leaves_the_first_ones(two_seeds, tmp_path):
    directory = Path(shutil.copytree(two_seeds, tmp_path / "two"))
    call("evaluate", directory, "--episodes", 1)
    held = {p: p.read_bytes() for p in directory.rglob("*") if p.suffix in (".png", ".json")}
    call("evaluate", directory, "--episodes", 1, "--seed-index", 1)
    assert all(path.read_bytes() == content for path, content in held.items())
    reports = [directory / name for name in ("evaluation.json", "evaluation_seed_1.json")]
    seeds = [json.loads(path.read_text())["trained_with_seed"] for path in reports]
    assert seeds == [0, 1]
    for name in plotting.NAMES:
        first, second = (directory / "figures" / place / f"{name}.png" for place in ("", "seed_1"))
        assert second.read_bytes() not in (b"", first.read_bytes())


def test_overwriting_removes_the_evaluations_of_every_seed(tmp_path):
    config = preset("smoke", num_seeds=2)
    files.write_config(tmp_path, config, {}, {})
    for name in ("evaluation.json", "evaluation_seed_1.json", "evaluation_seed_mine.json"):
        (tmp_path / name).write_text("{}")
    with Claim(tmp_path, config, overwrite=True).hold():
        left = {path.name for path in tmp_path.iterdir()}
    assert left == {"evaluation_seed_mine.json", "lock"}


def test_a_run_can_be_looked_at_with_any_number_of_episodes(finished):
    visited = maxent_jax.load_run(finished).occupancy(episodes_per_policy=1)
    assert np.bincount(visited.episode_policy).tolist() == [1, 1, 1]


@pytest.mark.slow
def test_resume_without_a_checkpoint_starts_over(tmp_path):
    config = preset("smoke")
    files.write_config(tmp_path, config, {}, {})
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 1}\n{"itera')
    resumed = train.read_arguments(["--preset", "smoke", "--out", str(tmp_path), "--resume"])
    with resumed.claim.hold():
        driver.train(resumed.config, resumed.directory, time.perf_counter())
    assert [row["env_steps"] for row in files.read_metrics(tmp_path)] == [400, 800]


def test_several_seeds_train_side_by_side(two_seeds):
    rows = files.read_metrics(two_seeds)
    assert [row["env_steps"] for row in rows] == [[400, 400], [800, 800]]
    loaded = [maxent_jax.load_run(two_seeds, seed_index=i) for i in range(2)]
    assert [run.histogram.sum() for run in loaded] == [800, 800]
    assert not np.array_equal(loaded[0].histogram, loaded[1].histogram)
    with pytest.raises(errors.RunError, match="2 seeds"):
        maxent_jax.load_run(two_seeds, seed_index=2)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("method", "period"), [("h", -1), ("la", 1), ("la", 10), ("la", 0), ("v", -1)]
)
def test_every_method_runs_on_both_backends(tmp_path, backend, method, period):
    num_iterations = {"mujoco": 2, "mjx": 1}[backend]
    config = preset(
        "smoke",
        backend=backend,
        physics={"mujoco": "reference", "mjx": "fast"}[backend],  # for MJX is slow on a CPU
        method=method,
        refresh_period=period,
        num_iterations=num_iterations,
    )
    driver.train(config, tmp_path, time.perf_counter())  # in this process: compiled once
    assert [row["env_steps"] for row in files.read_metrics(tmp_path)] == [400, 800][:num_iterations]


def run_smoke(directory, env, backend, **changes):
    config = preset("smoke", env=env, backend=backend, num_iterations=1, **changes)
    with jax.numpy_rank_promotion("allow"), jax.legacy_prng_key("allow"):  # for brax
        training.run_to_end(config, directory, time.perf_counter(), driver.AS_USUAL)
    (row,) = files.read_metrics(directory)
    assert row["env_steps"] == 400 and row["num_invalid"] == 0
    assert maxent_jax.load_run(directory).histogram.sum() <= 400
    assert (directory / "figures" / "fireworks.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize("env", [pytest.param("humanoid", marks=pytest.mark.slow), "pendulum"])
def test_every_environment_runs(tmp_path, env):
    run_smoke(tmp_path, env, "auto")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "backend"),
    [
        *(("mountain_car", "auto"), ("walker2d", "mujoco")),
        *(("walker2d", "mjx"), ("humanoid", "mjx")),
        ("brax:halfcheetah", "auto"),
    ],
)
def test_every_environment_runs_on_every_backend(tmp_path, env, backend):
    run_smoke(tmp_path, env, backend)
    jax.clear_caches()  # the largest programs, see conftest.forget_programs


@pytest.mark.slow
def test_an_environment_of_braxs_trains_on_mjx_and_saves_itself(tmp_path):
    where = ("--env", "brax:ant", "--backend", "mjx", "--out", tmp_path / "run")
    in_subprocess("train", "--preset", "smoke", "--num-iterations", "1", *where)
    assert "checkpoint 1: intact" in call("verify", tmp_path / "run").stdout
    assert (tmp_path / "run" / "figures" / "fireworks.png").exists()


@pytest.mark.warp
@pytest.mark.parametrize("env", ["ant", "walker2d", "humanoid"])
def test_every_robot_runs_on_warp(tmp_path, env):
    run_smoke(tmp_path, env, "warp")


@pytest.mark.slow
def test_an_environment_of_the_users_trains(tmp_path):
    (tmp_path / "cart.xml").write_text(
        """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
        <geom size="0.1" mass="1"/></body></worldbody>
        <actuator><motor joint="rail" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>"""
    )
    make = lambda backend, physics: envs.from_xml(tmp_path / "cart.xml", 5, backend, physics)
    envs.register("cart", make)
    directory = tmp_path / "run"
    directory.mkdir()
    run_smoke(directory, "user:cart", "mujoco")


def test_resume_with_other_settings_names_them(finished):
    line = ("train", "--preset", "smoke", "--out", finished, "--resume")
    done = call(*line, "--learning-rate", "0.5", expect=2)
    assert "learning_rate was 0.0003 and is 0.5" in done.stderr


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: (d / "config.json").unlink(),
        lambda d: (d / "config.json").write_text("{"),
        lambda d: (d / "config.json").write_text('{"schema": 99, "config": {}}'),
        lambda d: (d / "config.json").write_text(
            json.dumps({"schema": files.SCHEMA, "config": {"no_such": 1}})
        ),
    ],
)
def test_evaluate_refuses_a_directory_that_is_no_run(tmp_path, damage):
    files.write_config(tmp_path, preset("smoke"), {}, {})
    damage(tmp_path)
    done = call("evaluate", tmp_path, expect=2)
    assert done.stderr.count("\n") == 1 and str(tmp_path) in done.stderr


@pytest.mark.slow
def test_a_damaged_checkpoint_is_named_and_passed_over_on_demand(finished, tmp_path):
    directory = tmp_path / "damaged"
    shutil.copytree(finished, directory)
    (directory / "checkpoints" / "2" / "arrays" / "results" / "_METADATA").unlink()
    done = call("evaluate", directory, expect=2)
    assert "checkpoint 2" in done.stderr and done.stderr.count("\n") == 1
    assert "arrays/results/_METADATA is missing" in done.stderr
    assert "arrays/results/_METADATA" in call("verify", directory, expect=1).stdout
    with pytest.warns(UserWarning, match="checkpoint 2"):
        assert maxent_jax.load_run(directory, fallback=True).num_policies == 2
    done = call("train", "--out", directory, "--resume", "--fallback")
    assert "continues from checkpoint 1" in done.stderr
    assert maxent_jax.load_run(directory).num_policies == 3
    assert "damaged" not in call("verify", directory).stdout


@pytest.mark.slow
def test_a_run_resumes_with_its_own_settings_and_is_overwritten_on_demand(finished, tmp_path):
    directory = tmp_path / "run"
    shutil.copytree(finished, directory)
    (directory / "mine.txt").write_text("kept")
    assert "complete" in call("train", "--out", directory, "--resume").stdout
    call("train", *TINY, "--num-iterations", 1, "--out", directory, "--overwrite")
    assert len(files.read_metrics(directory)) == 1
    assert (directory / "mine.txt").read_text() == "kept"


def test_another_stack_is_said_to_give_other_bits(finished, tmp_path):
    directory = tmp_path / "run"
    shutil.copytree(finished, directory)
    shutil.rmtree(directory / "checkpoints" / "2")
    checkpoint = directory / "checkpoints" / "1"
    content = json.loads((checkpoint / "progress.json").read_text())
    content["computed_with"]["jax"] = "0.0.1"
    (checkpoint / "progress.json").write_text(json.dumps(content))
    (checkpoint / integrity.MANIFEST).unlink()
    integrity.seal(checkpoint)
    done = call("train", "--out", directory, "--resume")
    (note,) = [line for line in done.stderr.splitlines() if line.startswith("note: ")]
    assert "jax was 0.0.1" in note and "may not be bit-identical" in note


def test_a_directory_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    done = call("train", "--out", tmp_path / "file" / "run", expect=2)
    assert "cannot write" in done.stderr and done.stderr.count("\n") == 1


def test_evaluate_says_when_there_is_no_checkpoint(tmp_path):
    files.write_config(tmp_path, preset("smoke"), {}, {})
    assert "no complete checkpoint" in call("evaluate", tmp_path, expect=2).stderr


TOY = (
    *("knn", "envs", "physics", "sac", "seeds", "forward_velocity", "compile_time", "replay"),
    "growth",
)


@pytest.mark.slow
@pytest.mark.parametrize("module", [*TOY, "learning", "faults"])
def test_a_benchmark_ends_with_json_rows(module):
    printed = benchmark(module).splitlines()
    assert printed[0].startswith("# python")
    assert json.loads(printed[-1])["benchmark"] == module


def test_a_peer_that_fails_costs_its_own_row(capsys):
    def fails():
        raise OSError("no such thing\non a second line")

    broken = common.Peer("absent", "no_such_module", fails)
    assert common.importable([broken]) == []
    assert common.measured(broken, fails) is None
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("not measured: absent (ModuleNotFoundError: ")
    assert said[1] == "not measured: absent (OSError: no such thing)"


def rows_of(part, out):
    return [json.loads(line) for line in (out / f"{part}.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_what_a_gpu_is_asked_runs_on_a_cpu(tmp_path):
    for part, asked in parts.PARTS.items():
        printed = benchmark("gpu", "--part", part, "--out", tmp_path)
        found = [row["section"] for row in rows_of(part, tmp_path)]
        assert "failed" not in found and len(set(found)) >= len(asked)
        lines = [line for line in printed.splitlines() if not line.startswith("#")]
        assert "programs compiled" in lines[0] and len(lines) <= 10
    assert len(list(tmp_path.iterdir())) <= 6
    played = rows_of("first", tmp_path)[-1]
    assert played["section"] == "played" and len(played["ends"]) == 3
    with tarfile.open(tmp_path / "first.tar.gz") as packed:
        names = packed.getnames()
    assert "ant/metrics.jsonl" in names and "ant/figures/fireworks.png" in names


@pytest.mark.slow
def test_without_a_compiler_for_gpus_nothing_is_asked_of_it():
    line = [sys.executable, "-m", "benchmarks.gpu_compile", "--toy"]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    asked = done.returncode == 0 and json.loads(done.stdout.splitlines()[-1])["kernels"] > 0
    assert asked or (done.returncode == 2 and "jax[cuda13]" in done.stderr)


@pytest.mark.slow
def test_a_part_whose_time_is_up_keeps_its_rows(tmp_path):
    printed = benchmark("gpu", "--part", "first", "--seconds", "20", "--out", tmp_path)
    assert "programs compiled" in printed
    assert rows_of("first", tmp_path)[0]["section"] == "device"


@pytest.mark.slow
def test_an_iteration_ends_at_a_plateau(tmp_path):
    config = preset(
        "smoke",
        env="pendulum",
        num_segments=10,
        num_iterations=1,
        plateau_segments=1,
        plateau_tolerance=1.0,  # any segment after the lowest
    )
    driver.train(config, tmp_path, time.perf_counter())
    (row,) = files.read_metrics(tmp_path)
    taken = row["segments_trained"]
    assert row["converged"] and 2 <= taken < 10
    assert row["env_steps"] == 40 * taken
    rewards = row["segment_reward"]
    assert None not in rewards[:taken] and rewards[taken:] == [None] * (10 - taken)
    assert maxent_jax.load_run(tmp_path).metrics["segment_reward"].shape == (1, 10)


@pytest.mark.slow
def test_the_feature_table_is_what_its_script_measures():
    from experiments import measure_features
    from maxent_jax import features

    table = measure_features.measure("ant")
    shipped = features.make_feature_map("ant")
    # contacts are chaotic over 10,000 random steps: another CPU may reach other extremes
    np.testing.assert_allclose(table["projection"], shipped.projection, rtol=0.3)
    assert tuple(table["names"]) == shipped.names


def test_the_cache_folder_is_the_users_own(monkeypatch):
    environment = os.environ | {"XDG_CACHE_HOME": "elsewhere"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    code = (
        "import jax; from maxent_jax.runs import runtime; runtime.prepare(False);"
        "print(jax.config.jax_compilation_cache_dir)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()) == Path("elsewhere", "maxent_jax", "jax")
