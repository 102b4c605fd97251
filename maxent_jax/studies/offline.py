"""Does data that covers teach? TD3+BC on what each method's mixture visited, for several tasks.

Each dataset has equally many transitions, from fresh episodes of a finished run's mixture, rewarded
by the task afterwards. The untrained policy of the first method's runs makes one more.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import components
from maxent_jax.analysis import dataset, load_run
from maxent_jax.baselines import td3_bc
from maxent_jax.baselines.td3_bc import Settings
from maxent_jax.runs import files, progress
from maxent_jax.studies import disk, kept, statistics
from maxent_jax.studies.protocol import Cell

UNTRAINED = "untrained policy"
FOLDER = "offline"  # within the study's directory, a file for each dataset and task
SIZES = {"toy": (200, 2), "cpu": (100_000, 20), "paper": (1_000_000, 20)}  # transitions, episodes
UPDATES = {"toy": 20, "cpu": 50_000, "paper": 1_000_000}
COLUMNS = ("env", "task", "data", "seed", "transitions", "data_reward", "task_return")

Row = dict[str, Any]


def rows(
    directory: Path, scale: str, cells: Sequence[Cell], tasks: Mapping[str, Sequence[str]]
) -> list[Row]:
    """Returns a row for each dataset and task: computes those that the study's directory lacks.

    Args:
      directory: the study's.
      scale: one of protocol.SCALES.
      cells: finished.
      tasks: names of tasks, by environment.
    """
    wanted = [
        (cell, data, task)
        for cell in cells
        for data in ([UNTRAINED] if cell.method == cells[0].method else []) + [cell.method]
        for task in tasks[cell.config.env]
    ]
    return [
        _row(directory, scale, cell, data, task)
        for cell, data, task in progress.track(wanted, "offline")
    ]


def _row(directory: Path, scale: str, cell: Cell, data: str, task: str) -> Row:
    num, num_episodes = SIZES[scale]
    settings = Settings(num_updates=UPDATES[scale])
    row: Row = {"env": cell.config.env, "task": task, "data": data, "seed": cell.config.seed}
    row["transitions"] = num
    at = disk.home(directory, cell)
    asked = row | {"settings": dataclasses.asdict(settings), "run": files.read_id(at)}
    name = "-".join([cell.name, *(["untrained"] if data == UNTRAINED else []), task])
    path = directory / FOLDER / f"{files.as_name(name)}.json"

    def learn() -> Row:
        run = load_run(at)
        p = components.with_task(run.components, task)
        weights = jnp.asarray(run.weights)
        if data == UNTRAINED:
            weights = jnp.zeros_like(weights).at[0].set(1.0)
        key_data, key_train, key_play = jax.random.split(jax.random.key(cell.config.seed), 3)
        collected = dataset.collect(p, run.mixture, weights, num, key_data)
        policy = td3_bc.train(p, settings, collected, key_train)
        returns = td3_bc.evaluate(p, settings, policy, num_episodes, key_play)
        return {"data_reward": np.mean(collected["rewards"]), "task_return": np.mean(returns)}

    found = kept.once(path, asked, learn)
    return row | {name: found[name] for name in ("data_reward", "task_return")}


def summarise(found: Sequence[Row]) -> dict[str, dict[str, dict[str, Any]]]:
    """Compares the returns by environment and task, and by what made the data."""
    places = dict.fromkeys((row["env"], row["task"]) for row in found)
    return {
        f"{env} {task}": statistics.compare(
            {
                data: np.array(
                    [
                        row["task_return"]
                        for row in found
                        if (row["env"], row["task"], row["data"]) == (env, task, data)
                    ]
                )
                for data in dict.fromkeys(row["data"] for row in found)
            },
            "V",
        )
        for env, task in places
    }
