"""Trains a mixture of policies that covers the state space, and draws its figures.

A run's directory holds config.json, metrics.jsonl (one line per iteration), checkpoints/ and
figures/. `--resume` continues from the last complete checkpoint.
"""

import contextlib
import dataclasses
import re
import shlex
import time
from collections.abc import Sequence
from pathlib import Path

from maxent_jax import errors, training
from maxent_jax.commands import cli
from maxent_jax.config import Config, imports, preset, tasks
from maxent_jax.runs import files, integrity, runtime, source
from maxent_jax.runs.claim import Claim
from maxent_jax.runs.loggers import Sinks
from maxent_jax.visual import headless

# What matters first: --help shows these, and --help-all the rest.
SHOWN = (
    *("env", "method", "preset", "backend", "seed", "num_seeds", "out", "resume"),
    *("num_iterations", "steps_per_iteration", "updates_per_step", "num_envs"),
)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train a mixture of policies that covers the state space, without any reward."""

    config: Config
    out: Path | None = None
    """The run's directory; if left out, runs/ENV-METHOD-PRESET-SEED."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint, with its settings, or start a new one."""
    fallback: bool = False
    """With --resume: if the last checkpoint is damaged, remove it and use the one before."""
    overwrite: bool = False
    """Remove the run in the directory and start again."""
    save_iterations: int = 1
    """Iterations between checkpoints; the last iteration is always saved."""
    save_minutes: float = 10.0
    """Also save between two segments, after this many minutes without a checkpoint."""
    tensorboard: bool = False
    """Also write metrics for TensorBoard into the run's directory (needs the extra log)."""
    wandb: str = ""
    """Also send metrics to this project of Weights & Biases (needs the extra log)."""
    devices: int = 1
    """Devices that share the run: seeds first, then environments; 0: all devices."""
    coordinator: str = ""
    """HOST:PORT of the first of several processes, or auto (SLURM, Open MPI,
    Kubernetes, TPU slice); see docs/how-to/clusters.md."""
    num_processes: int = 1
    """Processes that share the run, with --coordinator HOST:PORT."""
    process_id: int = 0
    """Index of this process, from 0."""
    modules: cli.Modules = ()
    """Module, by name or path, that registers your environments, bonuses, methods or tasks."""

    @property
    def directory(self) -> Path:
        """The run's directory: --out, or one named after its settings."""
        c = self.config
        paid_by = c.method
        if c.downstream.task != tasks.NONE:
            paid_by += f"-{files.as_name(c.downstream.task)}"
        return self.out or Path("runs") / f"{c.env}-{paid_by}-{c.preset}-{c.seed}"

    @property
    def claim(self) -> Claim:
        """What the run asks of its directory."""
        return Claim(self.directory, self.config, self.resume, self.overwrite)


def read_arguments(argv: Sequence[str]) -> Arguments:
    """Parses and checks the arguments.

    Raises:
      UsageError, ConfigError, RunError: an argument is invalid.
    """
    if cli.flag_value(argv, "--out") == "":
        raise errors.UsageError("out is empty: name a directory, or leave out --out.")
    cli.import_modules(argv)
    default = Arguments(_default_config(argv))
    arguments = cli.parse(Arguments, argv, "train", default=default, shown=SHOWN)
    check_arguments(arguments)
    return arguments


def check_arguments(arguments: Arguments) -> None:
    """Checks arguments that were parsed.

    Raises:
      UsageError, ConfigError, RunError: an argument is invalid.
    """
    arguments.config.check_registered()
    resumed = arguments.resume and integrity.checkpoints(arguments.directory)
    if not resumed:  # a run that is resumed no longer needs its source
        arguments.config.check_new()
        source.check(arguments.config)
    _check_saving(arguments)
    _check_hosts(arguments)
    Sinks(arguments.tensorboard, arguments.wandb).check()


def _default_config(argv: Sequence[str]) -> Config:
    """The config that flags change: a preset, or that of the run to resume."""
    decisive = ("preset", "env", "method", "protocol", "task")
    values = {name: cli.flag_value(argv, f"--{name}") for name in decisive}
    given = {name: value for name, value in values.items() if value}
    resumed = None if given else resumed_config(argv)
    if resumed is not None:
        return resumed
    name = given.pop("preset", Config.preset)
    return preset(name, **given)


def resumed_config(argv: Sequence[str]) -> Config | None:
    """Returns the config of the run in --out if --resume continues it; None without one."""
    out = cli.flag_value(argv, "--out")
    if "--resume" in argv and out and Path(out, files.CONFIG).exists():
        return files.read_config(Path(out))
    return None


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
            "resume and overwrite exclude each other: leave one out.",
        ),
        (
            arguments.fallback and not arguments.resume,
            "fallback is only for --resume: add it, or leave out --fallback.",
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
            f"coordinator is '{coordinator}', but must be HOST:PORT or auto.",
        ),
        (
            processes < 1 or not 0 <= arguments.process_id < processes,
            f"process-id is {arguments.process_id}, but must be at least 0 and below "
            f"num-processes = {processes}.",
        ),
        (
            coordinator == "auto" and (processes, arguments.process_id) != (1, 0),
            "--coordinator auto finds num-processes and process-id itself: leave them out.",
        ),
        (
            coordinator and arguments.devices > 1,
            "--coordinator uses all devices of all processes: leave out --devices.",
        ),
    ):
        if wrong:
            raise errors.UsageError(sentence)


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then loads jax."""
    started = time.perf_counter()
    run(read_arguments(argv), started)


def run(arguments: Arguments, started: float) -> None:
    """Trains the run of checked arguments, and prints where its figures are.

    Args:
      started: time.perf_counter() when the program began.
    """
    config, num_devices = arguments.config, arguments.devices
    arguments.claim.check()
    headless.draw_nothing()
    load = runtime.prepare if arguments.coordinator else runtime.start
    load(config.simulates_in_jax)
    from maxent_jax.runs import driver, hosts  # loads jax

    holding: contextlib.AbstractContextManager[None] = arguments.claim.hold()
    if arguments.coordinator:
        hosts.join(arguments.coordinator, arguments.num_processes, arguments.process_id)
        arguments.claim.check()  # in every process, so that all end if it is not free
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
        training.run_to_end(config, arguments.directory, started, options)
    if hosts.is_first():
        _print_figures(arguments.directory)
        _point_onward(arguments.directory)


def _print_figures(directory: Path) -> None:
    from maxent_jax.visual import plotting

    print(f"figures: {directory / files.FIGURES}/{{{','.join(plotting.NAMES)}}}.png")


def _point_onward(directory: Path) -> None:
    """Prints what a user can type next."""
    what = " ".join(map(shlex.quote, [str(directory), *_imports()]))
    commands = {name: f"{cli.spelled(name)} {what}" for name in ("evaluate", "render", "report")}
    width = max(map(len, commands.values()))
    print("next:")
    for name, command in commands.items():
        print(f"  {command:{width}}  # {cli.COMMANDS[name]}")


def _imports() -> list[str]:
    """The flags that import the same modules."""
    return [word for name in imports.imported for word in ("--import", name)]
