"""What the sections of a part share: the clock, the compilers and the runs in other processes."""

import contextlib
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax

Row = dict[str, Any]
# A section, when called, begins to compile its programs; it returns the function that measures.
Measure = Callable[[], Iterator[Row]]


class Session(NamedTuple):
    """The resources that the sections of a part share."""

    toy: bool
    deadline: float  # time.monotonic()
    work: Path
    compilers: ThreadPoolExecutor
    running: list[subprocess.Popen]  # training runs in other processes

    def compile(self, name: str, function: Callable, *args: Any) -> "Future[Compiled]":
        """Starts to compile at once, in parallel with all others."""
        return self.compilers.submit(_compile, name, function, *args)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Pauses the training runs, which also compile, while something is timed."""
        alive = [run for run in self.running if run.poll() is None]
        for run in alive:
            run.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            for run in alive:
                run.send_signal(signal.SIGCONT)


class Compiled(NamedTuple):
    """A program, and a row with its compile times."""

    call: Callable
    row: Row


def _compile(name: str, function: Callable, *args: Any) -> Compiled:
    started = time.perf_counter()
    lowered = jax.jit(function).lower(*args)
    traced = time.perf_counter()
    program = lowered.compile()
    row = {
        "section": "compiled",
        "program": name,
        "programs": 1,
        "trace_seconds": traced - started,
        "compile_seconds": time.perf_counter() - traced,
    }
    memory = program.memory_analysis()
    if memory is not None:  # some backends do not report it
        row["temporary_gigabytes"] = memory.temp_size_in_bytes / 1e9
    return Compiled(program, row)
