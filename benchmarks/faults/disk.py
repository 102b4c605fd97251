"""What does a full disk cost? The disk is real (tmpfs), mounted for this process alone."""

import contextlib
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.faults import smoke
from maxent_jax import training
from maxent_jax.commands import train
from maxent_jax.errors import SaveError
from maxent_jax.runs import checkpoint, driver, files, integrity
from maxent_jax.visual import plotting

MEGABYTES = 16
# The writers that find a full disk, and the largest number of bytes left for them.
WRITERS: tuple[tuple[str, Any, str, int], ...] = (
    ("checkpoint", checkpoint, "save", 200_000),
    ("log", files, "append_metrics", 0),
    ("figure", plotting, "save", 50_000),
)


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields a row for each writer, from a process in its own namespace, in which it may mount."""
    apart = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c")
    mounted = f'mount -t tmpfs -o size={MEGABYTES}m none {folder} && exec "$0" "$@"'
    inner = (sys.executable, "-m", "benchmarks.faults.disk", str(folder), str(int(short)))
    done = subprocess.run([*apart, mounted, *inner], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"a small disk could not be mounted and filled: {done.stderr}")
    yield from map(json.loads, done.stdout.splitlines())


def fill(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields the rows; `folder` is on the small disk."""
    undisturbed, rng = folder / "undisturbed", random.Random(0)
    _train(undisturbed)
    for what, module, name, most in WRITERS:
        times = 1 if short else 5
        trials = [
            _trial(undisturbed, folder / f"{what}{i}", module, name, rng.randint(0, most))
            for i in range(times)
        ]
        counts = {key: sum(trial[key] for trial in trials) for key in trials[0] if key != "said"}
        yield {
            "fault": f"disk full, {what}",
            "times": times,
            **counts,
            "said": trials[0]["said"].replace(str(folder), "DIR"),
            "passed": all(count == times for count in counts.values()),
        }


def _trial(undisturbed: Path, directory: Path, module: Any, name: str, left: int) -> dict[str, Any]:
    """Fills the disk at a later call of the writer, frees it, and resumes."""
    ballast, write = directory.parent / "ballast", getattr(module, name)
    calls = {"left": 3 if name == "save" and module is checkpoint else 1}

    def write_on_a_full_disk(*arguments: Any) -> Any:
        calls["left"] -= 1
        if calls["left"] == 0:
            _fill(ballast, left)
        return write(*arguments)

    said, before = "", []
    with mock.patch.object(module, name, write_on_a_full_disk):
        try:
            _train(directory)
        except SaveError as error:
            said = str(error)
            before = integrity.checkpoints(directory)
    intact = all(not list(integrity.damages(directory, name)) for name in before)
    ballast.unlink()
    _train(directory)
    trial = {
        "said in a sentence": bool(said) and "\n" not in said,
        "earlier checkpoints intact": intact and bool(before),
        "resumed bit-identical": smoke.same(undisturbed, directory),
        "said": said,
    }
    subprocess.run(["rm", "-r", str(directory)], check=True)
    return trial


def _fill(ballast: Path, left: int) -> None:
    """Fills the disk with a file that leaves `left` bytes, in whole pages."""
    free = os.statvfs(ballast.parent)
    with open(ballast, "wb") as file:
        file.write(bytes(max(free.f_bavail * free.f_frsize - left, 0)))


def _train(directory: Path) -> None:
    """A complete smoke run in this process, as from the command line."""
    arguments = train.read_arguments([*smoke.SMOKE, "--out", str(directory), "--resume"])
    options = driver.Options(save_minutes=arguments.save_minutes)
    with arguments.claim.hold(), contextlib.redirect_stdout(sys.stderr):
        training.run_to_end(arguments.config, directory, time.perf_counter(), options)


if __name__ == "__main__":
    for row in fill(Path(sys.argv[1]), sys.argv[2] == "1"):
        print(json.dumps(row), flush=True)
