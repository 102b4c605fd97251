"""Non-finite numbers: is one in an observation contained, and does any other end the run?"""

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import envs
from maxent_jax.config import preset
from maxent_jax.envs.pendulum import Pendulum
from maxent_jax.errors import NonFiniteError
from maxent_jax.runs import checkpoint, driver, files, integrity


class Faulty(Pendulum):
    """A pendulum whose observation is NaN on one side."""

    def step(self, state, action):
        """Takes the pendulum's step, or gives NaN."""
        after = super().step(state, action)
        lost = after.obs[1] > 0.1  # sin θ
        return after.replace(obs=jnp.where(lost, jnp.nan, after.obs))


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields a row for each place with a non-finite number; the last two overflow by a setting."""
    envs.register("faulty", lambda backend, physics: Faulty())
    directory = folder / "observation"
    error = _train(directory, env="user:faulty")
    counted = sum(row["num_invalid"] for row in files.read_metrics(directory))
    yield {
        "fault": "nan in an observation",
        "times": 1,
        "counted": counted,
        "non-finite in checkpoints": _num_not_finite(directory),
        "passed": not error and counted > 0 and not _num_not_finite(directory),
    }
    for what, setting in (("reward", "reward_scale"), ("gradient", "learning_rate")):
        directory = folder / what
        error = _train(directory, env="pendulum", **{setting: 3e38})
        found = _num_not_finite(directory)
        yield {
            "fault": f"overflow in the {what}",
            "times": 1,
            "said": error.replace(str(folder), "DIR"),
            "non-finite in checkpoints": found,
            "passed": "iteration 1 produced a number that is not finite" in error and not found,
        }


def _train(directory: Path, **changes: Any) -> str:
    """Trains a smoke run, saved at every boundary; returns its error, or ""."""
    directory.mkdir()
    config = preset("smoke", **changes)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            driver.train(config, directory, time.perf_counter(), driver.Options(save_minutes=1e-9))
    except NonFiniteError as error:
        return str(error)
    return ""


def _num_not_finite(directory: Path) -> int:
    """Counts the non-finite numbers in all checkpoints."""
    config, found = files.read_config(directory), 0
    for name in integrity.checkpoints(directory):
        state = checkpoint.restore(directory, name, config)
        for leaf in jax.tree.leaves(state._replace(key=state.iteration)):
            found += int(np.sum(~np.isfinite(np.asarray(leaf, np.float64))))
    return found
