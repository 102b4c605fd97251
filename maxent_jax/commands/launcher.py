"""Submits a study's workers to a SLURM cluster, as one job array; needs the extra `slurm`."""

import dataclasses
import importlib.util
import shutil
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxent_jax.checks import check_choice
from maxent_jax.commands import cli
from maxent_jax.errors import UsageError
from maxent_jax.runs.signals import Interrupted

if TYPE_CHECKING:
    import submitit

SAVE_SECONDS = 300  # before a job's end: enough to finish a segment of a run, and to save
MAX_TIMEOUTS = 1000  # of a job; ends one whose time is too short to get anywhere
LISTS = {"setup", "teardown", "srun_args", "additional_parameters"}  # not written as KEY=VALUE


@dataclasses.dataclass(frozen=True)
class Worker:
    """What a job runs: the command `reproduce`, which trains the cells that no other one holds."""

    argv: tuple[str, ...]

    def __call__(self) -> None:
        """Trains until no cell is left."""
        cli.entry_point(_train)(self.argv)

    def checkpoint(self) -> "submitit.helpers.DelayedSubmission":
        """Returns what a requeued job runs: the same, for the study's directory holds its state."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def _train(argv: Sequence[str]) -> None:
    """Once a run has saved itself, passes the signal on to submitit, which requeues the job."""
    try:
        cli.command("reproduce")(argv)
    except Interrupted as stop:
        signal.raise_signal(stop.received)
        raise


def slurm(folder: Path, words: Sequence[str]) -> "submitit.SlurmExecutor":
    """Returns submitit's executor for SLURM; writes nothing.

    Args:
      folder: where jobs and their logs will be written.
      words: settings of sbatch, as KEY=VALUE.
    Raises:
      UsageError, ConfigError: submitit or sbatch is missing, or a setting is wrong.
    """
    if importlib.util.find_spec("submitit") is None:
        raise UsageError(
            "--launcher submitit needs submitit, which is not installed: pip install submitit."
        )
    missing = [name for name in ("sbatch", "srun") if shutil.which(name) is None]
    if missing:
        raise UsageError(
            f"--launcher submitit needs {missing[0]}, which is not on the PATH: call it on a login "
            f"node of a SLURM cluster."
        )
    import submitit

    settings = _settings(words, submitit.SlurmExecutor._valid_parameters() - LISTS)
    executor = submitit.SlurmExecutor(folder, max_num_timeout=MAX_TIMEOUTS)
    executor.update_parameters(
        job_name="maxent-jax",
        stderr_to_stdout=True,
        additional_parameters={"requeue": True},
        **settings,
    )
    return executor


def _settings(words: Sequence[str], known: set[str]) -> dict[str, Any]:
    settings: dict[str, Any] = {"signal_delay_s": SAVE_SECONDS}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise UsageError(f"slurm has '{word}', but must be KEY=VALUE.")
        check_choice("setting of SLURM", name, sorted(known))
        settings[name] = int(value) if value.isdecimal() else value
    minutes, delay = settings.get("time", "missing"), settings["signal_delay_s"]
    if not isinstance(minutes, int) or not isinstance(delay, int) or 60 * minutes <= delay:
        raise UsageError(
            f"slurm has time = {minutes}, but needs --slurm time=MINUTES, a whole number above "
            f"signal_delay_s = {delay} seconds: that long before its end a job is told to save."
        )
    return settings


def submit(
    executor: "submitit.core.core.PicklingExecutor", argv: Sequence[str], num_workers: int
) -> "list[submitit.Job[None]]":
    """Submits the workers as one job array, or a single job; returns a handle of each.

    Args:
      executor: of `slurm`, or another of submitit's.
      argv: the arguments of the command `reproduce`, for each worker.
    Raises:
      UsageError: the cluster refuses the job.
    """
    from submitit.core.utils import FailedJobError
    from submitit.helpers import clean_env

    try:
        with clean_env():
            return executor.submit_array([Worker(tuple(argv))] * num_workers)
    except FailedJobError as error:
        raise UsageError(f"the cluster refuses the job: {cli.one_line(error)}.") from None
