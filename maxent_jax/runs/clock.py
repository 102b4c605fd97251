"""Measures the seconds spent on a run, across interruptions."""

import time
from typing import Any

import jax


class Clock:
    """Times the portions of an iteration; continues from the run's last checkpoint."""

    def __init__(self, process_started: float, seconds: dict[str, Any]):
        """Takes the time.perf_counter() at which the process began, and the saved `seconds`."""
        self._process_started = process_started
        self._origin = process_started - seconds.get("wall_seconds", 0.0)
        self._first_step: float | None = seconds.get("wall_first_step")
        self._compile = seconds.get("wall_compile", 0.0)
        self._train_total = seconds.get("wall_train_total", 0.0)
        self._parts: dict[str, float] = dict(seconds.get("parts", {}))

    def time(self, part: str, function, *arguments):
        """Calls and times a function; returns its state, and its metrics as numpy arrays."""
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
        """Counts the time since `started` as compilation."""
        self._compile += time.perf_counter() - started

    def saved(self, started: float) -> None:
        """Counts the time since `started` as saving a checkpoint."""
        seconds = time.perf_counter() - started
        self._parts["wall_save"] = self._parts.get("wall_save", 0.0) + seconds

    def end_iteration(self) -> dict[str, float | None]:
        """Returns the columns of the iteration just ended; the portions restart at 0."""
        parts, self._parts = self._parts, {}
        return self._totals() | {"wall_peak_bytes": _peak_bytes(), "wall_save": 0.0} | parts

    def seconds(self) -> dict[str, Any]:
        """Returns all that a later process needs to continue."""
        return self._totals() | {"parts": self._parts}

    def _totals(self) -> dict[str, float | None]:
        return {
            "wall_seconds": time.perf_counter() - self._origin,
            "wall_compile": self._compile,  # of all processes that trained the run
            "wall_first_step": self._first_step,  # to the end of the first segment
            "wall_train_total": self._train_total,
        }


def _peak_bytes() -> int | None:
    """Peak memory of the first device, if it counts it (a GPU or a TPU)."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    return statistics.get("peak_bytes_in_use")
