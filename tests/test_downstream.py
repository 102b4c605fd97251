"""The study of tasks: cells that start from others, and the statistics of their scores."""

import csv
import json

import pytest

from maxent_jax import training
from maxent_jax.commands import reproduce
from maxent_jax.runs import files
from maxent_jax.studies import disk, downstream, paper_figures, protocol


def cells_of(scale, num_seeds=1):
    return protocol.make("downstream", scale, num_seeds)


@pytest.mark.parametrize("scale", protocol.SCALES)
def test_all_methods_have_the_same_tasks_and_scratch_no_fewer_env_steps(scale):
    every = cells_of(scale)
    explored = {cell.name for cell in every if cell.config.downstream.task == "none"}
    cells = [cell for cell in every if cell.config.downstream.task != "none"]
    groups: dict = {}
    for cell in cells:
        own = cell.config.downstream
        group = (cell.config.env, cell.method, own.source_iterations)
        groups.setdefault(group, []).append(own.task)
        scratch = cell.method == protocol.SCRATCH
        assert scratch == (cell.source is None) == (own.source == "") == (own.restart_share == 0)
        if cell.source:
            assert own.source == cell.source.name and own.source in explored
            assert cell.config.env == cell.source.config.env
    for env in {env for env, *_ in groups}:
        of_env = [tasks for (at, *_), tasks in groups.items() if at == env]
        assert all(tasks == of_env[0] for tasks in of_env)

    def steps(cell):
        budget = cell.config.budget
        return budget.num_iterations * budget.steps_per_iteration

    def task_of(cell):
        return cell.config.env, cell.config.downstream.task

    from_scratch = {task_of(c): steps(c) for c in cells if c.method == protocol.SCRATCH}
    for cell in cells:
        if cell.source:
            own = cell.config.downstream
            policies = 1 + own.source_iterations * cell.source.config.mixture.snapshots
            episodes = policies * own.first_episodes
            played = episodes * cell.config.environment.episode_length
            assert steps(cell) + played <= from_scratch[task_of(cell)]


def test_an_expert_is_better_than_an_untrained_policy():
    cells = [*cells_of("toy"), *cells_of("paper")]
    tasks = {(cell.config.env, cell.config.downstream.task) for cell in cells}
    for env, of_env in downstream.scales().items():
        for task, scale in of_env.items():
            assert (env, task) in tasks and scale.expert > scale.untrained


def test_a_share_holds_whatever_starts_from_its_cells():
    cells = cells_of("cpu", 2)
    shares = [protocol.share(cells, i, 3) for i in range(3)]
    assert sorted(c.name for share in shares for c in share) == sorted(c.name for c in cells)
    for share in shares:
        names = {cell.name for cell in share}
        assert all(cell.source is None or cell.source.name in names for cell in share)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The study at toy size with V alone, which was stopped when V had explored; and its cells."""
    out = tmp_path_factory.mktemp("studies")
    of_v = protocol.STUDIES["downstream"]._replace(methods={"V": {"method": "v"}})
    argv = ["downstream", "--scale", "toy", "--seeds", "1", "--out", str(out)]
    whole = training.run_to_end

    def only_v(config, directory, *rest):
        if config.downstream.source:
            raise KeyboardInterrupt
        whole(config, directory, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(protocol.STUDIES, "downstream", of_v)
        patch.setattr(training, "run_to_end", only_v)
        with pytest.raises(KeyboardInterrupt):
            reproduce.main(argv)
        patch.setattr(training, "run_to_end", whole)
        moved = out.parent / "moved"
        out.rename(moved)
        reproduce.main([*argv[:-1], str(moved)])
        return moved / "downstream", cells_of("toy")


def test_a_stopped_study_of_tasks_goes_on(finished):
    directory, cells = finished
    assert [cell.name for cell in cells] == [
        "pendulum-V-0",
        "pendulum-scratch-gymnasium-0",
        "pendulum-V-1-gymnasium-0",
        "pendulum-V-2-gymnasium-0",
    ]
    assert all(disk.finished(directory, cell) for cell in cells)
    played = [
        len(json.loads((directory / cell.name / files.FIRST).read_text())["task_return"])
        for cell in cells[2:]
    ]
    assert played == [2, 3]
    with open(directory / "raw.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(cell.config.budget.num_iterations for cell in cells[1:])
    last = files.read_metrics(directory / cells[3].name)[-1]
    assert float(rows[-1]["task_return"]) == last["task_return"]
    assert rows[-1]["explored_steps"] == "800"
    summary = json.loads((directory / "summary.json").read_text())
    assert [(row["method"], row["explored_steps"]) for row in summary["scores"]] == [
        ("scratch", 0),
        ("V", 400),
        ("V", 800),
    ]
    assert summary["scores"][2]["interquartile_mean"] == pytest.approx(float(rows[-1]["score"]))


def test_what_starts_from_a_failed_cell_is_left_out(finished, tmp_path, monkeypatch):
    from maxent_jax import errors

    begun = []

    def fail(config, directory, *_):
        begun.append(directory.name)
        raise errors.NonFiniteError("the loss is not finite.")

    _, cells = finished
    monkeypatch.setattr(training, "run_to_end", fail)
    assert reproduce._train(tmp_path / "downstream", cells) == 2
    assert begun == ["pendulum-V-0", "pendulum-scratch-gymnasium-0"]


def test_scores_are_summarised_by_method_and_exploration():
    def rows(method, explored, env, task, values):
        return [
            {"env": env, "task": task, "method": method, "explored_steps": explored, "seed": seed}
            | {"iteration": i, "score": value - 1 + i}
            for seed, value in enumerate(values)
            for i in (0, 1)
        ]

    found = rows("V", 10, "ant", "a", [0.5, 0.7]) + rows("V", 10, "ant", "b", [1.5, 0.1])
    found += rows("V", 5, "ant", "a", [0.2, 0.2]) + rows("V", 5, "ant", "b", [0.2, 0.2])
    found += rows("scratch", 0, "ant", "a", [0.6, 0.4]) + rows("scratch", 0, "ant", "b", [0, 0])
    found.append({**found[0], "task": "c"} | {"seed": 0})
    del found[-1]["score"]  # a task without an expert
    whole, half, scratch = downstream.summarise(found)
    assert whole["interquartile_mean"] == pytest.approx(0.6)  # of 0.1, 0.5, 0.7, 1.5
    assert whole["optimality_gap"] == pytest.approx((0.9 + 0.5 + 0.3 + 0) / 4)
    assert half["interquartile_mean"] == pytest.approx(0.2)
    assert half["probability_of_improvement"] == pytest.approx((1 + 0.5) / 2)
    assert scratch["probability_of_improvement"] == pytest.approx((0.75 + 1) / 2)
    assert set(whole["tasks"]) == {"ant a", "ant b"}
    figure = paper_figures.scores([whole, half, scratch], "title")
    assert [ax.get_title() for ax in figure.axes] == ["", "", "ant a", "ant b"]
    (line,) = [x for x in figure.axes[2].get_lines() if list(x.get_ydata()) == [0.5, 0.7]]
    assert len(set(line.get_xdata())) == 1


def test_data_of_each_method_is_learned_from_once(tmp_path, monkeypatch):
    from maxent_jax.studies import offline

    of_v = protocol.STUDIES["offline"]._replace(methods={"V": {"method": "v"}})
    monkeypatch.setitem(protocol.STUDIES, "offline", of_v)
    argv = ["offline", "--scale", "toy", "--seeds", "1", "--out", str(tmp_path)]
    reproduce.main(argv)
    directory = tmp_path / "offline"
    with open(directory / "raw.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row["data"] for row in rows] == [offline.UNTRAINED, "V"]
    assert all(row["transitions"] == "200" and float(row["task_return"]) < 0 for row in rows)
    assert rows[0]["data_reward"] != rows[1]["data_reward"]
    summary = json.loads((directory / "summary.json").read_text())
    assert summary["returns"]["pendulum gymnasium"]["V"]["values"] == [
        pytest.approx(float(rows[1]["task_return"]))
    ]
    assert (directory / "offline.png").stat().st_size > 5_000
    monkeypatch.setattr(offline.td3_bc, "train", None)  # a second time would fail
    reproduce.main(argv)
