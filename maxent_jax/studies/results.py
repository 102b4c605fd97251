"""Makes figures, tables and summaries of finished studies."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from maxent_jax import mixture
from maxent_jax.algorithm import methods
from maxent_jax.config import Config
from maxent_jax.runs import atomic, files, locks
from maxent_jax.studies import (
    disk,
    downstream,
    hazan_weights,
    mepol_values,
    offline,
    paper_figures,
    protocol,
    statistics,
    values,
)
from maxent_jax.studies.protocol import Cell
from maxent_jax.visual import plotting

FIG2_TIMES = (5, 10, 20)
SUMMARISED = (
    *("cumulative_coverage", "cumulative_entropy"),
    *("mixture_coverage", "mixture_entropy", "mixture_knn_entropy"),
    *("cells_1m", "mixture_cells_1m"),
)

# Numbers in which a study's methods may differ: the name in the figure, and the value.
ALONG: dict[str, tuple[str, Callable[[Config], float]]] = {
    "refresh_period": (
        "env steps between refreshes",
        lambda config: (
            methods.row(config).refresh_period * config.budget.num_envs
            or config.budget.steps_per_iteration
        ),
    ),
    "episodic_weight": ("λ", lambda config: config.intrinsic.episodic_weight),
}


def draw(
    whats: Iterable[str],
    scale: str,
    num_seeds: int | None,
    out: Path,
    studies: Mapping[str, Sequence[Cell]],
) -> None:
    """Draws figures and studies by name, each in its own directory; prints files and tables."""
    for what in whats:
        with locks.holding(out / what):  # processes that share it take turns
            if what == "fig2":
                fig2(out / "fig2")
            elif what == "fig3":
                fig3(out / "fig3", scale, num_seeds)
            elif what == "fig5":
                fig5(out / "fig5", out / "fig4", studies["fig4"])
            elif protocol.STUDIES[what].scales[scale].then:
                on_tasks(out / what, what, studies[what])
            elif protocol.STUDIES[what].relabelled:
                from_data(out / what, what, scale, studies[what])
            else:
                study(out / what, what, studies[what])


def fig2(directory: Path) -> None:
    """Draws Fig. 2: the mixture's exact weights."""
    weights = {
        f"t = {time}": {"uniform": mixture.uniform_weights(time)}
        | {f"η = {eta}": mixture.geometric_weights(time, eta) for eta in protocol.ETAS}
        for time in FIG2_TIMES
    }
    atomic.write_json(directory / "weights.json", weights)
    _save(paper_figures.weights(weights), directory, "fig2")
    print(f"{directory / 'weights.json'}")


def fig3(directory: Path, scale: str, num_seeds: int | None) -> None:
    """Draws Fig. 3: weights in the classic environments with the official settings."""
    found = hazan_weights.results(directory, scale, num_seeds)
    table = hazan_weights.table(found)
    atomic.write_json(directory / "summary.json", dict(table))
    _save(paper_figures.classic_weights(hazan_weights.curves(found)), directory, "fig3")
    _print("uniform", table)
    print(f"{directory / hazan_weights.RESULTS}, {directory / 'summary.json'}")


def study(directory: Path, name: str, cells: Sequence[Cell]) -> None:
    """Writes a study's raw.csv, summary.json and curves, and prints its table."""
    rows = values.read(directory, cells)
    if protocol.STUDIES[name].mepol:
        ours = [cell for cell in cells if cell.method == cells[0].method]
        for config in (cell.config for cell in ours):
            rows += mepol_values.rows(directory / config.env, config, config.num_seeds)
    atomic.write_csv(directory / "raw.csv", values.COLUMNS, rows)
    groups = list(values.groups(rows))
    summary: dict[str, Any] = {
        "study": name,
        "what": _what(name),
        "versions": _versions(directory, cells),
        **summarise(groups),
    }
    atomic.write_json(directory / "summary.json", summary)
    rivals = cells[0].config.protocol == "metra"
    quantities = paper_figures.UNIT_CELLS if rivals else paper_figures.QUANTITIES
    _save(paper_figures.curves(groups, _what(name), quantities), directory, name)
    if field := protocol.STUDIES[name].along:
        label, value = ALONG[field]
        places = {(cell.config.env, cell.method): value(cell.config) for cell in cells}
        _save(paper_figures.along(groups, places, label, _what(name)), directory, f"{name}_along")
    for env, table in summary["last_iteration"].items():
        _print(summary["compared_with"], {f"{env}, {measure}": table[measure] for measure in table})
    if len(summary["versions"]) > 1:
        print(f"note: the runs used {len(summary['versions'])} different sets of versions.")
    print(f"{directory / 'raw.csv'}, {directory / 'summary.json'}")


def on_tasks(directory: Path, name: str, cells: Sequence[Cell]) -> None:
    """Writes raw.csv, summary.json and the figure of a study of tasks, and prints its table."""
    rows = downstream.read(directory, cells)
    atomic.write_csv(directory / "raw.csv", downstream.COLUMNS, rows)
    groups = list(downstream.summarise(rows))
    versions = _versions(directory, cells)
    summary = {"study": name, "what": _what(name), "versions": versions, "scores": groups}
    atomic.write_json(directory / "summary.json", summary)
    without = dict.fromkeys(f"{row['task']} ({row['env']})" for row in rows if "score" not in row)
    if without:
        print(f"note: without a score, as experts.json has no expert: {', '.join(without)}.")
    if not groups:
        print(f"{directory / 'raw.csv'}, {directory / 'summary.json'}")
        return
    _save(paper_figures.scores(groups, _what(name)), directory, name)
    print("score of all tasks: interquartile mean [95 %], optimality gap [95 %], P(V is better)")
    for row in groups:
        text = f"  {row['method']:8} {row['explored_steps']:>9,}"
        for value, ends in (
            (row["interquartile_mean"], row["interval"]),
            (row["optimality_gap"], row["gap_interval"]),
        ):
            text += f"  {value:5.2f} [{ends[0]:.2f}, {ends[1]:.2f}]"
        if "probability_of_improvement" in row:
            low, high = row["probability_interval"]
            text += f"  {row['probability_of_improvement']:.2f} [{low:.2f}, {high:.2f}]"
        print(text)
    print(f"{directory / 'raw.csv'}, {directory / 'summary.json'}")


def from_data(directory: Path, name: str, scale: str, cells: Sequence[Cell]) -> None:
    """Learns from the data of each cell; writes raw.csv, summary.json and the figure."""
    rows = offline.rows(directory, scale, cells, protocol.STUDIES[name].relabelled)
    atomic.write_csv(directory / "raw.csv", offline.COLUMNS, rows)
    tables = offline.summarise(rows)
    versions = _versions(directory, cells)
    summary = {"study": name, "what": _what(name), "versions": versions, "returns": tables}
    atomic.write_json(directory / "summary.json", summary)
    _save(paper_figures.returns(tables, _what(name)), directory, name)
    _print("V", tables)
    print(f"{directory / 'raw.csv'}, {directory / 'summary.json'}")


def fig5(directory: Path, trained: Path, cells: Sequence[Cell]) -> None:
    """Draws Fig. 5: the occupancy of each method's first seed, in training and of the mixture."""
    for env in dict.fromkeys(cell.config.env for cell in cells):
        chosen = [c for c in cells if c.config.env == env and c.config.seed == 0]
        figure = paper_figures.occupancies({c.method: disk.home(trained, c) for c in chosen})
        _save(figure, directory, f"fig5_{env}")


def summarise(groups: Sequence[tuple[str, str, dict[str, np.ndarray]]]) -> dict[str, Any]:
    """Summarises the last iteration of each environment, and of all environments together.

    The summary has interquartile means, intervals, and the probability that V (or else the first
    method) is better than each other method.

    Args:
      groups: environment, method and columns [N, T], as from `values.groups`.
    """
    envs = sorted({env for env, _, _ in groups})
    names = list(dict.fromkeys(method for _, method, _ in groups))
    ours = "V" if "V" in names else names[0]
    of_ours = [columns for _, method, columns in groups if method == ours]
    measured = [name for name in SUMMARISED if all(name in columns for columns in of_ours)]
    last = {
        env: {
            name: {
                method: columns[name][:, -1]
                for at, method, columns in groups
                if at == env and name in columns
            }
            for name in measured
        }
        for env in envs
    }
    everywhere = {  # only if there are several environments
        name: statistics.improvements(
            {
                method: [last[env][name][method] for env in envs]
                for method in names
                if all(method in last[env][name] for env in envs)
            },
            ours,
        )
        for name in (measured if len(envs) > 1 else ())
    }
    return {
        "compared_with": ours,
        "seeds": {env: len(columns["env_steps"]) for env, _, columns in groups},
        "last_iteration": {
            env: {name: statistics.compare(by_method, ours) for name, by_method in of_env.items()}
            for env, of_env in last.items()
        },
        "all_environments": everywhere,
    }


def _versions(directory: Path, cells: Sequence[Cell]) -> list[dict[str, str]]:
    """The different sets of versions that made the runs."""
    of_cells = [files.read_versions(disk.home(directory, cell)) for cell in cells]
    return [v for i, v in enumerate(of_cells) if v not in of_cells[:i]]


def _what(name: str) -> str:
    return protocol.STUDIES[name].what


def _print(ours: str, table: Mapping[str, Mapping[str, Any]]) -> None:
    for name, by_method in table.items():
        print(f"{name}, interquartile mean [95 %], P({ours} is better)")
        for method, found in by_method.items():
            low, high = found["interval"]
            text = f"  {method:18} {found['interquartile_mean']:9.2f} [{low:.2f}, {high:.2f}]"
            if "probability_of_improvement" in found:
                low, high = found["probability_interval"]
                text += f"  {found['probability_of_improvement']:.2f} [{low:.2f}, {high:.2f}]"
            print(text)


def _save(figure: Figure, directory: Path, name: str) -> None:
    print(plotting.save(figure, directory, name))
