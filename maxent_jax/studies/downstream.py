"""Scores of the tasks that follow exploration: their raw values, statistics and figure.

A score is the return of a task after training, where 0 is that of the untrained policy and 1 that
of an expert. Several tasks are summarised by the interquartile mean over all their runs, and by the
optimality gap, the mean of what scores lack to 1. Source: Agarwal et al. 2021, arXiv 2108.13264;
URLB, Laskin et al. 2021, arXiv 2110.15191, compares pretraining in the same way.
"""

import json
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from maxent_jax.runs import files
from maxent_jax.studies import disk, statistics
from maxent_jax.studies.protocol import SCRATCH, Cell
from maxent_jax.studies.statistics import Scores

COLUMNS = (
    *("env", "task", "method", "explored_steps", "seed", "iteration", "env_steps"),
    *("wall_seconds", "task_return", "task_success", "score"),
)

Row = dict[str, Any]


class Scale(NamedTuple):
    """The returns between which a task's scores lie."""

    untrained: float  # score 0
    expert: float  # score 1


def scales() -> dict[str, dict[str, Scale]]:
    """Returns the scales by environment and task; experts.json says how they were made."""
    text = resources.files(__package__).joinpath("experts.json").read_text(encoding="utf-8")
    return {
        env: {task: Scale(of["untrained"], of["expert"]) for task, of in of_env.items()}
        for env, of_env in json.loads(text)["returns"].items()
    }


def read(directory: Path, cells: Sequence[Cell]) -> list[Row]:
    """Returns a row for each iteration of each cell on a task."""
    known, found = scales(), []
    for cell in cells:
        task, env = cell.config.downstream.task, cell.config.env
        if cell.source is None and cell.method != SCRATCH:
            continue
        scale = known.get(env, {}).get(task)
        head: Row = {"env": env, "task": task, "method": cell.method, "seed": cell.config.seed}
        head["explored_steps"] = _explored_steps(cell)
        for row in files.read_metrics(disk.home(directory, cell)):
            own = head | {name: row[name] for name in COLUMNS if name in row}
            if scale:
                own["score"] = (row["task_return"] - scale.untrained) / (
                    scale.expert - scale.untrained
                )
            found.append(own)
    return found


def _explored_steps(cell: Cell) -> int:
    """Env steps of exploration that the cell's run makes use of."""
    if cell.source is None:
        return 0
    per_iteration = cell.source.config.budget.steps_per_iteration
    return cell.config.downstream.source_iterations * per_iteration


def _last_scores(rows: Sequence[Row]) -> dict[tuple[str, int], dict[tuple[str, str], np.ndarray]]:
    """Returns the scores [N] after the last iteration, by method and env steps explored, and task.

    Tasks without an expert are left out.
    """
    last: dict[tuple[str, int], dict[tuple[str, str], dict[int, Row]]] = {}
    for row in rows:
        if "score" in row:
            of_tasks = last.setdefault((row["method"], row["explored_steps"]), {})
            of_tasks.setdefault((row["env"], row["task"]), {})[row["seed"]] = row
    return {
        group: {
            task: np.array([of_seed[seed]["score"] for seed in sorted(of_seed)])
            for task, of_seed in of_tasks.items()
        }
        for group, of_tasks in last.items()
    }


def optimality_gap(scores: Scores) -> np.ndarray:
    """Returns the mean of what the scores of all runs lack to 1, over the last axis."""
    return np.mean(np.maximum(0.0, 1.0 - np.concatenate(scores, axis=-1)), axis=-1)


def summarise(rows: Sequence[Row]) -> Iterator[Row]:
    """Yields, for each method and number of env steps explored, the statistics of all tasks."""
    found = _last_scores(rows)
    ours = max((group for group in found if group[0] == "V"), default=None)
    for group, by_task in found.items():
        scores = list(by_task.values())
        row: Row = {
            "method": group[0],
            "explored_steps": group[1],
            "interquartile_mean": float(statistics.interquartile_mean(scores)),
            "interval": statistics.interval(statistics.interquartile_mean, scores),
            "optimality_gap": float(optimality_gap(scores)),
            "gap_interval": statistics.interval(optimality_gap, scores),
            "tasks": {f"{env} {task}": of_task for (env, task), of_task in by_task.items()},
        }
        if ours and group != ours and found[ours].keys() == by_task.keys():
            theirs = [by_task[task] for task in found[ours]]
            both = {"V": list(found[ours].values()), "other": theirs}
            row |= statistics.improvements(both, "V")["other"]
        yield row
