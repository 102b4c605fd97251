"""The run that faults are done to, and whether two runs are the same to the bit."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from maxent_jax.runs import checkpoint, files, integrity

# Saved at every boundary, so that a fault may meet a checkpoint as well as the work between two.
SMOKE = ("--preset", "smoke", "--save-minutes", "1e-9")


def command(directory: Path, *flags: str) -> list[str]:
    """Of a smoke run in that directory."""
    return [sys.executable, "-m", "experiments.train", *SMOKE, "--out", str(directory), *flags]


def train_pendulum(directory: Path) -> None:
    """A run that takes seconds, to its end."""
    small = ("train", "--preset", "smoke", "--env", "pendulum", "--out", str(directory))
    subprocess.run([sys.executable, "-m", "maxent_jax", *small], capture_output=True, check=True)


def start(directory: Path, *flags: str) -> subprocess.Popen[str]:
    """A smoke run in a process of its own."""
    return subprocess.Popen(
        command(directory, *flags),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(directory: Path, *flags: str) -> float:
    """A smoke run to its end, resumed if it has begun; its seconds."""
    started = time.perf_counter()
    done = subprocess.run(
        command(directory, "--resume", *flags), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"a run did not resume: {done.stderr}")
    return time.perf_counter() - started


def same(one: Path, other: Path) -> bool:
    """Whether two runs ended alike: states, metrics but for the clock, and no figure missing."""
    states = [_state(directory) for directory in (one, other)]
    equal_bits = jax.tree.map(lambda a, b: a.tobytes() == b.tobytes(), *states)
    figures = [sorted(p.name for p in (d / files.FIGURES).iterdir()) for d in (one, other)]
    return (
        all(jax.tree.leaves(equal_bits))
        and timeless(one) == timeless(other)
        and figures[0] == figures[1]
    )


def timeless(directory: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl without what the clock has a part in."""
    lines = (directory / files.METRICS).read_text(encoding="utf-8").splitlines()
    assert len(lines) == len(files.read_metrics(directory)), "an unfinished line"
    rows = files.read_metrics(directory)
    return [{k: v for k, v in row.items() if not k.startswith("wall_")} for row in rows]


def _state(directory: Path) -> Any:
    name, _ = integrity.find(directory)
    state = checkpoint.restore(directory, name, files.read_config(directory))
    return jax.tree.map(np.asarray, state._replace(key=jax.random.key_data(state.key)))
