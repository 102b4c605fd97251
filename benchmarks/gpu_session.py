"""All that needs a GPU, in parts of at most eight minutes, each with its results in one folder.

A part is a few commands of this repository, run one after another in processes of their own; each
leaves NAME.json (its rows, its seconds, what it printed besides) as soon as it ends, also when it
failed or ran out of time, and is left out when called again. No network is needed.
"""

import argparse
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from maxent_jax import load_run, plotting, runs

NUM_SEEDS = 3


class Command(NamedTuple):
    """A module of this repository with its flags, at full size and at toy size."""

    name: str
    arguments: tuple[str, ...]
    toy: tuple[str, ...]


def benchmark(name: str, module: str, *flags: str) -> Command:
    """A benchmark; its toy size is its own."""
    command = f"benchmarks.{module}"
    return Command(name, (command, *flags), (command, "--toy", "--repeats", "1"))


def train(name: str, *flags: str) -> Command:
    """A run of MaxEnt-V, whose directory lies among the session's other large files."""
    command = ("experiments.train", "--resume", "--out", f"{{work}}/{name}")
    toy = ("--preset", "smoke", "--env", "pendulum", "--num-seeds", "2")
    return Command(name, (*command, *flags), (*command, *toy))


def env_throughput(env: str) -> Command:
    """MJX and Warp at batches that fill a GPU, beside C MuJoCo on the host's cores."""
    mjx = ("--mjx-physics", "fast", "--mjx-envs", "2048", "8192")
    others = ("--mujoco-envs", "1024", "--warp-envs", "2048", "--no-peers", "--repeats", "3")
    return benchmark(f"envs_{env}", "envs", "--env", env, *mjx, *others)


class Part(NamedTuple):
    """Commands that share a limit of time."""

    seconds: float
    commands: tuple[Command, ...]


# At most eight minutes each, and under 25 in all. Predictions were written before any GPU was at
# hand: see docs/gpu.md.
PARTS = {
    "envs": Part(420, tuple(env_throughput(env) for env in ("ant", "walker2d", "humanoid"))),
    "knn": Part(120, (benchmark("knn", "knn", "--repeats", "3"),)),
    "sac": Part(120, (benchmark("sac", "sac", "--repeats", "3"),)),
    "seeds": Part(
        330,
        (
            benchmark(
                "seeds", "seeds", "--preset", "gpu", "--num-envs", "128", "--batch-size", "256"
            ),
            benchmark("compile_time", "compile_time", "--preset", "gpu", "--repeats", "1"),
        ),
    ),
    "train": Part(
        480,
        (train("ant", "--preset", "gpu", "--num-seeds", str(NUM_SEEDS), "--num-iterations", "10"),),
    ),
}


def run_command(command: Command, work: Path, toy: bool, seconds: float) -> dict[str, Any]:
    """What the command left: its rows, how long it took, how it ended."""
    arguments = [word.format(work=work) for word in (command.toy if toy else command.arguments)]
    started = time.perf_counter()
    log = work / f"{command.name}.log"
    with open(log, "w", encoding="utf-8") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,  # so that its children end with it
        )
        try:
            printed, _ = process.communicate(timeout=max(seconds, 1))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            printed, _ = process.communicate()
    lines = printed.splitlines()
    return {
        "command": ["python", "-m", *arguments],
        "exit_code": process.returncode,  # below 0: ended by a signal, as where time ran out
        "seconds": time.perf_counter() - started,
        "rows": [json.loads(line) for line in lines if line.startswith("{")],
        "notes": [line for line in lines if not line.startswith("{")],
        "log_tail": log.read_text(encoding="utf-8").splitlines()[-40:],
    }


def collect(run_directory: Path, out: Path, episodes_per_policy: int) -> None:
    """What analysis needs of a run, without its checkpoints; and the paths of its policies."""
    for path in (runs.CONFIG, runs.METRICS, *(f"{runs.FIGURES}/{x}.png" for x in plotting.NAMES)):
        source = run_directory / path
        shutil.copyfile(source, out / f"{run_directory.name}_{source.name}")
    paths = [
        load_run(run_directory, index).rollout(episodes_per_policy)
        for index in range(runs.read_config(run_directory).num_seeds)
    ]
    named = {
        f"seed_{index}_{name}": values
        for index, of_seed in enumerate(paths)
        for name, values in of_seed._asdict().items()
    }
    np.savez_compressed(out / f"{run_directory.name}_states.npz", **named)


def run_part(name: str, out: Path, work: Path, toy: bool) -> bool:
    """Whether all of the part's commands have succeeded, now or before."""
    deadline = time.perf_counter() + PARTS[name].seconds
    succeeded = True
    for command in PARTS[name].commands:
        path = out / f"{command.name}.json"
        if path.exists() and json.loads(path.read_text(encoding="utf-8"))["exit_code"] == 0:
            continue
        found = run_command(command, work, toy, deadline - time.perf_counter())
        if (work / command.name / runs.METRICS).exists() and found["exit_code"] == 0:
            # In a process of its own: this one must not hold the accelerator's memory.
            arguments = (work / command.name, out, 1 if toy else 3)
            alone = multiprocessing.get_context("spawn").Process(target=collect, args=arguments)
            alone.start()
            alone.join()
            found["exit_code"] = alone.exitcode
        runs.write_json(path, found)
        print(
            f"{command.name}: exit {found['exit_code']} after {found['seconds']:.0f} s", flush=True
        )
        succeeded &= found["exit_code"] == 0
    return succeeded


def main() -> None:
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--part", nargs="*", choices=list(PARTS), default=list(PARTS))
    flags.add_argument("--out", type=Path, default=Path("results/gpu"), help="of the results")
    flags.add_argument(
        "--work", type=Path, default=Path("runs/gpu"), help="of checkpoints and logs"
    )
    flags.add_argument("--toy", action="store_true", help="does it run? tiny sizes, no figures")
    args = flags.parse_args()
    for folder in (args.out, args.work):
        folder.mkdir(parents=True, exist_ok=True)
    succeeded = [run_part(name, args.out, args.work, args.toy) for name in args.part]
    sys.exit(0 if all(succeeded) else 1)


if __name__ == "__main__":
    main()
