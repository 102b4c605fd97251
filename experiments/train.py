"""Trains a mixture of policies that covers the state space, and leaves its figures.

A run's directory holds config.json, metrics.jsonl (one line an iteration), checkpoints/ and
figures/. `--resume` goes on from the last complete checkpoint.
"""

import dataclasses
import re
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
    devices: int = 1
    """Devices that share the run: seeds first, then environments. 0: all there are."""
    coordinator: str = ""
    """HOST:PORT of the first of several processes, or auto under SLURM, Open MPI, Kubernetes and on
    a TPU slice; see docs/clusters.md."""
    num_processes: int = 1
    """Processes of the run, with --coordinator HOST:PORT."""
    process_id: int = 0
    """Which of them this is, from 0."""

    @property
    def directory(self) -> Path:
        """Where the run lives."""
        c = self.config
        return self.out or Path("runs") / f"{c.env}-{c.method}-{c.preset}-{c.seed}"


def read_arguments(argv: Sequence[str]) -> Arguments:
    """The checked arguments.

    Raises:
      UsageError, ConfigError, RunError: one sentence each.
    """
    env = cli.flag_value(argv, "--env") or Config.env
    config = preset(cli.flag_value(argv, "--preset") or Config.preset, env=env)
    arguments = cli.parse(Arguments, argv, "experiments.train", default=Arguments(config))
    _check_hosts(arguments)
    return arguments


def claim_directory(arguments: Arguments) -> None:
    """Makes the run's directory, unless it is there: then it is empty, or holds this very run.

    Raises:
      UsageError, RunError: it does not, or cannot be made.
    """
    directory = arguments.directory
    if directory.is_file() or (directory.is_dir() and any(directory.iterdir())):
        _check_resumed(arguments)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cli.UsageError(f"cannot write to {directory}: {error.strerror}.") from None


def _check_resumed(arguments: Arguments) -> None:
    directory = arguments.directory
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


def _check_hosts(arguments: Arguments) -> None:
    coordinator, processes = arguments.coordinator, arguments.num_processes
    for wrong, sentence in (
        (
            arguments.devices < 0,
            f"devices is {arguments.devices}, but must be 0 (all) or more.",
        ),
        (
            not coordinator and (processes, arguments.process_id) != (1, 0),
            "num-processes and process-id need --coordinator HOST:PORT.",
        ),
        (
            coordinator not in ("", "auto") and not re.fullmatch(r".+:\d+", coordinator),
            f"coordinator is '{coordinator}', but must be HOST:PORT, or auto.",
        ),
        (
            processes < 1 or not 0 <= arguments.process_id < processes,
            f"process-id is {arguments.process_id}, but must be from 0 to below num-processes = "
            f"{processes}.",
        ),
        (
            coordinator == "auto" and (processes, arguments.process_id) != (1, 0),
            "num-processes and process-id cannot be chosen with --coordinator auto.",
        ),
        (
            coordinator and arguments.devices > 1,
            "devices cannot be chosen with --coordinator: all devices of all processes take part.",
        ),
    ):
        if wrong:
            raise cli.UsageError(sentence)


def main(argv: Sequence[str]) -> None:
    """Parses, checks, and only then loads jax."""
    started = time.perf_counter()
    arguments = read_arguments(argv)
    num_devices = arguments.devices
    if arguments.coordinator:
        from experiments import hosts  # loads jax
        from maxent_jax import runtime

        runtime.prepare(arguments.config.simulates_in_jax)  # before the first computation
        hosts.join(arguments.coordinator, arguments.num_processes, arguments.process_id)
        claim_directory(arguments)  # by all, so that all end where it is taken
        hosts.wait_for_all("directory")
        num_devices = 0
    else:
        claim_directory(arguments)
    from experiments import driver  # loads jax

    driver.train(arguments.config, arguments.directory, started, num_devices)


def run() -> None:
    """The entry point."""
    cli.entry_point(main)()


if __name__ == "__main__":
    run()
