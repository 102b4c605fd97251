"""The sections. Each begins to compile when called, and returns the function that measures."""

import contextlib
import functools
import gzip
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import benchmarks.envs
from benchmarks import common, knn, sac
from benchmarks.gpu.session import Measure, Row, Session
from maxent_jax import algorithm, envs, native
from maxent_jax.algorithm.experience import Reference
from maxent_jax.config import preset
from maxent_jax.runs import files

EVALUATION = 0.2  # share of the time, to stop the run and to play its policies on the host
ENVS = (4096, 16_384)
RATE_STEPS = 20  # of each environment, in one program
KNN_SIZES = ((100_000, 100_000), (64, 65_536))  # queries, points
KNN_STEPS = 100  # of a scan
BATCHES, SEEDS = (256, 4096), (1, 8)
UPDATES = 100
TRACE_STEPS = 2  # vector steps of training in the trace
NUM_KERNELS = 10


def device(session: Session) -> Measure:
    """Measures the rate of a large matmul and whether it rounds its factors; prints versions."""

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
    """Measures our search, in XLA and in CUDA if built, and the expanded square with top_k."""
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
            # All squares of the large problem would take 40 GB, so top_k gets its queries in parts.
            parted = queries
            if search is knn.top_k and num_sets == 1 and num_queries > 1000:
                parted = queries.reshape(-1, 1000, queries.shape[-1])
            name = f"kNN {num_queries:,} x {num_points:,}, {who}"
            program = session.compile(name, functools.partial(knn.scan, search), parted, points)
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
    """Returns the best time of three searches by cdist and topk."""
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
    """Measures searches of other libraries."""
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
    """Measures env steps per second under random actions, with new episodes as in training."""
    chosen = [("pendulum", 8)] if session.toy else [(n, s) for n in names for s in sizes]
    programs = []
    for name, num_envs in chosen:
        env = envs.make(name) if session.toy else envs.make(name, "mjx", "fast")
        begin = jax.jit(
            functools.partial(benchmarks.envs.begin_episodes, env, num_envs, RATE_STEPS)
        )
        inputs = jax.block_until_ready(begin(jax.random.key(0)))
        run = functools.partial(benchmarks.envs.step_episodes, env)
        program = session.compile(f"{name}, {num_envs:,} envs", run, *inputs)
        programs.append((name, num_envs, inputs, program))

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
    """Trains MaxEnt-V on Ant with the command `train` until its time is up.

    Then plays its policies on C MuJoCo on the host's cores, and draws them.
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
            raise RuntimeError(f"no iteration ended; the run printed: {' '.join(said[-1:])}")
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
    """Measures gradient steps of the actor and both critics, of all seeds together."""
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


def host_physics(session: Session) -> Measure:
    """Measures training with C MuJoCo on the host's cores, without and with a policy lag."""
    name, sizes, steps = ("smoke", {}, 2) if session.toy else ("quick", {"num_envs": 256}, 20)
    programs = []
    for lag in (0, 1):
        config = preset(name, env="ant", backend="mujoco", policy_lag=lag, num_segments=1, **sizes)
        config = config.replace(steps_per_iteration=steps * config.budget.num_envs)
        segment = functools.partial(algorithm.train_segment, config)
        state = algorithm.start(config)
        label = f"train_segment, C MuJoCo on the host, policy lag {lag}"
        programs.append((config, state, session.compile(label, segment, state)))

    def measure() -> Iterator[Row]:
        rates: list[float] = []
        for config, state, future in programs:
            program = future.result()
            yield program.row
            filled, _ = program.call(state)
            call = functools.partial(program.call, filled)
            taken = common.median_seconds(call, 1 if session.toy else 3)
            rates.append(config.budget.steps_per_iteration / taken)
            yield {
                "section": "host physics",
                "envs": config.budget.num_envs,
                "updates_per_step": config.budget.updates_per_step,
                "policy_lag": config.learner.policy_lag,
                "env_steps_per_second": rates[-1],
                "over_no_lag": rates[-1] / rates[0],
            }

    return measure


def fidelity(session: Session) -> Measure:
    """Compares MJX with the reference options and C MuJoCo: same states, same actions."""
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
    """Profiles a step of training: the kernels in which it spends its time."""
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
    """Returns seconds, calls and name of each kernel of a profile, longest first.

    On a GPU these are the events of its streams, on a CPU those that name an instruction.
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
