"""Trains the policies that a run archived on a task: a task reward instead of exploration.

The result is a run like any other, in its own directory, with the task's return in its metrics.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from maxent_jax import errors
from maxent_jax.commands import cli, train
from maxent_jax.config import Config, tasks
from maxent_jax.runs import files, source

SHOWN = (
    *("run", "task", "start_from", "out", "resume", "seed", "num_seeds"),
    *("num_iterations", "steps_per_iteration", "updates_per_step", "intrinsic_weight"),
)


@dataclasses.dataclass(frozen=True)
class Arguments(train.Arguments):
    """Train the policies of a run on a task."""

    run: Annotated[Path, tyro.conf.Positional] = Path()
    """Directory of the run to start from; the first argument."""

    @property
    def directory(self) -> Path:
        """The new run's directory: --out, or one named after the run, the task and the start."""
        own = self.config.downstream
        task = files.as_name(own.task)
        return self.out or files.beside(self.run, f"{task}-{own.start_from}-{self.config.seed}")


def read_arguments(argv: Sequence[str]) -> Arguments:
    """Parses and checks the arguments.

    Raises:
      UsageError, ConfigError, RunError: an argument is invalid.
    """
    cli.import_modules(argv)
    arguments = cli.parse(
        Arguments, argv, "finetune", default=Arguments(_default_config(argv)), shown=SHOWN
    )
    train.check_arguments(arguments)
    return arguments


def _default_config(argv: Sequence[str]) -> Config:
    """The config that flags change: that of the run, but for the task and its budget."""
    if not argv or argv[0].startswith("-"):
        if {"-h", "--help", "--help-all"} & set(argv):
            return Config()
        raise errors.UsageError("the run's directory is missing: name it first.")
    directory, task = Path(argv[0]), cli.flag_value(argv, "--task")
    resumed = train.resumed_config(argv)
    if resumed is not None:
        return resumed
    of_source = files.read_config(directory)
    if not task:
        known = ", ".join(tasks.of_environment(of_source.env))
        raise errors.UsageError(f"the task is missing: add --task, one of {known}.")
    given = cli.flag_value(argv, "--from") or cli.flag_value(argv, "--start-from")
    return source.on_task(of_source, str(directory), task, given or source.DEFAULT_START)


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then loads jax."""
    started = time.perf_counter()
    train.run(read_arguments(argv), started)
