"""Progress on standard error: a bar in a terminal, otherwise one line per iteration."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich import progress
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from maxent_jax.config import Config

Item = TypeVar("Item")
# Time to the end of the first segment, by whether jax also simulates. Measured on two cores, from
# a processor with AVX-512 to a slow one with AVX2.
COMPILING = {False: "15 to 50 s", True: "1 to 3 min"}


def say(sentence: str) -> None:
    """Prints one line on standard error."""
    print(sentence, file=sys.stderr, flush=True)


def announce(config: Config, directory: Path, iterations_done: int) -> None:
    """Says what will be trained, and how long it takes until progress is shown."""
    c = config
    last = c.seed + c.num_seeds - 1
    seeds = f"seed {c.seed}" if c.num_seeds == 1 else f"seeds {c.seed} to {last}"
    env_steps = c.num_seeds * c.budget.num_iterations * c.budget.steps_per_iteration
    iterations = (
        "1 iteration" if c.budget.num_iterations == 1 else f"{c.budget.num_iterations} iterations"
    )
    done = f", {iterations_done} of them done" if iterations_done else ""
    say(
        f"{c.method}{c.own_bonus} on {c.env}, preset {c.preset}, {seeds}: "
        f"{iterations}{done}, {env_steps:,} env steps, into {directory}\n"
        f"compiling, about {COMPILING[c.simulates_in_jax]}, less if programs are cached; "
        f"Ctrl-C saves the run"
    )


def duration(seconds: float) -> str:
    """Formats seconds for people: 45 s, 6 min 42 s, 3 h 20 min."""
    minutes, left = divmod(round(seconds), 60)
    if minutes == 0:
        return f"{left} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {left:02d} s"


def track(items: Sequence[Item], what: str) -> Iterable[Item]:
    """Returns the items, with a progress line on standard error if that is a terminal."""
    console = Console(stderr=True)
    return progress.track(items, what, console=console, disable=not console.is_terminal)


@contextlib.contextmanager
def counting(total: int, what: str) -> Iterator[Callable[[int], None]]:
    """Context manager: gives a function that shows how many of the total are done.

    It draws a bar in a terminal, otherwise it prints a line at each tenth of the total.
    """
    console, tenths = Console(stderr=True), 0
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)

        def report(done: int) -> None:
            nonlocal tenths
            bar.update(task, completed=done)
            if not console.is_terminal and 10 * done // total > tenths:
                tenths = 10 * done // total
                say(f"{done:,} of {total:,} {what}")

        yield report


class Bar:
    """Shows a run's progress: a bar in a terminal, otherwise a line after each iteration."""

    def __init__(self, config: Config, iteration: int, segments: int, last_row: dict[str, Any]):
        """Starts after so many iterations and segments of the next; takes the last row, if any."""
        console = Console(stderr=True)
        self._in_terminal = console.is_terminal
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=16, table_column=Column(no_wrap=True)),
            TimeElapsedColumn(table_column=Column(no_wrap=True)),
            TextColumn("left"),
            TimeRemainingColumn(table_column=Column(no_wrap=True)),
            _Status("{task.fields[status]}", table_column=Column()),
            console=console,
            disable=not self._in_terminal,
        )
        self._config, self._iteration, self._segments = config, iteration, segments
        self._reached = _reached(last_row)
        self._rate: list[str] = []
        self._trained_here = 0  # segments, by this process
        self._task = self._progress.add_task(
            self._description(),
            total=config.budget.num_iterations * config.budget.num_segments,
            completed=iteration * config.budget.num_segments + segments,
            status=_together("compiling", *self._reached),
        )

    def __enter__(self) -> "Bar":
        self._progress.start()
        self._compiled = self._last = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def segment_done(self) -> None:
        """Updates the bar after a segment."""
        c, now = self._config, time.perf_counter()
        steps = c.num_seeds * c.vector_steps * c.budget.num_envs
        self._rate = [f"{steps / (now - self._last):,.0f} steps/s"]
        self._segments, self._trained_here = self._segments + 1, self._trained_here + 1
        self._last = now
        if self._trained_here == 1:
            self._compiled = now
        if self._trained_here == 2:
            self._line(f"compiled{self._left()}")
        self._show()

    def iteration_done(self, row: dict[str, Any]) -> None:
        """Updates the bar after an iteration, which can end before its last segment."""
        self._iteration, self._segments = self._iteration + 1, 0
        self._reached, self._last = _reached(row), time.perf_counter()
        self._show()
        name = f"iteration {self._iteration}/{self._config.budget.num_iterations}"
        spent = f"{duration(row['wall_seconds'])}{self._left()}"
        self._line(_together(name, *self._spent(), *self._reached, spent))

    def _left(self) -> str:
        """Estimates the time left from this process's segments except the first, which compiles."""
        left = (
            self._config.budget.num_iterations * self._config.budget.num_segments
            - self._done_segments()
        )
        if left == 0 or self._trained_here < 2:
            return ""
        rate = (self._last - self._compiled) / (self._trained_here - 1)
        return f", about {duration(left * rate)} left"

    def _line(self, sentence: str) -> None:
        """Prints a line where there is no bar."""
        if not self._in_terminal:
            say(sentence)

    def _description(self) -> str:
        now = min(self._iteration + 1, self._config.budget.num_iterations)
        return f"iteration {now}/{self._config.budget.num_iterations}"

    def _done_segments(self) -> int:
        return self._iteration * self._config.budget.num_segments + self._segments

    def _spent(self) -> list[str]:
        c, vector_steps = self._config, self._done_segments() * self._config.vector_steps
        learned = max(vector_steps - c.learner.policy_lag, 0)
        return [
            f"{vector_steps * c.budget.num_envs:,} env steps",
            f"{learned * c.updates_per_vector_step:,} updates",
        ]

    def _show(self) -> None:
        self._progress.update(
            self._task,
            completed=self._done_segments(),
            description=self._description(),
            status=_together(*self._reached, *self._spent(), *self._rate),
        )


class _Status(TextColumn):
    """The only column that a narrow terminal cuts."""

    def render(self, task: Task) -> Text:
        text = super().render(task)
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


def _together(*parts: str) -> str:
    return " · ".join(parts)


def _reached(row: dict[str, Any]) -> list[str]:
    """Coverage and entropy, or the task's return and successes, averaged over seeds."""
    if not row:
        return []
    if "task_return" in row:
        reached = [f"return {_mean(row['task_return']):,.1f}"]
        if "task_success" in row:
            reached.append(f"{_mean(row['task_success']):.0%} successes")
        return reached
    coverage, entropy = _mean(row["cumulative_coverage"]), _mean(row["cumulative_entropy"])
    return [f"{coverage:,.0f} cells", f"{entropy:.2f} nats"]


def _mean(of_seeds: Any) -> float:
    """NaN if a number was not finite: a user's task may reward a state with NaN."""
    return float(np.mean(np.array(of_seeds, float)))
