"""Trains a run to its end and draws its figures: `maxent_jax.train`. Loads jax only when called."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from maxent_jax.checks import check_path
from maxent_jax.config import Config
from maxent_jax.runs import integrity, runtime
from maxent_jax.runs.claim import Claim

if TYPE_CHECKING:
    from maxent_jax.analysis import Run
    from maxent_jax.runs.driver import Options


def train(config: Config, out: str | Path, resume: bool = False, overwrite: bool = False) -> "Run":
    """Trains a run in this process, draws its figures and loads it, as the command `train` does.

    Progress goes to standard error, and a summary to standard output.

    Args:
      config: the settings, for example `preset("quick", env="pendulum")`.
      out: the run's directory.
      resume: continue the run in the directory from its last checkpoint; start without one.
      overwrite: remove the run that the directory holds, and start again.
    Returns:
      The finished run; of several seeds, the first (see `load_run`).
    Raises:
      UsageError, RunError: the directory is not free, or holds a run with other settings.
      ConfigError: the settings do not fit this machine, or the run to start from.
      CheckpointCorruptError: the last checkpoint is damaged.
      SaveError: a file cannot be written.
      NonFiniteError: training produced a number that is not finite.
      Interrupted: a signal arrived, and the run is saved.
    """
    from maxent_jax.analysis import load_run
    from maxent_jax.runs import driver

    started, directory = time.perf_counter(), check_path("out", out)
    if not (resume and integrity.checkpoints(directory)):
        config.check_new()
    claim = Claim(directory, config, resume, overwrite)
    claim.check()
    runtime.prepare(config.simulates_in_jax)
    driver.check(config)
    with claim.hold():
        run_to_end(config, directory, started, driver.AS_USUAL)
    return load_run(directory)


def run_to_end(config: Config, directory: Path, started: float, options: "Options") -> int | None:
    """Trains the rest of the run and draws its figures; returns `driver.Ended.received`."""
    from maxent_jax.runs import driver, hosts  # loads jax
    from maxent_jax.visual import figures, plotting

    ended = driver.train(config, directory, started, options)
    if hosts.is_first():
        if ended.trained:  # `evaluate` may have drawn what the run was before
            plotting.remove_saved(directory)
        figures.draw_missing(directory)
    return ended.received
