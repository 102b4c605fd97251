"""The figures of a run: curves, the log-occupancy map (Fig. 5), and the paths of each policy."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maxent_jax.analysis import Paths, Run
from maxent_jax.density import histogram
from maxent_jax.density.histogram import Grid
from maxent_jax.runs import FIGURES

COVERAGE_AXES = (
    ("iteration", "iteration"),
    ("env_steps", "thousand env steps"),
    ("wall_seconds", "wall-clock (s)"),
)
NAMES = ("curves", "occupancy", "fireworks")
AGENT, MIXTURE, RANDOM = "#1b6ca8", "#d1495b", "#7a7a7a"


def curves(run: Run) -> Figure:
    """Coverage and entropy against iterations, env steps and wall-clock."""
    figure = Figure(figsize=(11, 6.4), layout="constrained")
    axes = figure.subplots(2, 3, sharey="row")
    bins = run.parts.grid.bins
    rows = (
        ("coverage", f"visited cells of {bins[0] * bins[1]:,}"),
        ("entropy", "histogram entropy (nats)"),
    )
    lines = (
        ("cumulative", "training, all states so far", AGENT, "-o"),
        ("mixture", "rollouts of the mixture", MIXTURE, "-s"),
        ("random", "random policy, as many steps", RANDOM, "--"),
    )
    for row, (quantity, label) in enumerate(rows):
        for column, (axis, axis_label) in enumerate(COVERAGE_AXES):
            ax = axes[row, column]
            for prefix, name, color, style in lines:
                values = run.metrics.get(f"{prefix}_{quantity}")
                if values is not None:
                    x = run.metrics[axis] / (1000 if axis == "env_steps" else 1)
                    ax.plot(x, values, style, color=color, label=name, ms=4)
            ax.set_xlabel(axis_label)
            ax.grid(alpha=0.25)
        axes[row, 0].set_ylabel(label)
        axes[row, 0].set_ylim(bottom=0)
    axes[1, 0].legend(frameon=False, fontsize=9, loc="lower right")
    return _finish(figure, run)


def occupancy_map(run: Run, mixture_cells: np.ndarray) -> Figure:
    """log10 of the visits to each cell: in training, and by the mixture (after the paper's Fig. 5).

    Args:
      mixture_cells: [bins, bins] share of the mixture's occupancy.
    """
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    panels = (
        ("states met in training", run.histogram / max(run.histogram.sum(), 1)),
        ("rollouts of the mixture", mixture_cells),
    )
    shares = [np.log10(np.where(cells > 0, cells, np.nan)) for _, cells in panels]
    low, high = min(np.nanmin(s) for s in shares), max(np.nanmax(s) for s in shares)
    for ax, (title, _), share in zip(figure.subplots(1, 2), panels, shares, strict=True):
        image = ax.imshow(
            share.T, origin="lower", extent=_extent(run), aspect="auto", vmin=low, vmax=high
        )
        _name_axes(ax, run)
        ax.set_title(title)
    figure.colorbar(image, ax=figure.axes, label="log10 share of the states", shrink=0.85)
    return _finish(figure, run)


def fireworks(run: Run, paths: Paths) -> Figure:
    """Where the episodes of each policy go, one colour for each policy."""
    figure = Figure(figsize=(7.4, 6.6), layout="constrained")
    ax = figure.subplots()
    colors = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, max(run.num_policies - 1, 1)))
    for states, alive, policy in zip(*paths, strict=True):
        xy = np.asarray(histogram.locate(states[alive], run.parts.grid))
        color = "black" if policy == 0 else colors[policy - 1]
        ax.plot(*xy.T, color=color, lw=0.9, alpha=0.8)
        ax.plot(*xy[-1:].T, "o", color=color, ms=3)
    for policy in range(run.num_policies):
        color = "black" if policy == 0 else colors[policy - 1]
        ax.plot([], [], color=color, label=f"π{policy}" + (" (untrained)" if policy == 0 else ""))
    _name_axes(ax, run)
    ax.set_title("paths of the archived policies; dots where they end")
    low_x, high_x, low_y, high_y = _extent(run)
    ax.plot(
        [low_x, high_x, high_x, low_x, low_x],
        [low_y, low_y, high_y, high_y, low_y],
        ":",
        color=RANDOM,
        lw=0.8,
    )
    if run.parts.torso is not None:  # a map, seen from above
        ax.set_aspect("equal")
    ax.grid(alpha=0.25)
    ax.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    return _finish(figure, run)


def save_all(run: Run, mixture_cells: np.ndarray, paths: Paths) -> None:
    """The three figures, into the run's directory."""
    drawn = curves(run), occupancy_map(run, mixture_cells), fireworks(run, paths)
    for name, figure in zip(NAMES, drawn, strict=True):
        save(figure, run.path / FIGURES, name)


def all_saved(run_directory: Path) -> bool:
    """Whether the run's directory holds the three figures."""
    return all((run_directory / FIGURES / f"{name}.png").exists() for name in NAMES)


def save(figure: Figure, directory: Path, name: str) -> Path:
    """Writes a figure as PNG, whole or not at all."""
    directory.mkdir(parents=True, exist_ok=True)
    path, temporary = directory / f"{name}.png", directory / f"{name}.tmp.png"
    figure.savefig(temporary, dpi=110, bbox_inches="tight")
    return temporary.replace(path)


def _extent(run: Run) -> tuple[float, float, float, float]:
    grid: Grid = run.parts.grid
    return grid.low[0], grid.high[0], grid.low[1], grid.high[1]


def _name_axes(ax: Axes, run: Run) -> None:
    x_name, y_name = run.parts.grid.names
    ax.set(xlabel=x_name, ylabel=y_name)


def _finish(figure: Figure, run: Run) -> Figure:
    """Title and, below, every deviation from the paper by name."""
    config = run.config
    figure.suptitle(
        f"MaxEnt-{config.method.upper()}, {config.env}, preset {config.preset}, seed {run.seed}"
    )
    named = ", ".join(f"{name}={getattr(config, name)}" for name in config.deviations())
    figure.supxlabel(f"departs from the paper in: {named or 'nothing'}", fontsize=6, wrap=True)
    return figure
