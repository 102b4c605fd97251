"""Studies: equal budgets and one projection for all methods, and no finished cell twice."""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from maxent_jax import errors, training
from maxent_jax.commands import reproduce
from maxent_jax.config import preset
from maxent_jax.errors import ConfigError
from maxent_jax.features import make_feature_map
from maxent_jax.runs import atomic, files
from maxent_jax.studies import disk, paper_figures, protocol, results, values
from maxent_jax.studies.protocol import Cell

TOY = ["--scale", "toy", "--seeds", "1"]
ALL = [(name, scale) for name in protocol.STUDIES for scale in protocol.SCALES]


@pytest.mark.parametrize(("name", "scale"), ALL)
def test_all_methods_of_a_study_have_one_budget_and_one_environment(name, scale):
    cells = protocol.make(name, scale)
    assert len({cell.name for cell in cells}) == len(cells)
    explore = [cell for cell in cells if cell.config.downstream.task == "none"]
    for env in {cell.config.env for cell in cells}:
        own = [cell for cell in explore if cell.config.env == env]
        budgets = {
            (
                c.budget.steps_per_iteration * c.budget.num_iterations,
                c.vector_steps
                * c.budget.num_segments
                * c.budget.num_iterations
                * c.updates_per_vector_step,
                c.mixture.mixture_episodes * c.environment.episode_length,
                c.learner.batch_size,
            )
            for c in (cell.config for cell in own)
            if c.method != "metra"
        }
        assert len(budgets) == 1
        seeds = {
            method: sorted(
                seed
                for cell in own
                if cell.method == method
                for seed in range(cell.config.seed, cell.config.seed + cell.config.num_seeds)
            )
            for method in {cell.method for cell in own}
        }
        assert len({tuple(of_method) for of_method in seeds.values()}) == 1
        steps = {cell.config.budget.steps_per_iteration for cell in own}
        assert len(steps) == 1  # also of METRA, which has its authors' gradient steps


@pytest.mark.parametrize("scale", protocol.SCALES)
@pytest.mark.parametrize("name", ["baselines", "published"])
def test_methods_that_are_compared_by_their_rewards_have_one_learner(name, scale):
    rewards = {"method", "bonus", "mixing", "leave_own_out", "reward_scale"}
    for cell in (cells := protocol.make(name, scale)):
        of_env = [other for other in cells if other.config.env == cell.config.env]
        fields = cell.config.flat()
        other = of_env[0].config.flat()
        differing = {field for field in fields if fields[field] != other[field]}
        differing -= {"seed", "random_baseline"}  # a random policy beside it is no learner
        if cell.config.method not in ("h", "la", "v"):
            differing -= {"episodic_weight"}  # which a bonus takes the place of
        assert differing <= rewards, cell.name


@pytest.mark.parametrize("name", protocol.STUDIES)
def test_all_methods_of_a_study_share_one_projection(name):
    from maxent_jax import components

    # The map has no other argument than the environment's name: no method, seed or setting.
    for cell in protocol.make(name, "toy"):
        phi = components.make(cell.config).phi
        if cell.config.environment.skill_size:
            phi = phi.phi  # of the state, without the skill
        assert phi == make_feature_map(cell.config.env)


def test_fewer_seeds_are_a_part_of_the_study():
    whole, part = protocol.make("fig4", "cpu"), protocol.make("fig4", "cpu", 2)
    assert part == whole[: len(part)]


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["fig9"], "did you mean 'fig"),
        (["stael"], "did you mean 'stale'"),
        (["fig4", "--scale", "cpus"], "did you mean 'cpu'"),
        (["fig3", "--no-figures"], "has no cells"),
        (["fig2", "--shard", "0/2"], "has no cells"),
        (["fig4", "--seeds", "0"], "at least 1"),
        (["fig4", "--jobs", "0"], "at least 1"),
        (["fig4", "--shard", "2/2"], "0 <= I < N"),
        (["fig4", "--shard", "half"], "0 <= I < N"),
        (["fig4", "--shard", "²/3"], "0 <= I < N"),
    ],
)
def test_bad_input_is_one_sentence_before_anything_is_written(tmp_path, argv, sentence):
    with pytest.raises((errors.UsageError, ConfigError), match=sentence) as error:
        reproduce.main([*argv, "--out", str(tmp_path / "studies")])
    assert "\n" not in str(error.value)
    assert not (tmp_path / "studies").exists()


def test_bad_input_is_met_without_jax():
    code = (
        "import sys; from maxent_jax.commands import cli, reproduce\n"
        "try: reproduce.main(['fig4', '--seeds', '0'])\n"
        "except cli.UsageError: sys.exit('jax' in sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_a_directory_belongs_to_one_study_and_may_gain_seeds(tmp_path):
    directory = tmp_path / "fig4"
    one, two = (protocol.make("fig4", "cpu", seeds) for seeds in (1, 2))
    directory.mkdir()
    (directory / "study.tmp.json").write_text("{")  # of a process that was killed in its first step
    disk.claim(directory, "fig4", "cpu", two)
    disk.claim(directory, "fig4", "cpu", one)
    held = json.loads((directory / disk.STUDY).read_text())
    assert set(held["cells"]) == {cell.name for cell in two}

    changed = [one[0]._replace(config=one[0].config.replace(eta=0.5))]
    with pytest.raises(errors.UsageError, match=r"eta was 0\.1 and is 0\.5; choose another --out"):
        disk.claim(directory, "fig4", "cpu", changed)
    with pytest.raises(errors.UsageError, match="scale is cpu, not paper"):
        disk.claim(directory, "fig4", "paper", protocol.make("fig4", "paper"))
    name = one[0].name
    before = {key: value for key, value in held["cells"][name].items() if key != "stale_rewards"}
    earlier = held | {"cells": held["cells"] | {name: before}}  # of a release without that field
    (directory / disk.STUDY).write_text(json.dumps(earlier))
    disk.claim(directory, "fig4", "cpu", one)
    stale = [one[0]._replace(config=one[0].config.replace(stale_rewards=True))]
    (directory / disk.STUDY).write_text(json.dumps(earlier))
    with pytest.raises(errors.UsageError, match="stale_rewards was False and is True"):
        disk.claim(directory, "fig4", "cpu", stale)
    (directory / disk.STUDY).write_text(json.dumps(held | {"version": 0}))
    with pytest.raises(errors.UsageError, match="version is 0, not 1"):
        disk.claim(directory, "fig4", "cpu", one)
    (directory / disk.STUDY).write_text("{")
    with pytest.raises(errors.UsageError, match="cannot be read"):
        disk.claim(directory, "fig4", "cpu", one)
    with pytest.raises(errors.UsageError, match="not empty"):
        disk.claim(tmp_path, "fig4", "cpu", one)


def test_processes_may_claim_a_directory_at_the_same_time(tmp_path):
    shares = [protocol.make("fig4", "cpu", seeds) for seeds in (1, 2, 3, 4) * 4]
    with ThreadPoolExecutor(16) as pool:
        list(pool.map(lambda cells: disk.claim(tmp_path / "s", "fig4", "cpu", cells), shares))
    held = json.loads((tmp_path / "s" / disk.STUDY).read_text())
    assert set(held["cells"]) == {cell.name for cell in shares[3]}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """fig5 at toy size, which needs the runs of fig4, stopped once in the middle; and the calls."""
    out, trained = tmp_path_factory.mktemp("studies"), []
    whole = training.run_to_end

    def until_the_second(config, directory, *rest):
        if len(trained) == 1:
            raise KeyboardInterrupt
        trained.append(directory.name)
        whole(config, directory, *rest)

    def all_of_it(config, directory, *rest):
        trained.append(directory.name)
        whole(config, directory, *rest)

    argv = ["fig5", *TOY, "--out", str(out)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "run_to_end", until_the_second)
        with pytest.raises(KeyboardInterrupt):
            reproduce.main(argv)
        patch.setattr(training, "run_to_end", all_of_it)
        reproduce.main(argv)
        reproduce.main(["fig4", *TOY, "--out", str(out)])
    return out, trained


def test_a_stopped_study_repeats_no_finished_cell(finished):
    _, trained = finished
    assert trained == [cell.name for cell in protocol.make("fig4", "toy", 1)]


def test_a_run_that_another_study_has_is_not_trained_again(finished, monkeypatch):
    out, _ = finished
    trained = []
    monkeypatch.setattr(training, "run_to_end", lambda config, at, *_: trained.append(at))
    for study in ("start", "weights", "refresh"):
        reproduce.main([study, *TOY, "--out", str(out), "--no-figures"])
    names = {directory.relative_to(out).as_posix() for directory in trained}
    cells = {
        f"{study}/{cell.name}"
        for study in ("start", "weights", "refresh")
        for cell in protocol.make(study, "toy", 1)
    }
    theirs = {"start/pendulum-best-0", "weights/pendulum-uniform-0", "refresh/pendulum-every_1-0"}
    assert theirs < cells and names == cells - theirs

    uniform = protocol.make("weights", "toy", 1)[0]
    assert disk.home(out / "weights", uniform) == out / "fig4" / "pendulum-V-0"
    assert values.read(out / "weights", [uniform])[0]["method"] == "uniform"
    (out / "broken").mkdir()
    (out / "broken" / disk.STUDY).write_text("{")
    assert disk.home(out / "weights", uniform) == out / "fig4" / "pendulum-V-0"
    (out / "weights" / uniform.name).mkdir()
    assert disk.home(out / "weights", uniform) == out / "weights" / uniform.name


def test_a_finished_run_with_other_settings_is_no_cell(finished, monkeypatch, capsys):
    out, _ = finished
    cell = protocol.make("fig4", "toy", 1)[0]
    path = out / "fig4" / cell.name / "config.json"
    kept = path.read_text()
    content = json.loads(kept)
    content["config"]["eta"] = 0.5
    path.write_text(json.dumps(content))
    trained = []
    monkeypatch.setattr(training, "run_to_end", lambda config, at, *_: trained.append(at))
    with pytest.raises(SystemExit) as stop:
        reproduce.main(["fig4", *TOY, "--out", str(out)])
    path.write_text(kept)
    assert stop.value.code == 1 and not trained
    assert "other settings: eta was 0.5 and is 0.1. Continuing" in capsys.readouterr().err


def test_a_cell_that_cannot_be_trained_does_not_keep_the_others_from_it(
    tmp_path, monkeypatch, capsys
):
    trained = []

    def fail_once(config, directory, *_):
        trained.append(directory.name)
        if len(trained) == 1:
            raise errors.NonFiniteError("the loss is not finite.")

    monkeypatch.setattr(training, "run_to_end", fail_once)
    with pytest.raises(SystemExit) as stop:
        reproduce.main(["fig4", *TOY, "--out", str(tmp_path)])
    assert stop.value.code == 1
    assert trained == [cell.name for cell in protocol.make("fig4", "toy", 1)]
    assert "the loss is not finite. Continuing with the next cell." in capsys.readouterr().err


def test_a_signal_reaches_the_jobs_and_is_waited_for(tmp_path, monkeypatch, capsys):
    started = []
    whole = subprocess.Popen

    def child(_, **options):
        code = (
            "import signal, sys, time\n"
            "signal.signal(signal.SIGTERM, lambda *_: (time.sleep(0.5), sys.exit(143)))\n"
            "print('ready', flush=True); time.sleep(60)"
        )
        started.append(whole([sys.executable, "-c", code], stdout=subprocess.PIPE, **options))
        assert started[-1].stdout.readline() == b"ready\n"
        if len(started) == 2:
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM)).start()
        return started[-1]

    monkeypatch.setattr(reproduce.subprocess, "Popen", child)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as stop:
        reproduce.main(["fig4", *TOY, "--jobs", "2", "--out", str(tmp_path)])
    for process in started:
        process.stdout.close()
    assert stop.value.code == 143 and [process.poll() for process in started] == [143, 143]
    assert "2 of 2 jobs did not finish" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_environments_are_summarised_apart_and_never_confused():
    """Cells of 64 and of 132, with rows of a method appended in another order of environments."""
    rng = np.random.default_rng(0)
    cells = {"mountain_car": 100.0, "pendulum": 50.0}
    noise = {env: rng.normal(size=10) for env in cells}

    def columns(env, ahead):
        last = cells[env] + noise[env] + ahead
        names = ("env_steps", *results.SUMMARISED)
        return {name: np.stack([last - 1, last], axis=1) for name in names}

    ahead = {"V": 100.0, "near": 0.0, "MEPOL": 0.0}
    order = [(env, m) for env in ("mountain_car", "pendulum") for m in ("V", "near")]
    order += [("pendulum", "MEPOL"), ("mountain_car", "MEPOL")]
    found = results.summarise([(env, m, columns(env, ahead[m])) for env, m in order])
    for env, level in cells.items():
        table = found["last_iteration"][env]["mixture_coverage"]
        assert abs(table["near"]["interquartile_mean"] - level) < 1
        assert abs(table["V"]["interquartile_mean"] - level - 100) < 1
    everywhere = found["all_environments"]["mixture_coverage"]
    assert {m: of["probability_of_improvement"] for m, of in everywhere.items()} == {
        "near": 1.0,
        "MEPOL": 1.0,
    }


def test_a_summary_counts_the_seeds_of_each_environment():
    """As in fig4 at scale cpu: five seeds of Ant, three of Humanoid."""
    names = ("env_steps", *results.SUMMARISED)
    seeds = {"ant": 5, "humanoid": 3}
    columns = {env: dict.fromkeys(names, np.ones((number, 2))) for env, number in seeds.items()}
    groups = [(env, method, columns[env]) for env in columns for method in ("V", "H")]
    assert results.summarise(groups)["seeds"] == seeds


def test_what_methods_differ_in_as_a_number_is_an_axis():
    """Each study's numbers, and what is drawn over them: mean, interval and every seed."""
    found = {}
    for name, study in protocol.STUDIES.items():
        if study.along:
            cells = protocol.make(name, "cpu", 1)
            found[name] = {c.method: results.ALONG[study.along][1](c.config) for c in cells}
    iteration = protocol.make("refresh", "cpu", 1)[0].config.budget.steps_per_iteration
    assert list(found) == ["refresh", "refresh_classic", "episodic"]
    assert list(found["refresh"].values()) == [64, 640, 6400, iteration]
    assert list(found["episodic"].values()) == [0, 0.01, 0.1, 1]

    columns = {"a": np.array([[0.0, 4.0], [0.0, 8.0]]), "b": np.array([[9.0, 1.0], [9.0, 3.0]])}
    names = ("env_steps", *(name for name, _ in paper_figures.QUANTITIES))
    columns["c"] = columns["b"] + 4  # placed where b is, as two periods of a short iteration
    groups = [("ant", m, dict.fromkeys(names, column)) for m, column in columns.items()]
    of_random = {"env_steps": np.zeros((2, 1)), "cumulative_coverage": np.array([[5.0], [7.0]])}
    groups.append(("ant", values.RANDOM, of_random))
    places = {("ant", "a"): 10.0, ("ant", "b"): 0.0, ("ant", "c"): 0.0}
    figure = paper_figures.along(groups, places, "λ", "title")
    drawn = [[np.asarray(line.get_xydata()) for line in ax.get_lines()] for ax in figure.axes]
    assert [len(lines) for lines in drawn] == [4, 3, 3, 3]
    for middle, *seeds in drawn:
        assert middle.tolist() == [[0, 2], [0, 6], [10, 6]]
        assert seeds[0].tolist() == [[0, 1], [0, 5], [10, 4]]
        assert seeds[1].tolist() == [[0, 3], [0, 7], [10, 8]]
    assert (drawn[0][-1][:, 1] == 6).all()


def test_several_environments_have_a_row_each_and_one_has_all_axes():
    def group(env, method, seeds):
        names = (*(axis for axis, _, _ in paper_figures.AXES), *dict(paper_figures.QUANTITIES))
        return env, method, {name: np.ones((seeds, 2)) for name in names}

    several = [group("ant", "V", 3), group("ant", "H", 3), group("walker2d", "V", 5)]
    figure = paper_figures.curves(several, "title")
    assert len(figure.axes) == 2 * len(paper_figures.QUANTITIES)
    first_of_rows = figure.axes[:: len(paper_figures.QUANTITIES)]
    assert [ax.get_ylabel() for ax in first_of_rows] == ["ant", "walker2d"]
    assert [len(ax.get_lines()) for ax in first_of_rows] == [2, 1]
    assert figure.axes[-1].get_xlabel() == "thousand env steps"
    assert figure.get_suptitle().endswith("seeds: ant 3, walker2d 5")

    figure = paper_figures.curves(several[:2], "title")
    assert len(figure.axes) == len(paper_figures.QUANTITIES) * len(paper_figures.AXES)
    assert figure.get_suptitle().endswith("3 seeds")


def test_the_raw_values_are_those_of_the_runs(finished):
    out, _ = finished
    with open(out / "fig4" / "raw.csv") as file:
        rows = list(csv.DictReader(file))
    cells = protocol.make("fig4", "toy", 1)
    iterations = cells[0].config.budget.num_iterations
    assert len(rows) == (len(cells) + 1) * iterations  # and the random policy
    for cell in cells:
        kept = files.read_metrics(out / "fig4" / cell.name)
        own = [
            row
            for row in rows
            if (row["method"], row["seed"]) == (cell.method, str(cell.config.seed))
        ]
        for row, metrics in zip(own, kept, strict=True):
            assert float(row["mixture_entropy"]) == metrics["mixture_entropy"]
            assert int(row["cumulative_coverage"]) == metrics["cumulative_coverage"]
    random = [row for row in rows if row["method"] == values.RANDOM]
    assert {row["gradient_steps"] for row in random} == {"0"}


def test_the_summary_is_of_the_last_iteration(finished):
    out, _ = finished
    summary = json.loads((out / "fig4" / "summary.json").read_text())
    assert summary["compared_with"] == "V"
    assert summary["versions"] == [files.stack()] and summary["all_environments"] == {}
    for method in ("H", "LA", "V"):
        last = [
            files.read_metrics(out / "fig4" / cell.name)[-1]["cumulative_coverage"]
            for cell in protocol.make("fig4", "toy", 1)
            if cell.method == method
        ]
        found = summary["last_iteration"]["pendulum"]["cumulative_coverage"][method]
        assert found["values"] == last
        assert found["interquartile_mean"] == last[0]
        assert ("probability_of_improvement" in found) == (method != "V")
    assert (out / "fig4" / "fig4.png").stat().st_size > 10_000
    assert (out / "fig5" / "fig5_pendulum.png").stat().st_size > 10_000


def test_cumulative_coverage_never_falls_in_any_run(finished):
    out, _ = finished
    for cell in protocol.make("fig4", "toy", 1):
        rows = files.read_metrics(out / "fig4" / cell.name)
        coverage = [row["cumulative_coverage"] for row in rows]
        assert coverage == sorted(coverage) and coverage[0] > 0


def test_seeds_side_by_side_are_told_apart(tmp_path):
    cell = Cell("V", preset("smoke", env="pendulum", seed=3, num_seeds=2))
    row = {name: [1.0, 2.0] for name in values.COLUMNS[3:]} | {"env_steps": 7}
    row |= {f"random_{name}": [5, 6] for name in values.MEASURED}
    (tmp_path / cell.name).mkdir()
    files.append_metrics(tmp_path / cell.name, row)
    found = values.read(tmp_path, [cell])
    assert [(r["seed"], r["method"], r["cumulative_coverage"]) for r in found] == [
        (3, "V", 1.0),
        (4, "V", 2.0),
        (3, values.RANDOM, 5),
        (4, values.RANDOM, 6),
    ]


def test_an_entropy_that_json_cannot_hold_is_the_lowest_of_all(tmp_path):
    cell = Cell("V", preset("smoke", env="pendulum"))
    row = dict.fromkeys(values.COLUMNS[3:], 1.0) | {"mixture_knn_entropy": -np.inf}
    (tmp_path / cell.name).mkdir()
    files.append_metrics(tmp_path / cell.name, row)
    (found,) = values.read(tmp_path, [cell])
    assert found["mixture_knn_entropy"] == -np.inf and found["mixture_entropy"] == 1
    atomic.write_csv(tmp_path / "raw.csv", values.COLUMNS, [found])
    assert "-inf" in (tmp_path / "raw.csv").read_text()


def test_fig2_is_what_a_solver_of_quadratic_programs_finds(tmp_path):
    from scipy import optimize

    reproduce.main(["fig2", "--scale", "toy", "--out", str(tmp_path)])
    weights = json.loads((tmp_path / "fig2" / "weights.json").read_text())
    assert set(weights) == {"t = 5", "t = 10", "t = 20"}
    for title, by_name in weights.items():
        n = int(title.split()[-1])
        np.testing.assert_allclose(by_name["uniform"], 1 / n)
        for eta in protocol.ETAS:
            target = (1 - eta) ** (n - np.arange(n))
            solved = optimize.minimize(
                lambda x, target=target: ((x - target) ** 2).sum(),
                np.full(n, 1 / n),
                jac=lambda x, target=target: 2 * (x - target),
                bounds=[(0, None)] * n,
                constraints={"type": "eq", "fun": lambda x: x.sum() - 1},
                method="SLSQP",
                options={"ftol": 1e-15, "maxiter": 500},
            )
            np.testing.assert_allclose(by_name[f"η = {eta}"], solved.x, atol=1e-6)
    assert (tmp_path / "fig2" / "fig2.png").exists()


@pytest.mark.slow
def test_mepol_has_the_env_steps_of_the_study_and_is_computed_once(tmp_path, monkeypatch):
    from maxent_jax.studies import mepol_values

    config = preset("smoke", env="pendulum", num_seeds=2)
    found = mepol_values.rows(tmp_path, config, 2)
    assert [(row["seed"], row["iteration"], row["env_steps"]) for row in found] == [
        (seed, i, i * config.budget.steps_per_iteration) for i in (1, 2) for seed in (0, 1)
    ]
    assert {row["method"] for row in found} == {mepol_values.METHOD}
    monkeypatch.setattr(mepol_values, "_train", None)  # a second time would fail
    assert mepol_values.rows(tmp_path, config, 2) == found
    with pytest.raises(TypeError):
        mepol_values.rows(tmp_path, config, 1)


@pytest.mark.slow
def test_the_weights_of_the_classic_environments_are_computed_once(tmp_path, monkeypatch):
    from maxent_jax.studies import hazan_weights

    found = hazan_weights.results(tmp_path, "toy", 1)
    assert set(found) == {"pendulum", "mountain_car"}
    for of_env in found.values():
        assert list(of_env["weightings"]) == ["uniform", "η = 0.1", "η = 0.01", "η = 0.001"]
        runs_of = [np.array(values["fresh_entropy"]) for values in of_env["weightings"].values()]
        assert all(values.shape == (1, 3) and np.isfinite(values).all() for values in runs_of)
        np.testing.assert_array_equal(runs_of[0][:, 0], runs_of[1][:, 0])  # one policy, one weight
    curves = hazan_weights.curves(found)["pendulum"]
    beside = found["pendulum"]["weightings"]["η = 0.1"]["random_fresh_entropy"]
    # The seeds once, not per weighting.
    assert curves["fresh_entropy"][values.RANDOM].shape == (1, 3)
    np.testing.assert_allclose(curves["fresh_entropy"][values.RANDOM], beside, rtol=1e-6)
    table = hazan_weights.table(found)
    assert "probability_of_improvement" not in table["pendulum, fresh_entropy"]["uniform"]
    assert 0 <= table["pendulum, fresh_entropy"]["η = 0.1"]["probability_of_improvement"] <= 1
    monkeypatch.setattr(hazan_weights, "_run", None)
    assert hazan_weights.results(tmp_path, "toy", 1) == found
    for scale, seeds in (("cpu", 1), ("toy", 2)):  # what took minutes is not written over
        with pytest.raises(errors.UsageError, match="choose another --out"):
            hazan_weights.results(tmp_path, scale, seeds)
    (tmp_path / hazan_weights.RESULTS).write_text("{")
    with pytest.raises(errors.UsageError, match="cannot be read"):
        hazan_weights.results(tmp_path, "toy", 1)
