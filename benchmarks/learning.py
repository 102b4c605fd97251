"""Which settings take Ant farthest? Preset `quick` with one change at a time.

Each run is the command `train` in its own process, with its share of the cores. As soon as it ends,
its row is written to the file given by --out. Runs whose row is already there are skipped; a file
with rows of other settings is refused.
"""

import json
import os
import queue
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from benchmarks import common
from maxent_jax.config import preset
from maxent_jax.runs import atomic, files

# The changes of each regime to the preset.
REGIMES: dict[str, dict[str, Any]] = {
    "quick": {},
    "one-step returns": {"return_steps": 1},
    "five-step returns": {"return_steps": 5},
    "eight-step returns": {"return_steps": 8},
    "linear reward": {"reward": "linear"},
    "log1p, c = 5 m": {"reward_distance": 5.0, "reward_scale": 2.0},
    "log reward": {"reward": "log"},
    "p log R": {"reward": "paper", "reward_scale": 1.0},
    "potential in all features": {"shaping_space": "features"},
    "shaping survives death": {"shaping_survives_death": True},
    "SAC's entropy term": {"lagrangian_entropy": False},
    "inputs normalized": {"normalize_inputs": True},
    "the actor averaged": {"actor_average": 1e-3},
    "three snapshots": {"snapshots": 3},
    "no shaping": {"shaping": 0.0},
    "full torque": {"torque_limit": 1.0},
    "episodes go on upside down": {"end_flipped": False},
    "full torque, upside down": {"torque_limit": 1.0, "end_flipped": False},
    "plain state": {"policy_inputs": "state", "yaw_copies": 0},
    "no yaw copies": {"yaw_copies": 0},
    "three yaw copies": {"yaw_copies": 3},
    "no layer norm": {"critic_layer_norm": False},
    "temperature goes on": {"restart_temperature": False},
    "rate 3e-4": {"learning_rate": 3e-4},
    "batch 256": {"batch_size": 256},
    "2 x 256": {"hidden_size": 256},
    "twice the gradient steps, half the iterations": {
        "updates_per_step": 0.25,
        "num_iterations": 6,
    },
    "32 envs, half the env steps": {
        "num_envs": 32,
        "updates_per_step": 0.25,
        "steps_per_iteration": 60_000,
        "replay_size": 120_000,
    },
    "128 envs, twice the env steps": {
        "num_envs": 128,
        "updates_per_step": 0.0625,
        "steps_per_iteration": 240_000,
        "replay_size": 480_000,
    },
    "episodes of 500": {"episode_length": 500},
    "discount 0.98": {"discount": 0.98, "shaping": 50.0, "reward_scale": 16.0},
    "episodic term 0.1": {"episodic_weight": 0.1},
    "starts from the last": {"start": "last"},
    "starts from scratch": {"start": "scratch"},
    "as in the paper": {
        "torque_limit": 1.0,
        "end_flipped": False,
        "reward": "paper",
        "reward_scale": 1.0,
        "shaping": 0.0,
        "policy_inputs": "state",
        "yaw_copies": 0,
        "return_steps": 1,
    },
    "a plateau ends an iteration": {"plateau_segments": 4},
}
KEPT = (
    *("cumulative_coverage", "cumulative_entropy", "random_coverage", "mixture_coverage"),
    *("mixture_entropy", "cumulative_off_grid_share", "flipped_share", "segments_trained"),
    *("env_steps", "gradient_steps", "wall_seconds", "wall_train_total"),
)


def run(name: str, seed: int, base: dict[str, Any], cores: set[int]) -> dict[str, Any]:
    """Runs a regime and returns its row, with the results after each iteration."""
    flags: list[str] = []
    for field, value in (REGIMES[name] | base | {"seed": seed}).items():
        flag = field.replace("_", "-")
        if isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            flags += [f"--{flag}", str(value)]
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, "-m", "experiments.train", *flags, "--out", folder],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if hasattr(os, "sched_setaffinity"):  # threads that start later inherit it
            os.sched_setaffinity(process.pid, cores)
        _, errors = process.communicate()
        if process.returncode != 0:
            raise RuntimeError(f"{name}, seed {seed}: {errors}")
        rows = files.read_metrics(Path(folder))
    columns = {key: [row[key] for row in rows] for key in KEPT if key in rows[-1]}
    changes = REGIMES[name]
    return {"benchmark": "learning", "regime": name, "changes": changes, "seed": seed} | columns


def held_by(out: Path, base: dict[str, Any]) -> dict[str, Any] | None:
    """Returns the content of --out, without rows if it is new; None if its settings were others."""
    # All of the preset's: it may have changed since.
    settings = atomic.jsonable(preset(base["preset"], **base).flat())
    if not out.exists():
        return {"base": settings, "rows": []}
    held = json.loads(out.read_text(encoding="utf-8"))
    same = held.get("base") == settings
    same = same and all(row["changes"] == REGIMES.get(row["regime"]) for row in held["rows"])
    return held if same else None


def study(names, seeds, base, jobs: int, out: Path, held) -> Iterator[dict[str, Any]]:
    """Yields rows as runs end, `jobs` runs in parallel; writes each row before it yields it."""
    done = held["rows"]
    missing = [
        (name, seed)
        for name in names
        for seed in seeds
        if not any((row["regime"], row["seed"]) == (name, seed) for row in done)
    ]
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    shares: queue.Queue[set[int]] = queue.Queue()
    for job in range(jobs):
        shares.put(set(available[job::jobs]) or set(available))

    def next_run(name, seed):
        cores = shares.get()
        try:
            return run(name, seed, base, cores)
        finally:
            shares.put(cores)

    failed = 0
    with ThreadPoolExecutor(jobs) as pool:
        for future in as_completed(pool.submit(next_run, *which) for which in missing):
            if future.exception() is not None:
                print(f"failed: {future.exception()}", file=sys.stderr)
                failed += 1
                continue
            row = future.result()
            done.append(row)
            atomic.write_json(out, held)
            yield row
    if failed:
        raise RuntimeError(f"{failed} runs failed; the rows of the others are in {out}")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws the cells after the last iteration, a dot per seed, best regime on top; and curves."""
    regimes = {row["regime"] for row in rows}
    of_regime = {name: [r for r in rows if r["regime"] == name] for name in regimes}
    ranked = sorted(
        regimes, key=lambda name: np.mean([r["cumulative_coverage"][-1] for r in of_regime[name]])
    )
    figure = Figure(figsize=(11, 1.2 + 0.3 * max(len(ranked), 6)), layout="constrained")
    dots, curves = figure.subplots(1, 2, width_ratios=(1, 1))
    colors = colormaps["viridis"](np.linspace(0.05, 0.9, len(ranked)))
    for place, (name, color) in enumerate(zip(ranked, colors, strict=True)):
        for row in of_regime[name]:
            cells = row["cumulative_coverage"]
            dots.plot(cells[-1], place, "o", color=color)
            curves.plot(np.array(row["gradient_steps"]) / 1000, cells, "-o", color=color, ms=3)
    dots.set_yticks(range(len(ranked)), ranked)
    dots.set_xlabel("cells visited in training, of 10,000")
    curves.set_xlabel("thousand gradient steps")
    for axes in (dots, curves):
        axes.grid(alpha=0.25)
    dots.set_xlim(left=0)
    curves.set_ylim(bottom=0)
    figure.savefig(path, dpi=110)


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--regimes", nargs="*", choices=list(REGIMES), default=list(REGIMES))
    flags.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    flags.add_argument("--iterations", type=int, help="of each run; the preset's by default")
    flags.add_argument("--jobs", type=int, default=common.CORES, help="number of parallel runs")
    flags.add_argument("--out", type=Path, default=Path("results/learning.json"))
    args = flags.parse_args()
    common.print_versions()
    base: dict[str, Any] = {"preset": "quick", "random_baseline": False}
    if args.iterations:
        base["num_iterations"] = args.iterations
    if args.toy:
        base = {"preset": "smoke", "env": "pendulum"}
        args.regimes, args.seeds = ["linear reward"], [0]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "toy.json" if args.toy else args.out
        held = held_by(out, base)
        if held is None:
            flags.error(f"{out} holds rows of other settings: choose another --out.")
        out.parent.mkdir(parents=True, exist_ok=True)
        for row in study(args.regimes, args.seeds, base, args.jobs, out, held):
            common.emit(row)
        draw(held["rows"], out.with_suffix(".png"))


if __name__ == "__main__":
    main()
