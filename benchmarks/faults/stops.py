"""Is a run that was killed or stopped, and then resumed, bit-identical to an undisturbed one?"""

import random
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.faults import smoke
from maxent_jax.runs import integrity


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields a row for each signal: how often it was sent, how often the run was bit-identical."""
    undisturbed = folder / "undisturbed"
    smoke.finish(undisturbed)  # compiles
    shutil.rmtree(undisturbed)
    seconds = smoke.finish(undisturbed)
    instants = random.Random(0)
    counts = {signal.SIGKILL: 50, signal.SIGTERM: 5, signal.SIGINT: 5, signal.SIGHUP: 5}
    for number, count in counts.items():
        times = 1 if short else count
        trials = [
            _stop(undisturbed, folder / f"{number.name}{i}", number, instants.uniform(0, seconds))
            for i in range(times)
        ]
        yield {
            "fault": number.name,
            "times": times,
            "stopped before the end": sum(t["stopped"] for t in trials),
            "exit codes": sorted({t["exit_code"] for t in trials if t["stopped"]}),
            "checkpoints found": sorted({t["checkpoint"] for t in trials}),
            "resumed bit-identical": sum(t["same"] for t in trials),
            "passed": all(t["same"] for t in trials) and all(map(_ended_as_told, trials)),
        }


def _stop(undisturbed: Path, directory: Path, number: signal.Signals, after: float):
    """Sends a signal to a run after some seconds, then resumes the run to its end."""
    process = smoke.start(directory)
    if number != signal.SIGKILL:  # earlier, the system's default handler ends it
        while process.poll() is None and not integrity.checkpoints(directory):
            time.sleep(0.01)
        after /= 5
    time.sleep(after)
    process.send_signal(number)
    process.communicate()
    found = integrity.checkpoints(directory)
    smoke.finish(directory)
    trial = {
        "signal": number,
        "stopped": process.returncode != 0,
        "exit_code": process.returncode,
        "checkpoint": found[-1] if found else "none",
        "same": smoke.same(undisturbed, directory),
    }
    shutil.rmtree(directory)
    return trial


def _ended_as_told(trial: dict[str, Any]) -> bool:
    """Whether the exit code is that of the signal, or 0."""
    number = trial["signal"]
    expected = -number if number == signal.SIGKILL else 128 + number
    return trial["exit_code"] in (0, expected)
