"""Draws the figures of a run: curves, the log-occupancy map (Fig. 5), and policies' paths."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from maxent_jax import analysis
from maxent_jax.analysis import Paths, Run
from maxent_jax.config import tasks
from maxent_jax.density import histogram
from maxent_jax.density.histogram import Grid
from maxent_jax.mixture.occupancy import Occupancy
from maxent_jax.runs.atomic import whole_file, writing
from maxent_jax.runs.files import FIGURES

COVERAGE_AXES = (
    ("iteration", "iteration"),
    ("env_steps", "thousand env steps"),
    ("wall_seconds", "wall-clock time (s)"),
)
COMPARED = (
    ("cumulative", "training", "-"),
    ("mixture", "mixture", "--"),
    ("random", "random policy", ":"),
)
NAMES = ("curves", "occupancy", "fireworks")
AGENT, MIXTURE, RANDOM = "#1b6ca8", "#d1495b", "#7a7a7a"


def curves(run: Run) -> Figure:
    """Draws coverage, entropy and the task's return over iterations, env steps and time."""
    figure, axes = _axes_of_curves([run], f"visited cells, of {run.components.grid.num_cells:,}")
    _draw_task(axes, run, "-s", color=MIXTURE, ms=4)
    for prefix, name, color, style in (
        ("cumulative", "training, all states so far", AGENT, "-o"),
        ("mixture", "rollouts of the mixture", MIXTURE, "-s"),
        ("random", "random policy, same number of steps", RANDOM, "--"),
    ):
        _draw_curves(axes, run, prefix, style, color=color, label=name, ms=4)
    _start_at_zero(axes)
    axes[1, 0].legend(frameon=False, fontsize=9, loc="lower right")
    return _finish(figure, run)


def comparison(seeds: Mapping[str, Sequence[Run]]) -> Figure:
    """Draws the curves of several runs and all their seeds, one colour per run.

    Args:
      seeds: the seeds of each run, by the run's name in the legend.
    """
    every = list(itertools.chain(*seeds.values()))
    figure, axes = _axes_of_curves(every, "visited cells")
    styles = [Line2D([], [], color="black", ls=style, label=label) for _, label, style in COMPARED]
    colors = []
    for i, (name, runs) in enumerate(seeds.items()):
        color = f"C{i % 10}"
        for run, (prefix, _, style) in itertools.product(runs, COMPARED):
            _draw_curves(axes, run, prefix, color=color, ls=style, marker=".", lw=1.2, ms=4)
        for run in runs:
            _draw_task(axes, run, color=color, ls="--", marker=".", lw=1.2, ms=4)
        colors.append(Line2D([], [], color=color, lw=4, label=_as_it_is(name)))
    _start_at_zero(axes)
    axes[1, 0].legend(handles=styles, frameon=False, fontsize=9, loc="lower right")
    figure.legend(handles=colors, frameon=False, fontsize=9, loc="outside lower center")
    return figure


def _axes_of_curves(runs: Sequence[Run], coverage_label: str) -> tuple[Figure, np.ndarray]:
    """[2 or 3, 3]: coverage, entropy and the return of the runs' task, against each axis."""
    labels = [coverage_label, "histogram entropy (nats)"]
    named = {run.config.downstream.task for run in runs if "task_return" in run.metrics}
    if named:
        labels.append(f"return of {', '.join(sorted(named))}, per episode")
    figure = Figure(figsize=(11, 3.2 * len(labels) + 0.2), layout="constrained")
    axes = figure.subplots(len(labels), 3, sharey="row")
    for column, (_, label) in enumerate(COVERAGE_AXES):
        for ax in axes[:, column]:
            ax.set_xlabel(label)
            ax.grid(alpha=0.25)
    for ax, label in zip(axes[:, 0], labels, strict=True):
        ax.set_ylabel(_as_it_is(label))
    return figure, axes


def _start_at_zero(axes: np.ndarray) -> None:
    """Call when all is drawn: it ends the automatic choice of the upper limit."""
    for ax in axes[:2, 0]:
        ax.set_ylim(bottom=0)


def _draw_curves(axes: np.ndarray, run: Run, prefix: str, *style: str, **options: Any) -> None:
    """Draws one line in each of the axes, none for what the run did not measure."""
    for quantity, row in zip(("coverage", "entropy"), axes, strict=False):
        _draw_metric(row, run, f"{prefix}_{quantity}", *style, **options)


def _draw_task(axes: np.ndarray, run: Run, *style: str, **options: Any) -> None:
    if "task_return" in run.metrics:
        _draw_metric(axes[2], run, "task_return", *style, **options)


def _draw_metric(row: np.ndarray, run: Run, name: str, *style: str, **options: Any) -> None:
    """Draws a metric in each panel of a row, nothing if the run did not measure it."""
    values = run.metrics.get(name)
    if values is None:
        return
    for (axis, _), ax in zip(COVERAGE_AXES, row, strict=True):
        x = run.metrics[axis] / (1000 if axis == "env_steps" else 1)
        ax.plot(x, values, *style, **options)


def occupancy_map(run: Run, mixture_cells: np.ndarray) -> Figure:
    """Draws log10 of the visits to each cell, in training and by the mixture (as in Fig. 5).

    Args:
      mixture_cells: [bins, bins] share of the mixture's states in each cell.
    """
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    panels = (
        ("states visited in training", run.histogram / max(run.histogram.sum(), 1)),
        ("rollouts of the mixture", mixture_cells),
    )
    visited = np.concatenate([np.log10(cells[cells > 0]) for _, cells in panels])
    limits = (visited.min(), visited.max()) if visited.size else (None, None)
    for ax, (title, cells) in zip(figure.subplots(1, 2), panels, strict=True):
        image = draw_occupancy(ax, run, cells, limits)
        ax.set_title(title)
    figure.colorbar(image, ax=figure.axes, label="log10 share of the states", shrink=0.85)
    return _finish(figure, run)


def fireworks(run: Run, paths: Paths) -> Figure:
    """Draws the paths of each policy's episodes; with skills, those of the newest by its skills."""
    figure = Figure(figsize=(7.4, 6.6), layout="constrained")
    ax = figure.subplots()
    draw_paths(ax, run, paths)
    if run.config.environment.skill_size:
        whose = "newest policy by skill"
        named = [(f"skill at {a}°", _skill_color(np.radians(a))) for a in range(0, 360, 90)]
    else:
        whose = "archived policies"
        names = ["π0 (untrained)", *(f"π{i}" for i in range(1, run.num_policies))]
        named = list(zip(names, policy_colors(run.num_policies), strict=True))
    for name, color in named:
        ax.plot([], [], color=color, label=name)
    ax.set_title(f"paths of the {whose}; dots mark their ends")
    ax.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return _finish(figure, run)


def draw_occupancy(
    ax: Axes,
    run: Run,
    shares: np.ndarray,
    limits: tuple[float | None, float | None] = (None, None),
) -> AxesImage:
    """Draws log10 of the share of states in each cell, [bins, bins], within colour limits."""
    low, high = limits
    image = ax.imshow(
        np.log10(np.where(shares > 0, shares, np.nan)).T,
        origin="lower",
        extent=_extent(run),
        aspect="auto",
        vmin=low,
        vmax=high,
    )
    _name_axes(ax, run)
    return image


def draw_paths(ax: Axes, run: Run, paths: Paths) -> None:
    """Draws the paths of each policy's episodes, and the edge of the grid.

    With skills, only the newest policy's, each in the colour of its skill.
    """
    colors = policy_colors(run.num_policies)
    skills = run.config.environment.skill_size
    for states, alive, policy in zip(*paths, strict=True):
        color = colors[policy]
        if skills:
            if policy < run.num_policies - 1:
                continue
            color = _skill_color(np.arctan2(states[0, -1], states[0, -skills]))
        xy = np.asarray(histogram.locate(states[alive], run.components.grid))
        ax.plot(*xy.T, color=color, lw=0.9, alpha=0.8)
        ax.plot(*xy[-1:].T, "o", color=color, ms=3)
    _name_axes(ax, run)
    low_x, high_x, low_y, high_y = _extent(run)
    ax.plot(
        [low_x, high_x, high_x, low_x, low_x],
        [low_y, low_y, high_y, high_y, low_y],
        ":",
        color=RANDOM,
        lw=0.8,
    )
    if run.components.torso is not None:  # a map, seen from above
        ax.set_aspect("equal")
    ax.grid(alpha=0.25)


def policy_colors(num_policies: int) -> np.ndarray:
    """Returns [P, 4] RGBA in [0, 1]: black for the untrained policy, then from blue to red."""
    trained = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, max(num_policies - 1, 1)))
    return np.concatenate([[[0, 0, 0, 1]], trained])[:num_policies]


def _skill_color(angle: float) -> np.ndarray:
    """RGBA [4] of a skill by its direction, in radians, on a circle."""
    return np.array(matplotlib.colormaps["hsv"](angle / (2 * np.pi) % 1.0))


def save_all(run: Run, visited: Occupancy, by_policy: Occupancy) -> None:
    """Saves the three figures of a run; the occupancies are those of `Run.occupancies`."""
    drawn = (
        curves(run),
        occupancy_map(run, run.mixture_cells(visited)),
        fireworks(run, analysis.paths(by_policy)),
    )
    seed_index = run.seed - run.config.seed
    for name, figure in zip(NAMES, drawn, strict=True):
        save(figure, folder(run.path, seed_index), name)


def folder(run_directory: Path, seed_index: int = 0) -> Path:
    """Returns the folder of a seed's figures; the first seed's lie beside the others' folders."""
    figures = run_directory / FIGURES
    return figures / f"seed_{seed_index}" if seed_index else figures


def all_saved(run_directory: Path) -> bool:
    """Whether the run's directory holds the three figures of its first seed."""
    return all(path.exists() for path in _saved(run_directory))


def remove_saved(run_directory: Path) -> None:
    """Removes the three figures of the run's first seed.

    Raises:
      SaveError: a figure cannot be removed.
    """
    for path in _saved(run_directory):
        with writing(path):
            path.unlink(missing_ok=True)


def _saved(run_directory: Path) -> list[Path]:
    return [folder(run_directory) / f"{name}.png" for name in NAMES]


def save(figure: Figure, directory: Path, name: str) -> Path:
    """Writes a figure as PNG, atomically; returns its path."""
    path = directory / f"{name}.png"
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight")
    return path


def _extent(run: Run) -> tuple[float, float, float, float]:
    grid: Grid = run.components.grid
    return grid.low[0], grid.high[0], grid.low[1], grid.high[1]


def _name_axes(ax: Axes, run: Run) -> None:
    x_name, y_name = run.components.grid.names
    ax.set(xlabel=x_name, ylabel=y_name)


def _as_it_is(text: str) -> str:
    """The text for Matplotlib, which takes $ for the beginning of a formula; a name may have it."""
    return text.replace("$", r"\$")


def _finish(figure: Figure, run: Run) -> Figure:
    """Adds a title and, below, every departure from the paper by name."""
    config = run.config
    task = config.downstream.task
    where = config.env if task == tasks.NONE else f"{config.env}, task {task}"
    title = f"{config.title}, {where}, preset {config.preset}, seed {run.seed}"
    figure.suptitle(_as_it_is(title))
    named = ", ".join(f"{name}={config[name]}" for name in config.deviations())
    departures = f"departs from the paper in: {named or 'nothing'}"
    figure.supxlabel(_as_it_is(departures), fontsize=6, wrap=True)
    return figure
