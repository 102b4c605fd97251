"""The run that the faults are tried on, and whether two runs are bit-identical."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from maxent_jax.runs import checkpoint, files, integrity

# Saved at every boundary, so that a fault may occur in a checkpoint or between two.
SMOKE = ("--preset", "smoke", "--save-minutes", "1e-9")


def command(directory: Path, *flags: str) -> list[str]:
    """Returns the command of a smoke run in a directory."""
    return [sys.executable, "-m", "experiments.train", *SMOKE, "--out", str(directory), *flags]


def train_pendulum(directory: Path) -> None:
    """Runs a smoke run on the pendulum to its end, which takes seconds."""
    small = ("train", "--preset", "smoke", "--env", "pendulum", "--out", str(directory))
    subprocess.run([sys.executable, "-m", "maxent_jax", *small], capture_output=True, check=True)


def start(directory: Path, *flags: str) -> subprocess.Popen[str]:
    """Starts a smoke run in its own process."""
    return subprocess.Popen(
        command(directory, *flags),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(directory: Path, *flags: str) -> float:
    """Runs a smoke run to its end, resuming it if it has begun; returns the seconds."""
    started = time.perf_counter()
    done = subprocess.run(
        command(directory, "--resume", *flags), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"a run did not resume: {done.stderr}")
    return time.perf_counter() - started


def same(one: Path, other: Path) -> bool:
    """Tells whether two runs have bit-identical states, and equal metrics and figure names."""
    states = [_state(directory) for directory in (one, other)]
    equal_bits = jax.tree.map(lambda a, b: a.tobytes() == b.tobytes(), *states)
    figures = [sorted(p.name for p in (d / files.FIGURES).iterdir()) for d in (one, other)]
    return (
        all(jax.tree.leaves(equal_bits))
        and timeless(one) == timeless(other)
        and figures[0] == figures[1]
    )


def timeless(directory: Path) -> list[dict[str, Any]]:
    """Returns the lines of metrics.jsonl without the values that depend on the clock."""
    lines = (directory / files.METRICS).read_text(encoding="utf-8").splitlines()
    assert len(lines) == len(files.read_metrics(directory)), "an unfinished line"
    rows = files.read_metrics(directory)
    return [{k: v for k, v in row.items() if not k.startswith("wall_")} for row in rows]


def _state(directory: Path) -> Any:
    name, _ = integrity.find(directory)
    state = checkpoint.restore(directory, name, files.read_config(directory))
    return jax.tree.map(np.asarray, state._replace(key=jax.random.key_data(state.key)))
