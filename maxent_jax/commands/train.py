"""Trains a mixture of policies that covers the state space, and leaves its figures.

A run's directory holds config.json, metrics.jsonl (one line an iteration), checkpoints/ and
figures/. `--resume` goes on from the last complete checkpoint.
"""

import contextlib
import dataclasses
import os
import re
import shlex
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from maxent_jax import errors
from maxent_jax.commands import cli
from maxent_jax.config import Config, preset
from maxent_jax.runs import files, integrity, locks, runtime
from maxent_jax.runs.loggers import FOLDERS as SINKS
from maxent_jax.runs.loggers import Sinks

if TYPE_CHECKING:
    from maxent_jax.runs.driver import Options
from maxent_jax.visual import headless

# What matters first: --help shows these, and --help-all the rest.
SHOWN = (
    *("env", "method", "preset", "backend", "seed", "num_seeds", "out", "resume"),
    *("num_iterations", "steps_per_iteration", "updates_per_step", "num_envs"),
)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train a mixture of policies that covers the state space, with no reward at all."""

    config: Config
    out: Path | None = None
    """The run's directory; runs/ENV-METHOD-PRESET-SEED when left out."""
    resume: bool = False
    """Continue from the last checkpoint in --out, with that run's settings; begin without one."""
    fallback: bool = False
    """With --resume: where the last checkpoint is damaged, remove it and take the one before."""
    overwrite: bool = False
    """Remove the run that is in the directory, and begin anew."""
    save_iterations: int = 1
    """Iterations between checkpoints; the last one is always saved."""
    save_minutes: float = 10.0
    """After so many minutes without a checkpoint, save between two segments of an iteration."""
    tensorboard: bool = False
    """Write metrics for TensorBoard too, into the run's directory (extra log)."""
    wandb: str = ""
    """Send metrics to that project of Weights & Biases too (extra log)."""
    devices: int = 1
    """Devices that share the run: seeds first, then environments. 0: all there are."""
    coordinator: str = ""
    """HOST:PORT of the first of several processes, or auto under SLURM, Open MPI, Kubernetes and on
    a TPU slice; see docs/clusters.md."""
    num_processes: int = 1
    """Processes of the run, with --coordinator HOST:PORT."""
    process_id: int = 0
    """Which of them this is, from 0."""
    modules: cli.Modules = ()
    """A module, by name or path, that registers environments, bonuses or methods of yours."""

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
    if cli.flag_value(argv, "--out") == "":
        raise errors.UsageError("out is empty: name a directory, or leave --out away.")
    cli.import_modules(argv)
    default = Arguments(_default_config(argv))
    arguments = cli.parse(Arguments, argv, "train", default=default, shown=SHOWN)
    arguments.config.check_registered()
    _check_saving(arguments)
    _check_hosts(arguments)
    Sinks(arguments.tensorboard, arguments.wandb).check()
    return arguments


def _default_config(argv: Sequence[str]) -> Config:
    """What flags change: a preset, or the settings of the run to be resumed."""
    values = {name: cli.flag_value(argv, f"--{name}") for name in ("preset", "env", "method")}
    given = {name: value for name, value in values.items() if value}
    out = cli.flag_value(argv, "--out")
    if "--resume" in argv and out and not given and Path(out, files.CONFIG).exists():
        return files.read_config(Path(out))
    name = given.pop("preset", Config.preset)
    return preset(name, **given)


@contextlib.contextmanager
def claimed(arguments: Arguments) -> Iterator[None]:
    """Makes the run's directory, and keeps other processes out of it while inside.

    Raises:
      BusyError: another process trains in it.
      UsageError, RunError: see check_free; or it cannot be made.
    """
    directory = arguments.directory
    check_free(arguments)
    with locks.holding(directory, wait=False):
        check_free(arguments)  # again: another process may have been here meanwhile
        if arguments.overwrite:
            _remove_run(directory)
        yield


def check_free(arguments: Arguments) -> None:
    """Whether the directory is not there or nobody's, or holds a run that the arguments deal with.

    Raises:
      UsageError, RunError: it does not.
    """
    directory = arguments.directory
    try:
        _check_writable(directory)
        if not directory.exists() or (directory.is_dir() and _is_nobodys(directory)):
            return
    except OSError as error:
        raise errors.UsageError(f"cannot write to {directory}: {error.strerror}.") from None
    if arguments.resume:
        files.check_config(directory, arguments.config)
        files.check_resumable(directory)
    elif not arguments.overwrite:
        raise errors.UsageError(
            f"{directory} already exists: choose another --out, or add --resume to go on with it "
            f"or --overwrite to begin anew."
        )
    elif not files.is_config(directory / files.CONFIG):
        raise errors.UsageError(f"{directory} is not the directory of a run: it is left as it is.")


def _check_writable(directory: Path) -> None:
    """Raises UsageError where the directory cannot be made, or nothing be written into it."""
    place = next(p for p in (directory, *directory.absolute().parents) if os.path.lexists(p))
    try:
        str(directory.absolute()).encode()
    except UnicodeEncodeError:  # bytes that are no text, which TensorStore cannot take
        raise errors.UsageError(f"cannot write to {directory}: its path must be UTF-8.") from None
    if place.is_symlink() and not place.exists():
        raise errors.UsageError(f"cannot write to {directory}: {place} is a link to nowhere.")
    if not place.is_dir() and place != directory:
        raise errors.UsageError(f"cannot write to {directory}: {place} is no directory.")
    if place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
        raise errors.UsageError(f"cannot write to {directory}: {place} is not writable.")


def _is_nobodys(directory: Path) -> bool:
    """Whether it holds no more than what a run leaves that ended before its first checkpoint."""
    if integrity.checkpoints(directory):
        return False
    return all(_is_of_a_beginning(path) for path in directory.iterdir())


def _is_of_a_beginning(path: Path) -> bool:
    directory = path.parent
    if path.name == files.CONFIG and path.is_file():
        return files.is_config(path)
    if path.name == files.METRICS:
        return path.is_file() and path.stat().st_size == 0
    if path.name == integrity.FOLDER:
        unfinished = path.is_dir() and all(
            inside.name.startswith(integrity.UNFINISHED) for inside in path.iterdir()
        )
        return unfinished and not path.is_symlink()
    temporary = {
        files.temporary_of(directory / name).name for name in (files.CONFIG, files.METRICS)
    }
    if path.name in SINKS:
        return (directory / files.CONFIG).is_file()
    return path.name in {locks.LOCK, *temporary}


def _remove_run(directory: Path) -> None:
    """All that a run writes, and nothing else."""
    for name in files.WRITTEN:
        path = directory / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _check_saving(arguments: Arguments) -> None:
    for wrong, sentence in (
        (
            arguments.save_iterations < 1,
            f"save-iterations is {arguments.save_iterations}, but must be at least 1.",
        ),
        (
            not arguments.save_minutes > 0,
            f"save-minutes is {arguments.save_minutes}, but must be a positive number.",
        ),
        (
            arguments.resume and arguments.overwrite,
            "resume and overwrite exclude each other.",
        ),
        (
            arguments.fallback and not arguments.resume,
            "fallback needs --resume.",
        ),
    ):
        if wrong:
            raise errors.UsageError(sentence)


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
            raise errors.UsageError(sentence)


def main(argv: Sequence[str]) -> None:
    """Parses, checks, and only then loads jax."""
    started = time.perf_counter()
    arguments = read_arguments(argv)
    config, num_devices = arguments.config, arguments.devices
    check_free(arguments)
    headless.draw_nothing()
    load = runtime.prepare if arguments.coordinator else runtime.start
    load(config.simulates_in_jax)
    from maxent_jax.runs import driver, hosts  # loads jax

    holding: contextlib.AbstractContextManager[None] = claimed(arguments)
    if arguments.coordinator:
        hosts.join(arguments.coordinator, arguments.num_processes, arguments.process_id)
        check_free(arguments)  # by all, so that all end where it is taken
        hosts.wait_for_all("checked")
        num_devices = 0
        if not hosts.is_first():
            holding = contextlib.nullcontext()
    options = driver.Options(
        num_devices,
        arguments.fallback,
        arguments.save_iterations,
        arguments.save_minutes,
        Sinks(arguments.tensorboard, arguments.wandb),
    )
    driver.check(config, options)  # before there is a directory
    with holding:
        hosts.wait_for_all("claimed")
        run_to_end(config, arguments.directory, started, options)
    if hosts.is_first():
        _print_figures(arguments.directory)
        _point_onward(arguments.directory)


def run_to_end(config: Config, directory: Path, started: float, options: "Options") -> None:
    """Trains what is left of the run, and draws its figures. See driver.train."""
    from maxent_jax.runs import driver, hosts  # loads jax
    from maxent_jax.visual import figures

    driver.train(config, directory, started, options)
    if hosts.is_first():
        figures.draw_missing(directory)


def _print_figures(directory: Path) -> None:
    from maxent_jax.visual import plotting

    print(f"figures: {directory / files.FIGURES}/{{{','.join(plotting.NAMES)}}}.png")


def _point_onward(directory: Path) -> None:
    """What a user may type next."""
    what = shlex.quote(str(directory))
    print("next:")
    for name in ("evaluate", "render", "report"):
        print(f"  {cli.spelled(name) + ' ' + what:60} # {cli.COMMANDS[name]}")
