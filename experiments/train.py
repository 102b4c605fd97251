"""Trains a mixture of policies that covers the state space, and leaves its figures.

A run's directory holds config.json, metrics.jsonl (one line an iteration), checkpoints/ and
figures/. `--resume` goes on from the last complete checkpoint.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from experiments import cli
from maxent_jax import runs
from maxent_jax.config import Config, preset


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train a mixture of policies that covers the state space, with no reward at all."""

    config: Config
    out: Path | None = None
    """The run's directory; runs/ENV-METHOD-PRESET-SEED when left out."""
    resume: bool = False
    """Go on from the last complete checkpoint in the run's directory; start over without one."""

    @property
    def directory(self) -> Path:
        """Where the run lives."""
        c = self.config
        return self.out or Path("runs") / f"{c.env}-{c.method}-{c.preset}-{c.seed}"


def read_arguments(argv: Sequence[str]) -> Arguments:
    """The checked arguments, and the directory known to be free or to hold this very run.

    Raises:
      UsageError, ConfigError, RunError: one sentence each.
    """
    env = cli.flag_value(argv, "--env") or Config.env
    config = preset(cli.flag_value(argv, "--preset") or Config.preset, env=env)
    arguments = cli.parse(Arguments, argv, "experiments.train", default=Arguments(config))
    directory = arguments.directory
    if not directory.exists() or (directory.is_dir() and not any(directory.iterdir())):
        return arguments
    if not arguments.resume:
        raise cli.UsageError(
            f"{directory} already exists: choose another --out, or add --resume to go on with it."
        )
    saved = runs.read_config(directory)
    changed = [
        field.name
        for field in dataclasses.fields(Config)
        if getattr(saved, field.name) != getattr(arguments.config, field.name)
    ]
    if changed:
        listed = ", ".join(
            f"{name} was {getattr(saved, name)} and is {getattr(arguments.config, name)}"
            for name in changed
        )
        raise cli.UsageError(f"{directory} holds a run with other settings: {listed}.")
    return arguments


def main(argv: Sequence[str]) -> None:
    """Parses, checks, and only then loads jax."""
    started = time.perf_counter()
    arguments = read_arguments(argv)
    try:
        arguments.directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cli.UsageError(f"cannot write to {arguments.directory}: {error.strerror}.") from None
    from experiments import driver  # loads jax

    driver.train(arguments.config, arguments.directory, started)


def run() -> None:
    """The entry point."""
    cli.entry_point(main)()


if __name__ == "__main__":
    run()
