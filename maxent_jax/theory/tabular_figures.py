"""Draws the figures of the command `theory` from its results alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from maxent_jax.visual import plotting

METHODS = {  # colour and line
    "V": ("#d1495b", "-"),
    "LA": ("#edae49", "-"),
    "H, η = 0.1": ("#1b6ca8", "-"),
    "H, η = 0.01": ("#5fa8d3", "-"),
    "official H, η = 0.1": ("#1b6ca8", ":"),
    "official H, η = 0.01": ("#5fa8d3", ":"),
    "linear weights": ("#9a7aa0", "-"),
    "line search": ("#4c956c", "--"),
    "fully corrective": ("#2f3e46", "--"),
}
SMALLEST = 1e-8  # nats, the accuracy of the optimum


def draw(results: Mapping[str, Any], directory: Path) -> list[Path]:
    """Saves all figures as PNG files, each completely or not at all; returns their paths."""
    figures = {
        "theory_gaps": gaps(results),
        "theory_refresh": refresh(results),
        "theory_cases": cases(results),
    }
    return [plotting.save(figure, directory, name) for name, figure in figures.items()]


def gaps(results: Mapping[str, Any]) -> Figure:
    """Draws the measured gaps of each method and the bounds, one panel per MDP."""
    rates, compared = results["rates"], results["methods"]
    figure, axes = _panels(len(rates), 4.6)
    for ax, (name, found) in zip(axes, rates.items(), strict=False):
        for method, (color, style) in METHODS.items():
            if method in compared[name]["methods"] and method != "V":
                curve = compared[name]["methods"][method]
                _line(ax, curve["times"], curve["gap"], method, color, style, lw=1.1)
        _line(ax, found["times"], found["gap"], "V", *METHODS["V"], lw=2)
        low, high = np.min(found["gap"], 0), np.max(found["gap"], 0)
        ax.fill_between(found["times"], low, high, color=METHODS["V"][0], alpha=0.2, lw=0)
        ax.plot(found["times"], found["tight"], "k-", lw=1.6, label="Theorem 1, tight")
        ax.plot(found["times"], found["printed"], "k:", lw=1.2, label="Theorem 1, printed")
        bound = compared[name]["methods"].get("H, η = 0.01", {})
        if "bound" in bound:
            ax.plot(bound["times"], bound["bound"], "k--", lw=1, label="bound of H, η = 0.01")
        half = 0.5 * np.log(found["states"])
        ax.axhline(half, color="#999999", lw=0.8, label="½ log |S|")
        ax.set_title(
            f"{name}, |S| = {found['states']}: slope of V {found['slope']:.2f}", fontsize=10
        )
        ax.set(xlabel="iterations", ylim=(SMALLEST, None))
    axes[0].set_ylabel("gap of the smoothed entropy (nats)")
    _legend(figure, axes)
    return figure


def refresh(results: Mapping[str, Any]) -> Figure:
    """Draws the gap over the planning steps between two refreshes, one panel per MDP."""
    figure, axes = _panels(len(results["refresh"]), 4)
    styles = {
        "V": ("#d1495b", "-o"),
        "V from last": ("#d1495b", ":o"),
        "LA": ("#edae49", "-s"),
        "LA, history": ("#4c956c", "-^"),
    }
    labels = {
        "V": "V: one period per iteration",
        "V from last": "V, started from its last values",
        "LA": "LA's archive",
        "LA, history": "LA's history",
    }
    for ax, (name, found) in zip(axes, results["refresh"].items(), strict=False):
        for series, (color, style) in styles.items():
            gap = np.array(found["gap"][series])  # [periods, N]
            middle = np.maximum(np.median(gap, 1), SMALLEST)
            ax.plot(found["periods"], middle, style, color=color, ms=4, label=labels[series])
            ax.fill_between(found["periods"], gap.min(1), gap.max(1), color=color, alpha=0.12, lw=0)
        ax.set_title(name, fontsize=10)
        ax.set(xlabel="planning steps between refreshes", yscale="log")
        ax.set_xscale("log", base=2)
        ax.grid(alpha=0.25)
    budget = next(iter(results["refresh"].values()))["budget"]
    axes[0].set_ylabel(f"gap after {budget:,} planning steps (nats)")
    _legend(figure, axes)
    return figure


def cases(results: Mapping[str, Any]) -> Figure:
    """Draws a case in which V loses, inexact oracles, and the entropy itself."""
    figure, axes = _panels(3, 4.2)
    ax, found = axes[0], results["lost"]
    for method in ("V", "H, η = 0.1", "official H, η = 0.1", "line search", "linear weights"):
        curve = found["methods"][method]
        _line(ax, curve["times"], curve["gap"], method, *METHODS[method], lw=1.4)
    times = np.array(found["methods"]["V"]["times"])
    cost = found["first_policy_costs"]
    ax.plot(times, cost / (times + 1), "k:", lw=1.2, label="cost of π₀ / (T + 1)")
    ax.set(title=f"river swim of {found['length']}, γ = 0.9: V loses", xlabel="iterations")
    ax.set_ylim(SMALLEST, None)
    ax.set_ylabel("gap of the smoothed entropy (nats)")
    ax.legend(frameon=False, fontsize=7.5)

    ax = axes[1]
    for planning, color in zip((0.0, 0.01, 0.1), ("#1b6ca8", "#edae49", "#d1495b"), strict=True):
        rows = [row for row in results["noise"]["rows"] if row["planning_noise"] == planning]
        density = np.array([max(row["density_noise"], 0.001) for row in rows])
        ax.plot(
            density, [r["gap"] for r in rows], "-o", color=color, ms=4, label=f"ε₁ = {planning:g}"
        )
        ax.plot(density, [r["bound"] for r in rows], "--", color=color, lw=1)
    ax.plot([], [], "k--", lw=1, label="Theorem 1")
    ax.set(xscale="log", yscale="log", xlabel="ε₀ of the density (leftmost: none)")
    ax.set_title(
        f"V on {results['noise']['on']}, inexact oracles, T = {results['settings']['iterations']}"
    )
    ax.legend(frameon=False, fontsize=7.5)

    ax = axes[2]
    found = results["game"]["gap"]
    colors = ("#d1495b", "#d1495b", "#2f3e46", "#8d99ae")
    names = [name for name in found if name != "times"]
    for name, color, style in zip(names, colors, ("-", ":", "-", "-"), strict=True):
        _line(ax, found["times"], found[name], name, color, style, lw=1.4)
    ax.set(title=f"{results['game']['on']}: the entropy itself", xlabel="iterations")
    ax.legend(frameon=False, fontsize=7.5)
    for ax in (axes[0], axes[2]):
        ax.set(xscale="log", yscale="log")
    for ax in axes:
        ax.grid(alpha=0.25)
        ax.title.set_fontsize(10)
    return figure


def _panels(number: int, height: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(3.6 * max(number, 2), height), layout="constrained")
    return figure, list(np.atleast_1d(figure.subplots(1, number)))


def _line(ax: Axes, times, gap, label: str, color: str, style: str, lw: float) -> None:
    """The median over seeds; values below the optimum's accuracy are left out."""
    middle = np.median(np.array(gap, dtype=float), axis=0)
    ax.plot(
        times, np.where(middle > SMALLEST, middle, np.nan), style, color=color, label=label, lw=lw
    )
    ax.set(xscale="log", yscale="log")
    ax.grid(alpha=0.25)


def _legend(figure: Figure, axes: list[Axes]) -> None:
    handles: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(),
        handles.keys(),
        frameon=False,
        fontsize=9,
        loc="outside lower center",
        ncols=min(len(handles), 7),
    )
