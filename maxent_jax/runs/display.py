"""Progress on standard error, for terminals alone."""

import time
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from rich import progress
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from maxent_jax.config import Config

Item = TypeVar("Item")


def track(items: Sequence[Item], what: str) -> Iterable[Item]:
    """The items, with a progress line on standard error where that is a terminal."""
    console = Console(stderr=True)
    return progress.track(items, what, console=console, disable=not console.is_terminal)


class Bar:
    """A progress line on standard error; nothing where that is not a terminal."""

    def __init__(self, config: Config, iteration: int, segments: int, last_row: dict[str, Any]):
        """At that many complete iterations and segments of the next; the last row, if any."""
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            TextColumn("{task.fields[status]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._config, self._iteration, self._segments = config, iteration, segments
        self._reached, self._rate = _reached(last_row), ""
        self._task = self._progress.add_task(
            self._description(),
            total=config.num_iterations * config.num_segments,
            completed=iteration * config.num_segments + segments,
            status=f"compiling{self._reached}",
        )

    def __enter__(self) -> "Bar":
        self._progress.start()
        self._last = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def segment_done(self) -> None:
        """After a segment."""
        c, now = self._config, time.perf_counter()
        steps = c.num_seeds * c.vector_steps * c.num_envs
        self._rate = f" · {steps / (now - self._last):,.0f} steps/s"
        self._segments, self._last = self._segments + 1, now
        self._show()

    def iteration_done(self, row: dict[str, Any]) -> None:
        """After the end of an iteration, which may have come before its last segment."""
        self._iteration, self._segments = self._iteration + 1, 0
        self._reached = _reached(row)
        self._show()
        self._last = time.perf_counter()

    def _description(self) -> str:
        now = min(self._iteration + 1, self._config.num_iterations)
        return f"iteration {now}/{self._config.num_iterations}"

    def _show(self) -> None:
        c = self._config
        segments = self._iteration * c.num_segments + self._segments
        vector_steps = segments * c.vector_steps
        self._progress.update(
            self._task,
            completed=segments,
            description=self._description(),
            status=(
                f"{vector_steps * c.num_envs:,} env steps · "
                f"{vector_steps * c.updates_per_vector_step:,} updates{self._rate}{self._reached}"
            ),
        )


def _reached(row: dict[str, Any]) -> str:
    """Coverage and entropy, of all seeds on average."""
    if not row:
        return ""
    coverage = np.mean(row["cumulative_coverage"])
    return f" · {coverage:,.0f} cells · {np.mean(row['cumulative_entropy']):.2f} nats"
