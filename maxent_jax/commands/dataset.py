"""Writes a dataset of a run's mixture: transitions for offline reinforcement learning.

The dataset is written a few episodes at a time, so it may be larger than the memory. The same
command continues a dataset that was stopped. One policy plays each episode, also in runs with
--mixing step.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from maxent_jax.checks import check_choice, check_seed
from maxent_jax.commands import cli
from maxent_jax.config import tasks
from maxent_jax.runs import files, integrity, runtime
from maxent_jax.visual import headless

FORMATS = ("npz", "minari", "exorl")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write a dataset of a run's mixture."""

    directory: Annotated[Path, tyro.conf.Positional]
    """The run's directory."""
    format: str = "npz"
    """npz (numpy, the keys of D4RL), minari (extra minari), or exorl (an npz for each episode)."""
    transitions: int = 100_000
    """Transitions to write."""
    task: str = tasks.NONE
    """Task whose rewards are added (docs/how-to/finetune.md); none: no rewards."""
    seed: int = 0
    """Seed of the episodes."""
    seed_index: int = 0
    """Which seed of the run, from 0, if it trained several."""
    fallback: bool = False
    """If the last checkpoint is damaged, use the one before."""
    out: Path | None = None
    """The dataset's directory; if left out, DIRECTORY-FORMAT."""
    modules: cli.Modules = ()
    """Module, by name or path, that registers your environments or tasks."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then loads jax.

    Raises:
      UsageError, ConfigError, RunError: an argument is invalid.
    """
    cli.import_modules(argv)
    arguments = cli.parse(Arguments, argv, "dataset")
    check_choice("format", arguments.format, FORMATS)
    cli.check_least("--transitions", arguments.transitions)
    check_seed("--seed", arguments.seed)
    config = files.read_config(arguments.directory)
    config.check_registered()
    if arguments.task != tasks.NONE:
        tasks.parse(arguments.task, config.env)
        tasks.check_registered(arguments.task)
    integrity.check_any(arguments.directory)
    out = arguments.out or files.beside(arguments.directory, arguments.format)
    headless.draw_nothing()
    runtime.start(config.simulates_in_jax)
    from maxent_jax.analysis import dataset_files, load_run
    from maxent_jax.runs.progress import counting

    run = load_run(arguments.directory, arguments.seed_index, arguments.fallback)
    with counting(arguments.transitions, "transitions") as report:
        dataset_files.write(
            run,
            out,
            arguments.format,
            arguments.transitions,
            arguments.task,
            arguments.seed,
            report,
        )
    print(f"{out}: {arguments.transitions:,} transitions in format {arguments.format}.")
