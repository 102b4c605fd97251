"""The raw values of a study's runs: a row for each seed and iteration, and their CSV files."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from maxent_jax.runs import files
from maxent_jax.studies import disk
from maxent_jax.studies.protocol import Cell

MEASURED = ("coverage", "entropy", "off_grid_share")
COLUMNS = (
    *("env", "method", "seed", "iteration", "env_steps", "gradient_steps", "wall_seconds"),
    *(f"cumulative_{name}" for name in MEASURED),
    *(f"mixture_{name}" for name in (*MEASURED, "knn_entropy")),
    *("effective_policies", "evaluation_episode_length", "num_rollout_steps"),
    *("cells_1m", "mixture_cells_1m"),
)
RANDOM = "random policy"

Row = dict[str, Any]


def read(directory: Path, cells: Sequence[Cell]) -> list[Row]:
    """Reads the rows of all cells, and of the random baseline in the first method's runs."""
    found = []
    first = cells[0].method
    for cell in cells:
        for row in files.read_metrics(disk.home(directory, cell)):
            for index in range(cell.config.num_seeds):
                seed = cell.config.seed + index
                head: Row = {"env": cell.config.env, "method": cell.method, "seed": seed}
                own = files.of_seed(row, index)
                found.append(head | known(own))
                if cell.method == first and "random_coverage" in own:
                    found.append(head | _of_random(own))
    return sorted(found, key=lambda row: (row["env"], row["method"] == RANDOM))


def known(row: Row) -> Row:
    """Picks the columns from a row that was stored as JSON.

    JSON has no infinity and stores null. The only measure that can be infinite is the entropy in
    feature space, which is -inf if states coincide.
    """
    own = {name: row[name] for name in COLUMNS if name in row}
    return {name: -math.inf if value is None else value for name, value in own.items()}


def groups(rows: Sequence[Row]) -> Iterator[tuple[str, str, dict[str, np.ndarray]]]:
    """Yields environment, method, and the columns that all their rows have [seeds, iterations]."""
    names = dict.fromkeys((row["env"], row["method"]) for row in rows)
    for env, method in names:
        own = [row for row in rows if (row["env"], row["method"]) == (env, method)]
        seeds = sorted({row["seed"] for row in own})
        ordered = [[row for row in own if row["seed"] == seed] for seed in seeds]
        columns = [name for name in COLUMNS[3:] if all(name in row for row in own)]
        yield (
            env,
            method,
            {c: np.array([[row[c] for row in of_seed] for of_seed in ordered]) for c in columns},
        )


def _of_random(row: Row) -> Row:
    """The coverage and entropy of a run's random baseline."""
    kept = {name: row[name] for name in ("iteration", "env_steps", "wall_seconds")}
    reached = {f"cumulative_{name}": row[f"random_{name}"] for name in MEASURED}
    return {"method": RANDOM, "gradient_steps": 0} | kept | reached
