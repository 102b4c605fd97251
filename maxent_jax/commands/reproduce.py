"""Reproduces the paper's figures, corrected, and runs the ablations that its readers asked for.

A study's directory holds study.json, a run for each cell and, once all cells are finished, raw.csv,
summary.json and the figure. A study that was stopped and is started again resumes the unfinished
cells. Several processes, or jobs of a SLURM cluster, can share a directory; machines without a
shared disk can share the cells.
"""

import dataclasses
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from maxent_jax import errors, training
from maxent_jax.checks import check_choice
from maxent_jax.commands import cli, launcher
from maxent_jax.runs import files, locks, runtime
from maxent_jax.runs.claim import Claim
from maxent_jax.runs.signals import Interrupted, heeded
from maxent_jax.studies import disk, protocol
from maxent_jax.studies.protocol import Cell
from maxent_jax.visual import headless

if TYPE_CHECKING:
    import submitit

# The studies from which each figure of the paper is made. The other half of Fig. 3, weights on Ant,
# is the study `weights`: on a CPU it takes longer than all the others.
FIGURES: dict[str, tuple[str, ...]] = {
    "fig2": (),
    "fig3": (),
    "fig4": ("fig4",),
    "fig5": ("fig4",),
}
POLL_SECONDS = 60  # NFS may show a directory as it was that long ago
JOBS = "jobs"  # in --out: what submitit writes


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Reproduce a figure of the paper, or run a study."""

    what: Annotated[str, tyro.conf.Positional]
    """fig2, fig3, fig4, fig5, all (these four), or the name of a study."""
    scale: str = "cpu"
    """toy (a quick check), cpu (two cores), or paper (the paper's settings, accelerators)."""
    out: Path = Path("studies")
    """Folder with a directory for each study and figure."""
    seeds: int | None = None
    """Seeds of each method; if left out, as many as the scale says."""
    jobs: int = 1
    """Processes that share the cells and the cores of this machine."""
    shard: str = "0/1"
    """I/N: train only the cells I, I + N, I + 2N, ..., and those that start from them; for job
    arrays."""
    figures: bool = True
    """Draw the figures once all cells are finished."""
    launcher: str = "local"
    """local (train here), or submitit (submit jobs to a SLURM cluster; needs the extra slurm)."""
    num_workers: int = 1
    """Jobs of --launcher submitit, which share the cells."""
    slurm: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Settings of sbatch for each job: time=MINUTES, partition, cpus_per_task, gpus_per_node, mem,
    account, ..."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then trains."""
    arguments = cli.parse(Arguments, argv, "reproduce")
    index, count = _check(arguments)
    submits = arguments.launcher == "submitit"
    executor = launcher.slurm(arguments.out / JOBS, arguments.slurm) if submits else None
    whats = tuple(FIGURES) if arguments.what == "all" else (arguments.what,)
    names = dict.fromkeys(name for what in whats for name in FIGURES.get(what, (what,)))
    studies = {name: protocol.make(name, arguments.scale, arguments.seeds) for name in names}
    headless.draw_nothing()
    if "fig3" in whats:
        runtime.prepare(simulates_in_jax=False)
        from maxent_jax.studies import hazan_weights  # loads jax

        hazan_weights.held(arguments.out / "fig3", arguments.scale, arguments.seeds)
    for name, cells in studies.items():
        disk.claim(arguments.out / name, name, arguments.scale, cells)
    for what in whats:
        with locks.holding(arguments.out / what):  # fails here rather than after hours of work
            pass
    if executor is not None:
        _submit(arguments, executor, studies)
        return
    if studies and arguments.jobs > 1:
        _share(arguments)
    else:
        failures = sum(
            _train(arguments.out / name, protocol.share(cells, index, count))
            for name, cells in studies.items()
        )
        if failures:
            sys.exit(1)
    left = _unfinished(arguments.out, studies)
    if left and arguments.figures:
        print(f"no figures yet: {len(left)} cells are not finished, the first is {left[0]}.")
    elif arguments.figures:
        from maxent_jax.studies import results  # loads jax

        runtime.start(simulates_in_jax=False)
        results.draw(whats, arguments.scale, arguments.seeds, arguments.out, studies)


def _check(arguments: Arguments) -> tuple[int, int]:
    """Returns the shard, as index and count."""
    check_choice("study", arguments.what, ("all", *FIGURES, *protocol.STUDIES))
    check_choice("scale", arguments.scale, protocol.SCALES)
    if arguments.seeds is not None and arguments.seeds < 1:
        raise errors.UsageError(f"seeds is {arguments.seeds}, but a study needs at least 1.")
    if arguments.jobs < 1:
        raise errors.UsageError(f"jobs is {arguments.jobs}, but must be at least 1.")
    _check_launcher(arguments)
    shard = re.fullmatch(r"([0-9]+)/([0-9]+)", arguments.shard)
    if shard is None or int(shard[1]) >= int(shard[2]):
        raise errors.UsageError(f"shard is {arguments.shard}, but must be I/N with 0 <= I < N.")
    if FIGURES.get(arguments.what) == () and (not arguments.figures or int(shard[2]) > 1):
        raise errors.UsageError(
            f"{arguments.what} has no cells to share: leave out --shard and --no-figures."
        )
    if arguments.out.is_file():
        raise errors.UsageError(f"out is {arguments.out}, but this is a file: name a folder.")
    return int(shard[1]), int(shard[2])


def _check_launcher(arguments: Arguments) -> None:
    check_choice("launcher", arguments.launcher, ("local", "submitit"))
    if arguments.num_workers < 1:
        raise errors.UsageError(f"num-workers is {arguments.num_workers}, but must be at least 1.")
    if arguments.launcher == "local":
        if arguments.num_workers > 1 or arguments.slurm:
            raise errors.UsageError("num-workers and slurm are for --launcher submitit: add it.")
    elif arguments.jobs > 1:
        raise errors.UsageError(
            "jobs is for the cores of this machine: leave it out, or leave out --launcher."
        )
    elif FIGURES.get(arguments.what) == ():
        raise errors.UsageError(f"{arguments.what} has no cells to share: leave out --launcher.")


def _unfinished(out: Path, studies: Mapping[str, Sequence[Cell]]) -> list[str]:
    """The names of the cells that are not finished."""
    return [
        f"{name}/{cell.name}"
        for name, cells in studies.items()
        for cell in cells
        if not disk.finished(out / name, cell)
    ]


def _train(directory: Path, cells: Sequence[Cell]) -> int:
    """Trains the unfinished cells that no other process trains; returns how many failed.

    Cells that start from another one wait until that is finished, by this process or another. A
    cell whose process dies meanwhile is resumed.
    """
    failures, left = 0, cells
    while True:
        now, left, busy, trained = left, [], [], False
        for cell in now:
            try:
                if cell.source and not disk.finished(directory, cell.source):
                    left.append(cell)
                else:
                    trained |= _train_cell(directory, cell)
            except locks.BusyError:
                busy.append(cell)
            except (errors.RunError, errors.NonFiniteError) as error:
                print(f"error: {error} Continuing with the next cell.", file=sys.stderr)
                failures += 1
        if not trained:
            if not any(cell.source in busy for cell in left):
                return failures
            time.sleep(POLL_SECONDS)
        left += busy


def _train_cell(directory: Path, cell: Cell) -> bool:
    """Trains the cell's run to its end; returns whether there was anything left to do."""
    started = time.perf_counter()
    if disk.finished(directory, cell):
        return False
    at, config = disk.home(directory, cell), disk.config_of(directory, cell)
    runtime.prepare(config.simulates_in_jax)
    with Claim(at, config, resume=True).hold():
        from maxent_jax.runs import driver  # loads jax

        received = training.run_to_end(config, at, started, driver.Options(fallback=True))
    if received is not None:
        raise Interrupted(received, at)
    return True


def _worker(arguments: Arguments) -> list[str]:
    """The arguments of a process that trains its part of the cells and draws nothing."""
    return [arguments.what, "--no-figures", *_given(arguments, "scale", "out", "seeds", "shard")]


def _given(arguments: Arguments, *names: str) -> list[str]:
    values = {name: getattr(arguments, name) for name in names}
    return [
        word
        for name, value in values.items()
        if value is not None
        for word in (f"--{name}", str(value))
    ]


def _submit(
    arguments: Arguments,
    executor: "submitit.SlurmExecutor",
    studies: Mapping[str, Sequence[Cell]],
) -> None:
    """Submits the workers; prints where their logs are, and what a user can type next."""
    total, left = sum(map(len, studies.values())), len(_unfinished(arguments.out, studies))
    here = [arguments.what, *_given(arguments, "scale", "out", "seeds")]
    draw = f"{cli.spelled('reproduce')} {shlex.join(here)}"
    if not left:
        print(f"all {total} cells are finished, so no job is submitted. The figures: {draw}")
        return
    jobs = launcher.submit(executor, _worker(arguments), arguments.num_workers)
    job = jobs[0].job_id.split("_")[0]
    rows = [f"{shlex.quote(str(arguments.out / name))}/*/{files.METRICS}" for name in studies]
    print(f"submitted job {job}: {arguments.num_workers} workers for {left} of {total} cells")
    print(f"logs: {arguments.out / JOBS}/{job}_*.out")
    print("next:")
    print(f"  squeue --jobs {job}")
    print(f"  wc -l {' '.join(rows)}  # iterations of each cell")
    print(f"  {draw}  # the figures, once all cells are finished")


def _share(arguments: Arguments) -> None:
    """Runs the jobs as processes, each on its share of the cores; passes signals on to them."""
    command = [sys.executable, "-m", "maxent_jax", "reproduce", *_worker(arguments)]
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    processes: list[subprocess.Popen[bytes]] = []

    def tell(number: int, _: object) -> None:
        for process in processes:
            process.send_signal(number)

    handlers = {number: signal.signal(number, tell) for number in heeded()}
    try:
        for i in range(arguments.jobs):
            # In its own process group, so that Ctrl-C reaches it only once.
            processes.append(subprocess.Popen(command, process_group=0))
            if cores:  # before it starts threads, which inherit the affinity
                os.sched_setaffinity(processes[-1].pid, cores[i :: arguments.jobs] or cores)
        codes = [process.wait() for process in processes]
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    worst = max(code if code >= 0 else 128 - code for code in codes)
    if worst:
        print(
            f"error: {sum(map(bool, codes))} of {len(codes)} jobs did not finish: see above.",
            file=sys.stderr,
        )
        sys.exit(worst)
