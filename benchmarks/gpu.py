"""What does a GPU make of it? Two parts of at most five minutes each, the most valuable first.

`--part first`: the device; nearest neighbours; Ant's env steps; MaxEnt-V on Ant, end to end, as the
command `train`. `--part second`: Walker2d and Humanoid; gradient steps, one seed and eight side by
side; MJX beside C MuJoCo; the longest kernels of training. All programs of a part are compiled at
the same time, and what they took is said apart. A row joins OUT/PART.jsonl as soon as it is
measured: when its time is up a part ends where it is, with the rows that it has. No network is
needed.
"""

import argparse
import contextlib
import functools
import gzip
import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import benchmarks.envs
from benchmarks import common, knn, sac
from maxent_jax import algorithm, envs, native
from maxent_jax.algorithm.experience import Reference
from maxent_jax.config import Config, preset
from maxent_jax.envs import base
from maxent_jax.runs import files, runtime

SECONDS = 300.0  # of a part
PACKING = 5.0  # seconds of these, to pack what there is
EVALUATION = 0.2  # share of these, to stop the run and to play its policies on the host
NOT_PACKED = {"checkpoints", "trace"}
ENVS = (4096, 16_384)
RATE_STEPS = 20  # of each environment, in one program
KNN_SIZES = ((100_000, 100_000), (64, 65_536))  # queries, points
KNN_STEPS = 100  # of a scan
BATCHES, SEEDS = (256, 4096), (1, 8)
UPDATES = 100
TRACE_STEPS = 2  # vector steps of training in the trace
NUM_KERNELS = 10

Row = dict[str, Any]
# A section begins to compile what it needs when it is called; what it returns measures.
Measure = Callable[[], Iterator[Row]]


class Session(NamedTuple):
    """What the sections of a part share."""

    toy: bool
    deadline: float  # time.monotonic()
    work: Path
    compilers: ThreadPoolExecutor
    running: list[subprocess.Popen]  # runs of training beside this process

    def compile(self, name: str, function: Callable, *args: Any) -> "Future[Compiled]":
        """Begins at once, beside all others."""
        return self.compilers.submit(_compile, name, function, *args)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Holds the runs beside this process, which compile meanwhile, while something is timed."""
        alive = [run for run in self.running if run.poll() is None]
        for run in alive:
            run.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            for run in alive:
                run.send_signal(signal.SIGCONT)


class Compiled(NamedTuple):
    """A program, and what it took to have it."""

    call: Callable
    row: Row


def _compile(name: str, function: Callable, *args: Any) -> Compiled:
    started = time.perf_counter()
    lowered = jax.jit(function).lower(*args)
    traced = time.perf_counter()
    program = lowered.compile()
    row = {
        "section": "compiled",
        "program": name,
        "programs": 1,
        "trace_seconds": traced - started,
        "compile_seconds": time.perf_counter() - traced,
    }
    memory = program.memory_analysis()
    if memory is not None:  # not every backend knows
        row["temporary_gigabytes"] = memory.temp_size_in_bytes / 1e9
    return Compiled(program, row)


def device(session: Session) -> Measure:
    """Versions and memory, what a large matmul reaches, and whether it rounds its factors."""

    def measure() -> Iterator[Row]:
        common.print_versions()
        third = jnp.full((256, 256), 1 / 3)
        product = jax.jit(lambda x: x @ x)(third)
        yield {
            "section": "device",
            "kind": jax.devices()[0].device_kind,
            "devices": jax.device_count(),
            "cpu_cores": common.CORES,
            "memory_gigabytes": (jax.devices()[0].memory_stats() or {}).get("bytes_limit", 0) / 1e9,
            "tflop_per_second": sac.peak_flops(256 if session.toy else 8192, repeats=3) / 1e12,
            "matmul_relative_error": float(abs(product[0, 0] / (256 / 9) - 1)),  # above 1e-5: TF32
        }

    return measure


def neighbors(session: Session) -> Measure:
    """Ours, in XLA and where it was built in CUDA, beside the expanded square with top_k."""

    def scan(search, queries, points):
        step = lambda carry, queries: (carry, search(queries, points))
        return jax.lax.scan(step, None, queries)[1]

    searches = {"maxent_jax": knn.ours, "jax.lax.top_k": knn.top_k}
    if native.cuda() and jax.default_backend() == "gpu":
        searches["maxent_jax in CUDA"] = knn.in_cuda
    programs = []
    for num_queries, num_points in ((64, 512),) if session.toy else KNN_SIZES:
        num_sets = 1 if num_queries == num_points or session.toy else KNN_STEPS
        rows = jnp.asarray(knn.gaussian(num_sets * num_queries + num_points))
        queries = rows[: num_sets * num_queries].reshape(num_sets, num_queries, -1)
        points = rows[-num_points:]
        for who, search in searches.items():
            # All squares of the large problem would take 40 GB: what one writes first, in parts.
            parted = queries
            if search is knn.top_k and num_sets == 1 and num_queries > 1000:
                parted = queries.reshape(-1, 1000, queries.shape[-1])
            function = lambda q, p, search=search: scan(search, q, p)
            name = f"kNN {num_queries:,} x {num_points:,}, {who}"
            program = session.compile(name, function, parted, points)
            programs.append((who, num_queries, num_sets, (parted, points), program))

    def measure() -> Iterator[Row]:
        reference: dict[int, float] = {}
        for who, num_queries, num_sets, inputs, future in programs:
            program = future.result()
            yield program.row
            with session.alone():
                call = functools.partial(program.call, *inputs)
                seconds = common.median_seconds(call, 1 if session.toy else 3)
            pairs = num_queries * num_sets * len(inputs[1])
            reference.setdefault(num_queries, seconds)
            yield {
                "section": "kNN",
                "who": who,
                "queries": num_queries,
                "points": len(inputs[1]),
                "steps": num_sets,
                "tpair_per_second": pairs / seconds / 1e12,
                "ours_over_this": seconds / reference[num_queries],
            }

    return measure


def torch_seconds(torch: Any, queries: np.ndarray, points: np.ndarray) -> float:
    """Of a search by cdist and topk, the best of three."""
    where = "cuda" if torch.cuda.is_available() else "cpu"
    queries, points = (torch.from_numpy(x).to(where) for x in (queries, points))
    seconds = []
    for _ in range(4):
        started = time.perf_counter()
        torch.cdist(queries, points).topk(knn.NUM_NEIGHBORS, largest=False).values.cpu()  # waits
        seconds.append(time.perf_counter() - started)
    return min(seconds[1:])


PEERS = (common.Peer("torch", "torch", torch_seconds),)


def peers(session: Session) -> Measure:
    """What users of a GPU have at hand."""
    num_queries, num_points = (64, 512) if session.toy else (4096, 65_536)

    def measure() -> Iterator[Row]:
        rows = knn.gaussian(num_queries + num_points)
        for peer, module in common.importable(PEERS):
            seconds = common.measured(
                peer, peer.measure, module, rows[:num_queries], rows[num_queries:]
            )
            if seconds is not None:
                yield {
                    "section": "kNN",
                    "who": f"{peer.distribution}, cdist and topk",
                    "queries": num_queries,
                    "points": num_points,
                    "steps": 1,
                    "tpair_per_second": num_queries * num_points / seconds / 1e12,
                }

    return measure


def env_steps(names: tuple[str, ...], sizes: tuple[int, ...], session: Session) -> Measure:
    """Env steps a second under random actions, episodes started anew as in training."""
    chosen = [("pendulum", 8)] if session.toy else [(n, s) for n in names for s in sizes]
    programs = []
    for name, num_envs in chosen:
        env = envs.make(name) if session.toy else envs.make(name, "mjx", "fast")

        def run(episodes, key, env=env, num_envs=num_envs):
            def step(carry, key):
                episodes, ends = carry
                key_act, key_env = jax.random.split(key)
                shape = (num_envs, env.action_size)
                action = jax.random.uniform(key_act, shape, minval=-1, maxval=1)
                episodes, seen = base.step(
                    env, episodes, action, Config.environment.episode_length, key_env
                )
                return (episodes, ends + seen.terminated.sum()), None

            keys = jax.random.split(key, RATE_STEPS)
            return jax.lax.scan(step, (episodes, 0), keys)[0]

        key = jax.random.key(0)
        init = jax.jit(lambda key, env=env, n=num_envs: base.init(env, n, 4096, key))
        episodes = jax.block_until_ready(init(key))
        program = session.compile(f"{name}, {num_envs:,} envs", run, episodes, key)
        programs.append((name, num_envs, (episodes, key), program))

    def measure() -> Iterator[Row]:
        for name, num_envs, inputs, future in programs:
            program = future.result()
            yield program.row
            with session.alone():
                call = functools.partial(program.call, *inputs)
                seconds = common.median_seconds(call, 1 if session.toy else 5)
            yield {
                "section": "env steps",
                "env": name,
                "physics": "fast",
                "envs": num_envs,
                "env_steps_per_second": num_envs * RATE_STEPS / seconds,
            }

    return measure


def training(session: Session) -> Measure:
    """MaxEnt-V on Ant, as the command `train` runs it, until its time is up; then its policies are
    played on C MuJoCo on the host's cores, and drawn.
    """
    directory = session.work / "ant"
    settings = ["--preset", "gpu", "--env", "ant"]
    if session.toy:
        settings = ["--preset", "smoke", "--env", "pendulum"]
    command = (sys.executable, "-m", "experiments.train", *settings, "--out", str(directory))
    with open(session.work / "train.log", "w", encoding="utf-8") as log:
        run = subprocess.Popen(command, stdout=log, stderr=log)
    session.running.append(run)
    stop_at = session.deadline - EVALUATION * (session.deadline - time.monotonic())

    def measure() -> Iterator[Row]:
        reported = 0
        while True:
            ended = run.poll() is not None
            rows = files.read_metrics(directory)
            if rows and not reported:
                yield {
                    "section": "compiled",
                    "program": "train: begin, train_segment, end",
                    "programs": 3,
                    "compile_seconds": rows[0]["wall_compile"],
                }
            for row in rows[reported:]:
                yield {
                    "section": "training",
                    "iteration": row["iteration"],
                    "cells": row["cumulative_coverage"],
                    "mixture_cells": row["mixture_coverage"],
                    "mixture_nats": row["mixture_entropy"],
                    "env_steps": row["env_steps"],
                    "gradient_steps": row["gradient_steps"],
                    **{k: v for k, v in row.items() if k.startswith("wall_")},
                }
            reported = len(rows)
            if ended:
                break
            if time.monotonic() > stop_at:
                run.send_signal(signal.SIGINT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    run.wait(timeout=max(session.deadline - time.monotonic(), 0))
            time.sleep(0.2)
        if not reported:
            said = (session.work / "train.log").read_text(encoding="utf-8").splitlines()
            raise RuntimeError(f"no iteration ended; the run said: {' '.join(said[-1:])}")
        evaluate = (sys.executable, "-m", "experiments.evaluate", str(directory), "--episodes", "3")
        with open(session.work / "evaluate.log", "w", encoding="utf-8") as of_evaluate:
            subprocess.run(
                evaluate,
                env=os.environ | {"JAX_PLATFORMS": "cpu"},
                stdout=of_evaluate,
                stderr=of_evaluate,
                check=True,
            )
        found = json.loads((directory / "evaluation.json").read_text(encoding="utf-8"))
        ends = [policy["mean_end"] for policy in found["policies"]]
        yield {
            "section": "played",
            "on": "C MuJoCo, on the host",
            "iterations": reported,
            "cells": found["training_coverage"],
            "mixture_cells": found["mixture_coverage"],
            "mixture_nats": found["mixture_entropy"],
            "ends": [[round(x, 1) for x in end] for end in ends],
        }

    return measure


def updates(session: Session) -> Measure:
    """Gradient steps of the actor and both critics, all seeds together."""
    hidden, batches, number = (16, (8,), 4) if session.toy else (256, BATCHES, UPDATES)
    programs = []
    for batch, seeds in itertools.product(batches, SEEDS):
        run, inputs = sac.many_updates(hidden, batch, True, seeds, number)
        name = f"{number} updates, batch {batch:,}, seeds {seeds}"
        programs.append((batch, seeds, inputs, session.compile(name, run, *inputs)))

    def measure() -> Iterator[Row]:
        of_one: dict[int, float] = {}  # by batch
        for batch, seeds, inputs, future in programs:
            program = future.result()
            yield program.row
            call = functools.partial(program.call, *inputs)
            rate = seeds * number / common.median_seconds(call, 1 if session.toy else 3)
            of_one.setdefault(batch, rate)
            yield {
                "section": "updates",
                "hidden_size": hidden,
                "batch_size": batch,
                "seeds": seeds,
                "updates_per_second": rate,
                "over_one_seed": rate / of_one[batch],
            }

    return measure


def fidelity(session: Session) -> Measure:
    """MJX with the reference options beside C MuJoCo, from the same states, the same actions."""
    num_envs, num_steps = (2, 2) if session.toy else (256, 50)
    backend = "mujoco" if session.toy else "mjx"
    with jax.default_device(jax.devices("cpu")[0]):
        workload = benchmarks.envs.make_workload("ant", backend, "reference", num_envs, num_steps)
    starts, actions = jax.tree.map(np.asarray, (workload.starts, workload.actions))
    inputs = jax.tree.map(jnp.asarray, (starts, actions))
    program = session.compile(
        f"Ant, reference, {num_envs} envs",
        functools.partial(benchmarks.envs.scan, workload.env),
        *inputs,
    )

    def measure() -> Iterator[Row]:
        truth = benchmarks.envs.bare_rollout(workload._replace(starts=starts), 1)
        compiled = program.result()
        yield compiled.row
        observations = np.asarray(compiled.call(*inputs)[1])
        positions = observations[..., : workload.env.model.nq]
        found = benchmarks.envs.Measurement(0.0, positions, {})
        yield {
            "section": "fidelity",
            "env": "ant",
            "physics": "reference",
            "envs": num_envs,
            **benchmarks.envs.fidelity(workload.env, found, truth),
            "c_mujoco_env_steps_per_second": truth.steps_per_second,
        }

    return measure


def kernels(session: Session) -> Measure:
    """Which kernels a step of training spends its time in, by the profiler."""
    settings: Row = {"random_baseline": False, "num_segments": 1}
    if session.toy:
        config = preset("smoke", env="pendulum", **settings)
    else:
        steps = preset("gpu").budget.num_envs * TRACE_STEPS
        config = preset("gpu", env="ant", steps_per_iteration=steps, **settings)
    state = algorithm.start(config)
    points = jax.random.normal(jax.random.key(0), state.learner.reference.points.shape)
    reference = Reference(points, jnp.asarray(len(points), jnp.int32))
    state = state._replace(learner=state.learner._replace(reference=reference))
    step = lambda state: algorithm.train_segment(config.program(), state)
    program = session.compile(f"{config.env}, a segment of training", step, state)

    def measure() -> Iterator[Row]:
        compiled = program.result()
        yield compiled.row
        with session.alone():
            jax.block_until_ready(compiled.call(state))
            folder = session.work / "trace"
            started = time.perf_counter()
            with jax.profiler.trace(folder):
                jax.block_until_ready(compiled.call(state))
            seconds = time.perf_counter() - started
        found = longest(folder)
        total = sum(s for s, _, _ in found)
        yield {
            "section": "kernels",
            "env": config.env,
            "vector_steps": config.vector_steps,
            "updates": config.vector_steps * config.updates_per_vector_step,
            "wall_seconds": seconds,
            "in_kernels_seconds": total,
            "kernels": sum(n for _, n, _ in found),
        }
        for s, n, name in found[:NUM_KERNELS]:
            yield {
                "section": "kernels",
                "kernel": name,
                "times": n,
                "seconds": s,
                "share": s / total,
            }

    return measure


def longest(folder: Path) -> list[tuple[float, int, str]]:
    """Seconds, calls and name of each kernel of a profile, the longest first.

    On a GPU the events of its streams; on a CPU those that name an instruction of the program.
    """
    path = max(folder.glob("plugins/profile/*/*.trace.json.gz"))
    with gzip.open(path, "rt", encoding="utf-8") as file:
        events = json.load(file)["traceEvents"]
    processes = {
        e["pid"]: e["args"]["name"]
        for e in events
        if e.get("ph") == "M" and e.get("name") == "process_name"
    }
    on_gpu = {pid for pid, name in processes.items() if "/device:GPU" in name}
    totals: dict[str, list[float]] = {}
    for event in events:
        if event.get("ph") != "X" or (on_gpu and event["pid"] not in on_gpu):
            continue
        arguments = event.get("args") or {}
        if not on_gpu and "hlo_op" not in arguments:
            continue
        seconds_and_calls = totals.setdefault(event["name"], [0.0, 0])
        seconds_and_calls[0] += event["dur"] / 1e6
        seconds_and_calls[1] += 1
    return sorted(((s, int(n), name) for name, (s, n) in totals.items()), reverse=True)


# All begin to compile together; what stands first is measured first.
PARTS: dict[str, dict[str, Callable[[Session], Measure]]] = {
    "first": {
        "device": device,
        "neighbors": neighbors,
        "env steps": functools.partial(env_steps, ("ant",), ENVS),
        "training": training,
    },
    "second": {
        "env steps": functools.partial(env_steps, ("walker2d", "humanoid"), ENVS[:1]),
        "updates": updates,
        "fidelity": fidelity,
        "kernels": kernels,
        "peers": peers,
    },
}


def measure(part: str, seconds: float, toy: bool, rows: Path, work: Path) -> None:
    """In a process of its own, which may be ended at any time."""
    os.setpgrp()  # it ends together with the compilers and the runs that it starts
    # Two processes share the device: a part, and the run of `training` beside it.
    os.environ["XLA_PYTHON_CLIENT_MEM_FRACTION"] = "0.45"
    runtime.prepare(simulates_in_jax=True)
    began = time.monotonic()
    with ThreadPoolExecutor(max_workers=16) as compilers, rows.open("a", encoding="utf-8") as file:
        session = Session(toy, began + seconds, work, compilers, [])

        def write(row: Row) -> None:
            row = common.rounded({"after_seconds": time.monotonic() - began} | row)
            print(json.dumps(row), file=file, flush=True)
            common.progress(row)

        def failed(what: str, error: Exception) -> None:  # costs what it would have measured
            traceback.print_exception(error)
            write({"section": "failed", "what": what, "why": common.sentence(error)})

        begun = {name: compilers.submit(s, session) for name, s in PARTS[part].items()}
        for name, section in begun.items():
            try:
                measure_section = section.result()
                for row in measure_section():
                    write(row)
            except Exception as error:
                failed(name, error)


def run_part(part: str, seconds: float, toy: bool, out: Path) -> list[Row]:
    """The rows of a part that ends when its time is up, packed into OUT/PART.*"""
    until = time.monotonic() + seconds
    rows = out / f"{part}.jsonl"
    rows.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        arguments = part, seconds - PACKING, toy, rows, work
        process = multiprocessing.get_context("spawn").Process(target=measure, args=arguments)
        process.start()
        assert process.pid is not None
        try:
            process.join(until - PACKING - time.monotonic())
            ended = process.exitcode  # None: its time is up
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        process.join()
        with tarfile.open(out / f"{part}.tar.gz", "w:gz") as archive:
            for path in sorted(work.rglob("*")):
                name = path.relative_to(work)
                if path.is_file() and not NOT_PACKED & set(name.parts):
                    archive.add(path, name)
    # A row that was being written when the time was up is none.
    written = rows.read_text(encoding="utf-8") if rows.exists() else ""
    whole = written[: written.rfind("\n") + 1]
    rows.write_text(whole, encoding="utf-8")
    found = [json.loads(line) for line in whole.splitlines()]
    if ended:
        found.append({"section": "failed", "what": part, "why": f"it ended with code {ended}"})
    return found


def summary(rows: list[Row]) -> list[str]:
    """A line for each figure that matters, ten at most: failures first."""
    compiled = [row for row in rows if row["section"] == "compiled"]
    programs = sum(row["programs"] for row in compiled)
    seconds = sum(row.get("trace_seconds", 0) + row["compile_seconds"] for row in compiled)
    lines = [f"{programs} programs compiled, {seconds:.0f} s, side by side"]
    for section, line in SUMMARY.items():
        lines += filter(None, (line(row) for row in rows if row["section"] == section))
    return lines[:10]


SUMMARY: dict[str, Callable[[Row], str]] = {
    "failed": lambda r: f"failed: {r['what']} ({r['why']})",
    "env steps": lambda r: (
        f"{r['env']}, {r['envs']:,} envs: {r['env_steps_per_second']:,.0f} env steps/s"
    ),
    "played": lambda r: (
        f"MaxEnt-V: {r['iterations']} iterations, {r['cells']:,} cells in training, "
        f"{r['mixture_cells']:,} by the mixture on C MuJoCo, {r['mixture_nats']:.2f} nats"
    ),
    "kNN": lambda r: (
        f"kNN, {r['who']}, {r['queries']:,} x {r['points']:,}: {r['tpair_per_second']:.3g} Tpair/s"
    ),
    "updates": lambda r: (
        f"SAC, batch {r['batch_size']:,}, seeds {r['seeds']}: {r['updates_per_second']:,.0f} "
        f"updates/s, {r['over_one_seed']:.2f} times one seed's"
    ),
    "kernels": lambda r: (
        ""
        if "kernel" in r
        else f"training: {r['kernels'] / r['vector_steps']:,.0f} kernels a vector step, "
        f"{r['in_kernels_seconds'] / r['wall_seconds']:.0%} of the time in them"
    ),
    "fidelity": lambda r: (
        f"MJX beside C MuJoCo after one step: {r['largest_error_after_1_step']:.1e} at most"
    ),
}


def main() -> None:
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--part", choices=list(PARTS), required=True)
    flags.add_argument("--seconds", type=float, default=SECONDS, help="by this command's own clock")
    flags.add_argument("--out", type=Path, default=Path("results/gpu"), help="of rows and figures")
    flags.add_argument("--toy", action="store_true", help="does it run? tiny sizes, on a CPU")
    args = flags.parse_args()
    if args.seconds <= PACKING:
        flags.error(f"--seconds must be more than {PACKING:.0f}.")
    args.out.mkdir(parents=True, exist_ok=True)
    rows = run_part(args.part, args.seconds, args.toy, args.out)
    print("\n".join(summary(rows)))
    if any(row["section"] == "failed" for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
