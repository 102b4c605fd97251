"""Makes the tables of a report: numbers of runs as text."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from maxent_jax.analysis import Run
from maxent_jax.config import Config
from maxent_jax.mixture.occupancy import Occupancy
from maxent_jax.visual import plotting

MISSING = "–"
METRICS = (  # name, head, format
    ("env_steps", "env steps", ",.0f"),
    ("gradient_steps", "gradient steps", ",.0f"),
    ("wall_seconds", "seconds", ",.0f"),
    ("cumulative_coverage", "cells, training", ",.0f"),
    ("random_coverage", "cells, random", ",.0f"),
    ("mixture_coverage", "cells, mixture", ",.0f"),
    ("cumulative_entropy", "entropy, training", ".2f"),
    ("random_entropy", "entropy, random", ".2f"),
    ("mixture_entropy", "entropy, mixture", ".2f"),
    ("task_return", "return of the task", ",.2f"),
    ("task_success", "successes", ".0%"),
)
SECONDS = (
    ("wall_begin", "of rollouts for the reward", np.sum),
    ("wall_train", "of training", np.sum),
    ("wall_end", "of evaluation", np.sum),
    ("wall_first_step", "to the end of the first segment", np.max),
    ("wall_seconds", "in total", np.max),
)


class Table(NamedTuple):
    """A table of text. If there are colours, each row is marked with one."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    colors: Sequence[str] = ()


def number(value: Any, how: str) -> str:
    """Formats a number; returns MISSING if it is not finite, or not a number."""
    try:
        value = float(value)
    except (TypeError, ValueError):
        return MISSING
    return format(value, how) if math.isfinite(value) else MISSING


def last(run: Run, name: str) -> Any:
    """Returns a metric after the last complete iteration; None if there is none."""
    column = run.metrics.get(name)
    return None if column is None or not len(column) else column[-1]


def headline(seeds: Sequence[Run]) -> dict[str, Any]:
    """Returns a sentence about a run, and its main numbers, as means over the seeds."""
    first = seeds[0]
    cells = f"of {first.components.grid.num_cells:,}"
    trained = f"{first.num_policies - 1} of {first.config.archive_size - 1} policies trained"
    kind = "1 seed" if len(seeds) == 1 else f"means over {len(seeds)} seeds"
    tiles = (
        ("cells, training", "cumulative_coverage", ",.0f", cells),
        ("cells, random", "random_coverage", ",.0f", cells),
        ("cells, mixture", "mixture_coverage", ",.0f", cells),
        ("entropy, training", "cumulative_entropy", ".2f", "nats"),
        ("entropy, mixture", "mixture_entropy", ".2f", "nats"),
        ("return of the task", "task_return", ",.1f", "per episode"),
        ("env steps", "env_steps", ",.0f", "per seed" if len(seeds) > 1 else "of training"),
        ("wall-clock time", "wall_seconds", ",.0f", "seconds"),
    )
    return {
        "sentence": f"{trained} · {kind}",
        "tiles": [
            {"what": what, "value": number(_mean_last(seeds, name), how), "beside": beside}
            for what, name, how, beside in tiles
            if not name.startswith("task_") or name in first.metrics
        ],
    }


def _mean_last(seeds: Sequence[Run], name: str) -> float | None:
    values = [last(run, name) for run in seeds]
    return None if None in values else float(np.mean(values))


def results(seeds: Mapping[str, Sequence[Run]]) -> Table:
    """Makes one row for each run and seed, after its last complete iteration."""
    every = [run for of_run in seeds.values() for run in of_run]
    measured = [
        metric
        for metric in METRICS
        if not metric[0].startswith("task_") or any(metric[0] in run.metrics for run in every)
    ]
    rows = [
        [
            name,
            f"{run.config.title}, {run.config.env}, {run.config.preset}",
            str(run.seed),
            f"{len(run.metrics.get('iteration', ()))} of {run.config.budget.num_iterations}",
            *(number(last(run, metric), how) for metric, _, how in measured),
        ]
        for name, of_run in seeds.items()
        for run in of_run
    ]
    head = ["run", "method, environment, preset", "seed", "iterations"]
    return Table([*head, *(text for _, text, _ in measured)], rows)


def iterations(run: Run) -> Table:
    """Makes one row for each complete iteration."""
    measured = [metric for metric in METRICS if metric[0] in run.metrics]
    rows = [
        [str(i + 1), *(number(run.metrics[name][i], how) for name, _, how in measured)]
        for i in range(len(run.metrics.get("iteration", ())))
    ]
    return Table(["iteration", *(text for _, text, _ in measured)], rows)


def policies(run: Run, by_policy: Occupancy, seed: int) -> Table:
    """Makes one row for each policy: what it does in new episodes, which it plays alone."""
    where = ", ".join(run.components.grid.names)
    rows = [
        [
            f"π{summary.policy}" + (" (untrained)" if summary.policy == 0 else ""),
            number(summary.weight, ".3f"),
            number(summary.episode_return, ",.1f"),
            number(summary.step_reward, ".3f"),
            number(summary.episode_length, ",.0f"),
            ", ".join(number(end, ".1f") for end in summary.mean_end),
        ]
        for summary in run.summaries(by_policy, seed)
    ]
    head = ["policy", "weight", "return", "reward per step", "steps per episode"]
    colors = [
        f"rgb({r * 255:.0f} {g * 255:.0f} {b * 255:.0f})"
        for r, g, b, _ in plotting.policy_colors(run.num_policies)
    ]
    return Table([*head, f"mean end: {where}"], rows, colors)


def measures(measured: Mapping[str, float]) -> Table:
    """Makes one row for each measure of what the mixture covers in new episodes."""
    named = (
        ("mixture_coverage", "visited cells", ",.0f"),
        ("mixture_entropy", "entropy of the cells (nats)", ".2f"),
        ("mixture_knn_entropy", "entropy of the features (nats)", ".2f"),
        ("mixture_off_grid_share", "share of states off the grid", ".1%"),
        ("evaluation_episode_length", "steps per episode", ",.0f"),
        ("task_return", "return of the task per episode", ",.2f"),
        ("task_success", "episodes with a success", ".0%"),
    )
    rows = [
        [what, number(measured.get(name), how)]
        for name, what, how in named
        if not name.startswith("task_") or name in measured
    ]
    return Table([], rows)


def budget(run: Run, planned: Any) -> Table:
    """Makes rows of steps planned (in config.json) and done, and of the time spent."""
    planned = planned if isinstance(planned, dict) else {}
    rows = [
        [what, number(planned.get(name), ",.0f"), number(last(run, name), ",.0f")]
        for name, what in (("env_steps", "env steps"), ("gradient_steps", "gradient steps"))
    ]
    rows += [
        ["policies, with the untrained one", str(run.config.archive_size), str(run.num_policies)],
        ["env steps of the mixture's rollouts", "", _reduced(run, "num_rollout_steps", np.sum)],
        ["steps with a number that is not finite", "", _reduced(run, "num_invalid", np.sum)],
    ]
    rows += [[f"seconds {what}", "", _reduced(run, name, how)] for name, what, how in SECONDS]
    rows.append(["peak memory of the device, bytes", "", _reduced(run, "wall_peak_bytes", np.max)])
    return Table(["", "planned", "done"], rows)


def _reduced(run: Run, name: str, how: Callable[[np.ndarray], Any]) -> str:
    values = run.metrics.get(name, np.empty(0))
    return number(how(values), ",.0f") if len(values) else MISSING


def departures(config: Config) -> Table:
    """Makes one row for each departure from the paper: setting, value and meaning."""
    rows = [[name, str(config[name]), why] for name, why in config.deviations().items()]
    return Table(["setting", "value", "what it means"], rows)


def pairs(content: Any) -> Table:
    """Makes one row for each entry of a dictionary; no rows for anything else."""
    entries = content.items() if isinstance(content, dict) else ()
    return Table([], [[str(key), str(value)] for key, value in entries])
