"""Runs the three programs of an iteration one by one, and logs and saves in between."""

import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from maxent_jax import algorithm, components, native
from maxent_jax.algorithm import Programs, State, devices, finetune, methods
from maxent_jax.config import Config
from maxent_jax.errors import UsageError
from maxent_jax.runs import (
    atomic,
    checkpoint,
    files,
    hosts,
    integrity,
    memory,
    runtime,
    source,
)
from maxent_jax.runs.checkpoint import Progress
from maxent_jax.runs.clock import Clock
from maxent_jax.runs.loggers import Sinks
from maxent_jax.runs.progress import Bar, announce, duration, say
from maxent_jax.runs.signals import Interrupted, Interruption
from maxent_jax.runs.stages import Stage, advance, check_finite


class Options(NamedTuple):
    """How a run is executed. Only `num_devices` changes results, by the order of sums."""

    num_devices: int = 1  # devices that share the run; 0: all
    fallback: bool = False  # if the latest checkpoint is damaged, use the one before
    save_iterations: int = 1  # iterations between checkpoints
    save_minutes: float = 10.0  # without a checkpoint, then save between segments
    sinks: Sinks = Sinks()


AS_USUAL = Options()


class Ended(NamedTuple):
    """How a run reached its end."""

    trained: bool  # False: it was complete before
    received: int | None = None  # the signal of the last iteration, too late to stop the run


def check(config: Config, options: Options = AS_USUAL) -> None:
    """Rejects a run that is impossible here, before anything is compiled or written.

    Raises:
      UsageError, ConfigError: a device is missing, or the memory is too small.
    """
    runtime.check_devices()
    memory.check(config, _chosen(options.num_devices))


def train(
    config: Config, directory: Path, process_started: float, options: Options = AS_USUAL
) -> Ended:
    """Trains a run to its end, from its last checkpoint if there is one.

    Args:
      directory: an existing directory, empty or with this run in it.
      process_started: time.perf_counter() when the program began, for the time to the first step.
    Returns:
      Whether there was anything to train, and the signal that arrived in the last iteration.
    Raises:
      UsageError, ConfigError: see `check`; or the run cannot start from its source.
      CheckpointCorruptError: the last checkpoint is damaged.
      SaveError: a file cannot be written.
      NonFiniteError: training produced a number that is not finite.
      Interrupted: a signal arrived, and the run is saved.
    """
    runtime.prepare(config.simulates_in_jax)
    check(config, options)
    placed = _placement(config, options.num_devices)
    hosts.first_alone(lambda: integrity.clear_unfinished(directory), "clear")
    progress = _last_progress(directory, options)
    if progress is not None and len(progress.rows) == config.budget.num_iterations:
        hosts.leave()
        if hosts.is_first():
            print(f"{directory} is complete: nothing to train.")
        return Ended(trained=False)
    if progress is None:  # a run that continues no longer needs its source
        source.check(config)
    if hosts.is_first():
        announce(config, directory, 0 if progress is None else len(progress.rows))
    if progress is None:
        stage = _fresh(config, directory, placed)
    else:
        stage = Stage(checkpoint.restore(directory, progress.name, config, placed), progress)
    programs = algorithm.programs(config) if placed is None else devices.programs(config, placed)
    rows, received = _train(config, directory, programs, stage, process_started, options)
    hosts.leave()
    if hosts.is_first():
        _summarise(config, directory, rows)
    return Ended(trained=True, received=received)


def _chosen(num_devices: int) -> list[jax.Device]:
    """The first `num_devices` devices; 0: all."""
    available = jax.devices()
    if num_devices > len(available):
        raise UsageError(f"devices is {num_devices}, but only {len(available)} are available.")
    return available[: num_devices or None]


def _placement(config: Config, num_devices: int) -> State | None:
    """Placement of the state on `num_devices` devices (0: all); None for one device."""
    chosen = _chosen(num_devices)
    if len(chosen) == 1:
        return None
    return devices.placement(config, devices.make_mesh(config, chosen))


def _fresh(config: Config, directory: Path, placed: State | None) -> Stage:
    def write() -> None:
        machine = {"backend": components.make(config).env.backend} | _machine()
        files.write_config(directory, config, _method_in_words(config), machine)
        files.write_metrics(directory, [])

    hosts.first_alone(write, "config")
    if config.downstream.source:
        state = _from_source(config, directory, placed)
    else:
        state = algorithm.start(config) if placed is None else devices.start(config, placed)
    return Stage(state, Progress([], None, [], {}))


def _from_source(config: Config, directory: Path, placed: State | None) -> State:
    """The first state of a run that starts from another; writes what its first episodes found."""
    archive, name = source.load(config)
    state, first = finetune.start(config, archive)
    found = {"source": config.downstream.source, "checkpoint": name} | first._asdict()
    hosts.first_alone(lambda: atomic.write_json(directory / files.FIRST, found), "first episodes")
    return state if placed is None else jax.device_put(state, placed)


def _method_in_words(config: Config) -> dict[str, Any]:
    row = methods.row(config)
    return {name: getattr(row, name) for name in row._fields if name != "settings"}


def _last_progress(directory: Path, options: Options) -> Progress | None:
    """Progress of the checkpoint to continue from, if any; resets the metrics to it."""
    if not integrity.checkpoints(directory):
        return None
    remedy = "the command train --resume --fallback removes it, and uses the one before"
    name, passed_over = integrity.find(directory, fallback=options.fallback, remedy=remedy)
    progress, computed_with = checkpoint.read_progress(directory, name)

    def go_back_to_it() -> None:
        for damaged, sentence in passed_over.items():
            integrity.remove(directory, damaged)
            say(f"note: {sentence[:-1]}; it is removed, the run continues from checkpoint {name}.")
        for what, now in (files.stack() | _machine()).items():
            if computed_with.get(what) != now:
                say(
                    f"note: {what} was {computed_with.get(what)} and is now {now}: from here on, "
                    f"the run may not be bit-identical to an uninterrupted one."
                )
        files.write_metrics(directory, progress.rows)

    hosts.first_alone(go_back_to_it, "resumed")
    return progress


def _machine() -> dict[str, Any]:
    """What bit-identical results depend on in addition to the software, such as the processor."""
    return {
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "cpu_cores": os.cpu_count(),
        "native": native.variant(),
    }


def _train(
    config: Config,
    directory: Path,
    programs: Programs,
    stage: Stage,
    process_started: float,
    options: Options,
) -> tuple[list[dict[str, Any]], int | None]:
    """Trains the remaining iterations; returns the rows of all of them, and `Ended.received`."""
    state, progress = stage
    done = len(progress.rows)
    clock = Clock(process_started, progress.clock)
    bar = Bar(config, done, len(progress.segments), progress.rows[-1] if done else {})
    sinks = options.sinks if hosts.is_first() else Sinks()
    saved_at = time.perf_counter()
    with Interruption() as interruption, sinks.open(directory, config, done) as pass_on, bar:
        compiling_since = time.perf_counter()
        programs = algorithm.compiled(config, programs)
        clock.compiled(compiling_since)
        while done < config.budget.num_iterations:
            state, progress = advance(config, programs, state, progress, clock, bar)
            check_finite(directory, state, progress)
            done = len(progress.rows)
            iteration_ended = progress.begun is None
            if iteration_ended:
                if hosts.is_first():
                    files.append_metrics(directory, progress.rows[-1])
                pass_on(progress.rows[-1])
            due = (
                time.perf_counter() - saved_at >= 60 * options.save_minutes
                or (iteration_ended and done % options.save_iterations == 0)
                or done == config.budget.num_iterations
            )
            received, saves = hosts.largest(interruption.received or 0, int(due))
            if received or saves:
                saved_at = time.perf_counter()
                timed = progress._replace(clock=clock.seconds())
                checkpoint.save(directory, state, timed, _machine())
                clock.saved(saved_at)
            if received and done < config.budget.num_iterations:
                raise Interrupted(received, directory)
    return progress.rows, interruption.received


def _summarise(config: Config, directory: Path, rows: list[dict[str, Any]]) -> None:
    last = rows[-1]
    cells = components.make(config).grid.num_cells
    random = ""
    if "random_coverage" in last:
        random = f" (a random policy: {np.mean(last['random_coverage']):,.0f})"
    played = np.count_nonzero(np.atleast_2d(last["mixture_weights"])[0])
    who = "the last policy" if played == 1 else f"the mixture of {played} policies"
    print(
        f"{directory}: training visited {np.mean(last['cumulative_coverage']):,.0f} of {cells:,} "
        f"cells{random}; {who} "
        f"visits {np.mean(last['mixture_coverage']):,.0f} cells; {duration(last['wall_seconds'])}."
    )
