"""Runs the three programs of an iteration, and logs, saves and draws in between."""

import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from experiments import hosts
from experiments.cli import UsageError
from maxent_jax import algorithm, checkpoint, devices, methods, parts, plotting, runs, runtime
from maxent_jax.algorithm import Programs, State
from maxent_jax.analysis import load_run, paths
from maxent_jax.config import Config
from maxent_jax.convergence import has_plateaued
from maxent_jax.density import histogram


def train(config: Config, directory: Path, process_started: float, num_devices: int = 1) -> None:
    """Trains to the end, from the last complete checkpoint if there is one.

    Args:
      directory: exists; empty, or with this very run in it.
      process_started: time.perf_counter() when the program began, for the time to the first step.
      num_devices: that share the run; 0: all.
    Raises:
      UsageError, ConfigError: no such share.
    """
    runtime.prepare(config.simulates_in_jax)
    placed = _placement(config, num_devices)
    completed = checkpoint.latest_step(directory) or 0
    if completed == config.num_iterations:
        drawn = plotting.all_saved(directory)
        hosts.leave()
        if hosts.is_first():
            if not drawn:  # killed after its last checkpoint
                _draw(directory)
            print(f"{directory} is complete: nothing to train.")
        return
    if completed:
        state = checkpoint.restore(directory, config, placed)
    else:
        state = algorithm.start(config) if placed is None else devices.start(config, placed)
        hosts.first_alone(lambda: _write_config(config, directory), "config")
    rows = runs.read_metrics(directory)[:completed]
    hosts.first_alone(lambda: runs.truncate_metrics(directory, completed), "metrics")
    clock = _Clock(process_started, rows[-1] if rows else {})
    programs = algorithm.programs(config) if placed is None else devices.programs(config, placed)
    with _Bar(config, completed) as bar:
        for iteration in range(completed, config.num_iterations):
            state, row = _iterate(config, programs, state, clock, bar)
            if hosts.is_first():
                runs.append_metrics(directory, row)
            checkpoint.save(directory, state, iteration + 1)
    hosts.leave()
    if hosts.is_first():
        _draw(directory)
        _summarise(directory, rows=runs.read_metrics(directory))


def _placement(config: Config, num_devices: int) -> State | None:
    """Of the state on that many devices, 0 for all; None for one."""
    available = jax.devices()
    if num_devices > len(available):
        raise UsageError(f"devices is {num_devices}, but there are {len(available)}.")
    chosen = available[: num_devices or None]
    if len(chosen) == 1:
        return None
    return devices.placement(config, devices.make_mesh(config, chosen))


def _write_config(config: Config, directory: Path) -> None:
    machine = {
        "backend": parts.make(config).env.backend,
        "device": jax.devices()[0].device_kind,
    }
    runs.write_config(directory, config, methods.row(config)._asdict(), machine)


def _iterate(
    config: Config, programs: Programs, state: State, clock: "_Clock", bar: "_Bar"
) -> tuple[State, dict[str, Any]]:
    """algorithm.iterate, with the clock read and the bar moved between its parts."""
    state, at_begin = clock.time("wall_begin", programs.begin, state)
    segments: list[dict[str, Any]] = []
    converged = False
    while len(segments) < config.num_segments and not converged:
        state, metrics = clock.time("wall_train", programs.train_segment, state)
        segments.append(metrics)
        clock.first_step_done()
        bar.advance(metrics)
        converged = _all_converged(config, segments)
    state, at_end = clock.time("wall_end", programs.end, state)
    stacked = jax.tree.map(lambda *x: np.stack(x), *segments)
    rewards = np.full((*stacked["step_reward"].shape[1:], config.num_segments), np.nan)
    rewards[..., : len(segments)] = np.moveaxis(stacked["step_reward"], 0, -1)
    row = {
        **at_end,
        **at_begin,
        **algorithm.reduce_metrics(stacked),
        "segments_trained": len(segments),
        "converged": converged,
        "segment_reward": rewards,
        **clock.row(),
    }
    bar.iteration_done(row)
    return state, row


def _all_converged(config: Config, segments: list[dict[str, Any]]) -> bool:
    """Of all seeds, which train in step."""
    rewards = np.stack([metrics["step_reward"] for metrics in segments], axis=-1)
    return all(
        has_plateaued(list(of_seed), config.plateau_segments, config.plateau_tolerance)
        for of_seed in np.atleast_2d(rewards)
    )


class _Clock:
    """Seconds spent, through interruptions: a resumed run goes on from its last row."""

    def __init__(self, process_started: float, last_row: dict[str, Any]):
        self._origin = process_started - last_row.get("wall_seconds", 0.0)
        self._process_started = process_started
        self._first_step: float | None = last_row.get("wall_first_step")
        self._train_total = last_row.get("wall_train_total", 0.0)
        self._parts: dict[str, float] = {}

    def time(self, part: str, program, state: State):
        started = time.perf_counter()
        state, metrics = jax.block_until_ready(program(state))
        seconds = time.perf_counter() - started
        self._parts[part] = self._parts.get(part, 0.0) + seconds
        return state, jax.tree.map(np.asarray, metrics)

    def first_step_done(self) -> None:
        if self._first_step is None:
            self._first_step = time.perf_counter() - self._process_started

    def row(self) -> dict[str, float | None]:
        """The columns of the iteration just ended; the parts start again at 0."""
        self._train_total += self._parts["wall_train"]
        parts, self._parts = self._parts, {}
        now = time.perf_counter()
        return {
            "wall_seconds": now - self._origin,
            "wall_first_step": self._first_step,  # to the end of the first segment
            "wall_train_total": self._train_total,
            "wall_peak_bytes": _peak_bytes(),
            **parts,
        }


def _peak_bytes() -> int | None:
    """Of the first device's memory, where it keeps count: a GPU or a TPU."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    return statistics.get("peak_bytes_in_use")


class _Bar:
    """A progress line on standard error; nothing where that is not a terminal."""

    def __init__(self, config: Config, completed: int):
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._iteration, self._coverage = completed, ""
        self._num_iterations, self._num_segments = config.num_iterations, config.num_segments
        self._task = self._progress.add_task(
            "",
            total=config.num_iterations * config.num_segments,
            completed=completed * config.num_segments,
            status="compiling",
        )

    def __enter__(self) -> "_Bar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def advance(self, metrics: dict[str, Any]) -> None:
        reward = float(np.mean(metrics["replay_reward"]))
        self._progress.update(
            self._task,
            advance=1,
            description=f"iteration {self._iteration + 1}/{self._num_iterations}",
            status=f"reward {reward:.3f}{self._coverage}",
        )

    def iteration_done(self, row: dict[str, Any]) -> None:
        self._iteration += 1
        done = self._iteration * self._num_segments  # also where the iteration ended early
        self._progress.update(self._task, completed=done)
        self._coverage = f" · {int(np.mean(row['cumulative_coverage'])):,} cells"


def _draw(directory: Path) -> None:
    """The figures. Beside other processes, whose devices are out of reach, in one of its own."""
    if jax.process_count() == 1:
        draw(directory)
        return
    alone = multiprocessing.get_context("spawn").Process(target=draw, args=(directory,))
    os.environ["JAX_PLATFORMS"] = "cpu"  # of the child: the accelerator's memory is taken
    alone.start()
    alone.join()
    if alone.exitcode != 0:
        raise RuntimeError(f"drawing the figures of {directory} failed; --resume tries again.")


def draw(directory: Path) -> None:
    """Rolls the archived policies out, and draws the figures of a run."""
    run = load_run(directory)
    visited = run.occupancy()
    cells = histogram.count(visited.states, run.parts.grid, visited.weight)
    plotting.save_all(run, np.asarray(cells), paths(visited))


def _summarise(directory: Path, rows: list[dict[str, Any]]) -> None:
    last = rows[-1]
    random = ""
    if "random_coverage" in last:
        random = f" ({np.mean(last['random_coverage']):,.0f} by a random policy)"
    print(
        f"{directory}: {np.mean(last['cumulative_coverage']):,.0f} cells visited in training"
        f"{random}, "
        f"{np.mean(last['mixture_coverage']):,.0f} by the mixture, "
        f"{last['wall_seconds']:,.0f} s; figures in {directory / runs.FIGURES}."
    )
