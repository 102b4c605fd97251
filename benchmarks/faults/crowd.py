"""Two processes start a run in one directory at once: does exactly one continue?"""

import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.faults import smoke
from maxent_jax.runs import files


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields one row."""
    times = 1 if short else 10
    trials = [_race(folder / str(i)) for i in range(times)]
    one_ran = sum(trial["one ran"] for trial in trials)
    yield {
        "fault": "two processes, one directory",
        "times": times,
        "exactly one ran": one_ran,
        "the other said": sorted({trial["said"] for trial in trials}),
        "passed": one_ran == times,
    }


def _race(directory: Path) -> dict[str, Any]:
    runners = [smoke.start(directory, "--resume") for _ in range(2)]
    while all(runner.poll() is None for runner in runners):
        time.sleep(0.01)
    runners.sort(key=lambda runner: runner.poll() is None)
    loser, winner = runners
    said = loser.communicate()[1].strip().replace(str(directory), "DIR")
    while not (directory / files.CONFIG).exists() and winner.poll() is None:
        time.sleep(0.01)
    one_ran = winner.poll() is None and loser.returncode == 2
    os.kill(winner.pid, signal.SIGKILL)
    winner.communicate()
    smoke.finish(directory)  # although the lock of the killed process is still there
    shutil.rmtree(directory)
    return {"one ran": one_ran, "said": said}
