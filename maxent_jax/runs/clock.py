"""Seconds spent on a run, through all interruptions."""

import time
from typing import Any

import jax


class Clock:
    """Times the parts of an iteration; begins where the run's last checkpoint left it."""

    def __init__(self, process_started: float, seconds: dict[str, Any]):
        """Of a process that began at that time.perf_counter(); `seconds` as it was saved."""
        self._process_started = process_started
        self._origin = process_started - seconds.get("wall_seconds", 0.0)
        self._first_step: float | None = seconds.get("wall_first_step")
        self._compile = seconds.get("wall_compile", 0.0)
        self._train_total = seconds.get("wall_train_total", 0.0)
        self._parts: dict[str, float] = dict(seconds.get("parts", {}))

    def time(self, part: str, function, *arguments):
        """What the function returns, with metrics as numpy arrays."""
        started = time.perf_counter()
        result = jax.block_until_ready(function(*arguments))
        seconds = time.perf_counter() - started
        self._parts[part] = self._parts.get(part, 0.0) + seconds
        if part == "wall_train":
            self._train_total += seconds
            if self._first_step is None:
                self._first_step = time.perf_counter() - self._process_started
        state, metrics = result
        return state, jax.device_get(metrics)

    def compiled(self, started: float) -> None:
        """Counts the time since then as spent on compilation."""
        self._compile += time.perf_counter() - started

    def saved(self, started: float) -> None:
        """Counts the time since then as spent on a checkpoint."""
        seconds = time.perf_counter() - started
        self._parts["wall_save"] = self._parts.get("wall_save", 0.0) + seconds

    def end_iteration(self) -> dict[str, float | None]:
        """The columns of the iteration just ended; the parts start again at 0."""
        parts, self._parts = self._parts, {}
        return self._totals() | {"wall_peak_bytes": _peak_bytes(), "wall_save": 0.0} | parts

    def seconds(self) -> dict[str, Any]:
        """All that a later process needs to go on."""
        return self._totals() | {"parts": self._parts}

    def _totals(self) -> dict[str, float | None]:
        return {
            "wall_seconds": time.perf_counter() - self._origin,
            "wall_compile": self._compile,  # of all processes that carried the run
            "wall_first_step": self._first_step,  # to the end of the first segment
            "wall_train_total": self._train_total,
        }


def _peak_bytes() -> int | None:
    """Of the first device's memory, where it keeps count: a GPU or a TPU."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    return statistics.get("peak_bytes_in_use")
