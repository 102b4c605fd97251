"""Draws the figures of a reproduction, from values and runs alone."""

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from maxent_jax.analysis import load_run, paths
from maxent_jax.studies.statistics import interquartile_mean, interval_of_curves
from maxent_jax.studies.values import RANDOM
from maxent_jax.visual import plotting

Axis = tuple[str, str, float]  # a column, its label, and its factor
Band = tuple[np.ndarray, ...]  # middle, low, high; [iterations] each
ENV_STEPS: Axis = ("env_steps", "thousand env steps", 1e-3)
AXES: tuple[Axis, ...] = (
    ("iteration", "iteration", 1),
    ENV_STEPS,
    ("gradient_steps", "thousand gradient steps", 1e-3),
    ("wall_seconds", "wall-clock (minutes)", 1 / 60),
)
QUANTITIES = (
    ("cumulative_coverage", "cells, training so far"),
    ("cumulative_entropy", "entropy, training so far (nats)"),
    ("mixture_coverage", "cells, mixture"),
    ("mixture_entropy", "entropy, mixture (nats)"),
)
UNIT_CELLS = (
    ("cells_1m", "unit cells, training so far"),
    ("mixture_cells_1m", "unit cells, 48 episodes"),
)
# Training on Ant for 12 hours on a GPU, read off the figure of TLDR (Bae et al. 2024, arXiv
# 2407.08464).
PUBLISHED = {"TLDR": 24_000, "METRA": 19_500, "PEG": 2_300}
COLORS = {"V": "#d1495b", "LA": "#edae49", "H": "#1b6ca8", RANDOM: "#7a7a7a"}
OTHERS = ("#4c956c", "#9a7aa0", "#2f3e46", "#5fa8d3", "#b5651d", "#e07a9f", "#8a9a5b", "#003049")

Columns = Mapping[str, np.ndarray]  # [seeds, iterations] each


def weights(by_time: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Draws Fig. 2: a bar for each policy's weight [n], oldest first; a panel for each time."""
    figure = Figure(figsize=(4 * len(by_time), 3.2), layout="constrained")
    for ax, (title, by_name) in zip(figure.subplots(1, len(by_time)), by_time.items(), strict=True):
        width = 0.8 / len(by_name)
        for i, (name, values) in enumerate(by_name.items()):
            ax.bar(np.arange(len(values)) + (i - 1.5) * width, values, width, label=name)
        ax.set(title=title, xlabel="policy, oldest first", ylabel="weight")
    ax.legend(frameon=False, fontsize=8)
    return figure


def classic_weights(found: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]]) -> Figure:
    """Draws Fig. 3 from `hazan_weights.curves` [seeds, rounds], with three panels per environment.

    The first is what the official code plots. The second compares its runs with the random policy
    from the same starts, and the third compares fresh runs from rest.
    """
    titles = {
        "running_entropy": "as published: running mean",
        "density_entropy": "runs of the mixture, one start",
        "fresh_entropy": "fresh runs of the mixture, from rest",
    }
    colors = ("#d1495b", "#1b6ca8", "#5fa8d3", "#9a7aa0", COLORS[RANDOM])
    figure = Figure(figsize=(13, 3.4 * len(found)), layout="constrained")
    axes = figure.subplots(len(found), len(titles), squeeze=False, sharey="row")
    for row, (env, measures) in zip(axes, found.items(), strict=True):
        for ax, (name, title) in zip(row, titles.items(), strict=True):
            for color, (who, values) in zip(colors, measures[name].items(), strict=True):
                _band(ax, values, who, color)
            ax.set(xlabel="round", title=f"{env}: {title}")
            ax.grid(alpha=0.25)
        row[0].set_ylabel("entropy (nats)")
    axes[0, 0].legend(frameon=False, fontsize=8)
    seeds = len(next(iter(next(iter(found.values()))["running_entropy"].values())))
    figure.suptitle(f"MaxEnt-H as published: interquartile mean of {seeds} seeds, 95 % interval")
    return figure


def curves(
    groups: Sequence[tuple[str, str, Columns]],
    title: str,
    quantities: Sequence[tuple[str, str]] = QUANTITIES,
) -> Figure:
    """Draws Fig. 4: interquartile means with their intervals.

    One environment has a row for each quantity and a column for each axis. Several environments are
    drawn as in the paper: a row for each, and a column for each quantity over env steps.
    """
    envs = list(dict.fromkeys(env for env, _, _ in groups))
    several = len(envs) > 1
    if several:
        panels = [[(env, *quantity, ENV_STEPS) for quantity in quantities] for env in envs]
    else:
        panels = [[(envs[0], *quantity, axis) for axis in AXES] for quantity in quantities]
    figure = Figure(figsize=(13, 2.7 * len(panels)), layout="constrained")
    share: Literal["none", "row"] = "none" if several else "row"
    axes = figure.subplots(len(panels), len(panels[0]), sharey=share, squeeze=False)
    styles = _styles([method for _, method, _ in groups])
    opacity = 0.2 if len(styles) <= len(OTHERS) else 0.06
    bands = {
        (env, method, name): interval_of_curves(columns[name])
        for env, method, columns in groups
        for name, _ in quantities
        if name in columns
    }
    for ax, (env, name, _, axis) in zip(axes.flat, chain(*panels), strict=True):
        for at, method, columns in groups:
            if at == env and name in columns:
                band = bands[env, method, name]
                _draw(ax, columns, band, axis, opacity, label=method, **styles[method])
        if (env, name) == ("ant", "cells_1m"):
            _draw_published(ax)
        else:
            ax.set_ylim(bottom=0)
    for ax, (_, _, _, axis) in zip(axes[-1], panels[-1], strict=True):
        ax.set_xlabel(axis[1])
    for ax, ((env, _, label, _), *_) in zip(axes[:, 0], panels, strict=True):
        ax.set_ylabel(env if several else label)
    if several:
        for ax, (_, _, label, _) in zip(axes[0], panels[0], strict=True):
            ax.set_title(label)
    else:
        for ax in axes[:, 0]:  # over iterations
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, ncols=6, loc="outside lower center")
    figure.suptitle(f"{title}: interquartile mean, 95 % bootstrap interval; {_seeds(groups)}")
    return figure


def along(
    groups: Sequence[tuple[str, str, Columns]],
    places: Mapping[tuple[str, str], float],
    label: str,
    title: str,
) -> Figure:
    """Draws the last iteration over the number in which the methods differ; a row for each env.

    It shows interquartile means with their intervals, and every seed's value.

    Args:
      places: the number, by env and method; a method without one, as the random policy, is a line.
    """
    envs = list(dict.fromkeys(env for env, _, _ in groups))
    figure = Figure(figsize=(13, 3.4 * len(envs)), layout="constrained")
    axes = figure.subplots(len(envs), len(QUANTITIES), squeeze=False)
    for env, row in zip(envs, axes, strict=True):
        own = [(method, columns) for at, method, columns in groups if at == env]
        placed = [(places[env, m], c) for m, c in own if (env, m) in places]
        placed.sort(key=lambda pair: pair[0])
        for ax, (name, quantity) in zip(row, QUANTITIES, strict=True):
            x = [place for place, _ in placed]
            last = np.stack([columns[name][:, -1] for _, columns in placed], axis=1)
            _band(ax, last, "", COLORS["V"], x)
            ax.plot(x, last.T, ".", ms=4, color=COLORS["V"], alpha=0.5)
            for method, columns in own:
                if (env, method) not in places and name in columns:
                    middle = float(interquartile_mean([columns[name][:, -1]]))
                    ax.axhline(middle, ls=":", color=COLORS[RANDOM], label=method)
                    ax.legend(frameon=False, fontsize=8)
            smallest = min(place for place in x if place > 0)
            ax.set_xscale("symlog", linthresh=smallest, linscale=0.4)
            ax.set_xlim(x[0] - 0.2 * smallest, 1.3 * x[-1])
            ax.set(title=quantity, xlabel=label)
            ax.grid(alpha=0.25)
    figure.suptitle(f"{title}: interquartile mean, 95 % bootstrap interval; {_seeds(groups)}")
    return figure


def scores(groups: Sequence[Mapping[str, Any]], title: str) -> Figure:
    """Draws the scores of tasks: of all together over the env steps explored, and of each task.

    The first two panels show interquartile means and optimality gaps with their intervals, the
    others the score of every seed with the most exploration, and their interquartile mean.

    Args:
      groups: as from `downstream.summarise`.
    """
    tasks = list(dict.fromkeys(task for group in groups for task in group["tasks"]))
    most: dict[str, Mapping[str, Any]] = {}
    for group in sorted(groups, key=lambda group: group["explored_steps"]):
        most[group["method"]] = group
    styles, columns = _styles(list(most)), 4
    rows = 1 + -(-len(tasks) // columns)
    figure = Figure(figsize=(13, 2.9 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, columns)
    whole = [figure.add_subplot(grid[0, :2]), figure.add_subplot(grid[0, 2:])]
    for ax, value, interval, label in (
        (whole[0], "interquartile_mean", "interval", "score, interquartile mean"),
        (whole[1], "optimality_gap", "gap_interval", "optimality gap"),
    ):
        for method, style in styles.items():
            own = [group for group in groups if group["method"] == method]
            own.sort(key=lambda group: group["explored_steps"])
            middle = np.array([group[value] for group in own])
            low, high = np.array([group[interval] for group in own]).T
            if [group["explored_steps"] for group in own] == [0]:
                ax.axhline(middle[0], label=method, **style)
                ax.axhspan(low[0], high[0], color=style["color"], alpha=0.12, lw=0)
                continue
            x = [group["explored_steps"] / 1e3 for group in own]
            ax.errorbar(x, middle, (middle - low, high - middle), capsize=3, label=method, **style)
        ax.set(xlabel="thousand env steps of exploration", ylabel=label)
        ax.grid(alpha=0.25)
    for i, task in enumerate(tasks):
        ax = figure.add_subplot(grid[1 + i // columns, i % columns])
        for place, (method, group) in enumerate(most.items()):
            of_task, color = group["tasks"].get(task), styles[method]["color"]
            if of_task is None:
                continue
            ax.plot([place] * len(of_task), of_task, "o", ms=4, color=color, alpha=0.6)
            level = float(interquartile_mean([np.asarray(of_task)]))
            ax.plot([place - 0.3, place + 0.3], [level, level], color=color)
        ax.set_xticks(range(len(most)), list(most), fontsize=8)
        ax.set_title(task, fontsize=9)
        ax.grid(alpha=0.25, axis="y")
    handles, labels = whole[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, ncols=8, loc="outside lower center")
    figure.suptitle(f"{title}: score 0 is the untrained policy's, 1 an expert's")
    return figure


def returns(tables: Mapping[str, Mapping[str, Mapping[str, Any]]], title: str) -> Figure:
    """Draws each seed's return, its interquartile mean and interval; a panel for each task.

    Args:
      tables: by environment and task, as from `statistics.compare`.
    """
    figure = Figure(figsize=(4 * len(tables) + 1, 3.6), layout="constrained")
    panels = zip(figure.subplots(1, len(tables), squeeze=False)[0], tables.items(), strict=True)
    styles = _styles(list(next(iter(tables.values()))))
    for ax, (task, by_data) in panels:
        for place, (name, found) in enumerate(by_data.items()):
            color, middle = styles[name]["color"], found["interquartile_mean"]
            low, high = found["interval"]
            ax.plot([place] * len(found["values"]), found["values"], "o", ms=4, color=color)
            ax.bar(place, middle, width=0.6, color=color, alpha=0.4)
            ax.vlines(place, low, high, color=color)
        ax.set_xticks(range(len(by_data)), [name.replace(" ", "\n") for name in by_data])
        ax.set(title=task, ylabel="return of an episode")
        ax.grid(alpha=0.25, axis="y")
    figure.suptitle(f"{title}: every seed, interquartile mean, 95 % interval")
    return figure


def occupancies(directories: Mapping[str, Path]) -> Figure:
    """Draws Fig. 5, a row per method: log-occupancy in training and of the mixture, and paths."""
    figure = Figure(figsize=(13, 4 * len(directories)), layout="constrained")
    axes = figure.subplots(len(directories), 3, squeeze=False)
    for row, (method, directory) in zip(axes, directories.items(), strict=True):
        run = load_run(directory)
        visited, by_policy = run.occupancies()
        plotting.draw_occupancy(row[0], run, run.histogram / max(run.histogram.sum(), 1))
        plotting.draw_occupancy(row[1], run, run.mixture_cells(visited))
        plotting.draw_paths(row[2], run, paths(by_policy))
        for ax, what in zip(row, ("training", "mixture", "one colour per policy"), strict=True):
            ax.set_title(f"{method}: {what}")
    return figure


def _seeds(groups: Sequence[tuple[str, str, Columns]]) -> str:
    numbers = {env: len(columns["env_steps"]) for env, _, columns in groups}
    if len(set(numbers.values())) == 1:
        return f"{min(numbers.values())} seeds"
    return "seeds: " + ", ".join(f"{env} {number}" for env, number in numbers.items())


def _draw(ax: Axes, columns: Columns, band: Band, axis: Axis, opacity: float, **style: Any) -> None:
    quantity, _, factor = axis
    middle, low, high = band
    ax.grid(alpha=0.25)
    if style["label"] == RANDOM and quantity == "gradient_steps":
        ax.axhline(middle[-1], linestyle=":", lw=1, color=style["color"])
        return
    x = columns[quantity].mean(0) * factor
    ax.plot(x, middle, marker="o", ms=3, **style)
    ax.fill_between(x, low, high, color=style["color"], alpha=opacity, lw=0)


def _draw_published(ax: Axes) -> None:
    """What others reach in 12 hours on a GPU, on a logarithmic scale."""
    for name, cells in PUBLISHED.items():
        ax.axhline(cells, ls=":", lw=1, color=COLORS[RANDOM])
        ax.annotate(f"{name}, 12 h", (0.02, cells), xycoords=ax.get_yaxis_transform(), fontsize=7)
    ax.set_yscale("log")


def _band(
    ax: Axes, values: np.ndarray, label: str, color: str, x: Sequence[float] | None = None
) -> None:
    middle, low, high = interval_of_curves(values)
    x = range(1, len(middle) + 1) if x is None else x
    ax.plot(x, middle, color=color, label=label)
    ax.fill_between(x, low, high, color=color, alpha=0.2, lw=0)


def _styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """By method: fixed colours for those of the paper; the other colours repeat, dashed."""
    others = iter([(color, line) for line in ("-", "--") for color in OTHERS])
    chosen = {m: (COLORS[m], "-") if m in COLORS else next(others) for m in dict.fromkeys(methods)}
    return {m: {"color": color, "linestyle": line} for m, (color, line) in chosen.items()}
