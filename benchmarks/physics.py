"""How much faster is each simplification of the physics in MJX, and how much fidelity does it cost?

Each row changes some options of an environment's XML (envs.physics.Options). Its motion is compared
with C MuJoCo and the unchanged XML, from the same settled states under the same random actions. In
addition to the drift, it reports the depth of contacts, the length of random episodes and the share
of states upside down. With --learner, one iteration of preset `quick` is trained on each physics
instead. This uses C MuJoCo, which moves alike at equal options and is faster on a CPU.
"""

import functools
import statistics
import time
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks import common
from benchmarks.envs import scan, settled
from maxent_jax import algorithm, components, envs
from maxent_jax.config import preset, registry
from maxent_jax.envs import base, entries
from maxent_jax.envs.physics import REFERENCE, Options
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.runs import runtime

DRIFT_STEPS = (1, 10, 50)
NUM_STEPS, CHUNK = 200, 20  # of each env, without resets
SEED = 0


def _options(integrator: str | None, iterations: int, ls_iterations: int, **more: Any) -> Options:
    return Options(integrator, iterations=iterations, ls_iterations=ls_iterations, **more)


# The baseline is fast and coarse: others should have higher fidelity at its speed.
FLOOR = _options("Euler", 1, 4, eulerdamp=False)
OPTIONS: dict[str, dict[str, Options]] = {
    "ant": {
        "unchanged": REFERENCE,
        "Euler, 1 iteration of 4": FLOOR,
        "Euler, 4 iterations of 8": _options("Euler", 4, 8),
        "implicitfast, 4 iterations of 8": _options("implicitfast", 4, 8),
        "Euler, half the time step, 2 iterations of 4": _options("Euler", 2, 4, substeps=2),
        "RK4, 4 iterations of 8": _options(None, 4, 8),
        "RK4, 2 iterations of 4": _options(None, 2, 4),
        "RK4, 4 iterations of 8, 6 contacts": _options(None, 4, 8, max_contacts=6),
        "RK4, 3 iterations of 6, 6 contacts": _options(None, 3, 6, max_contacts=6),
        "RK4, 2 iterations of 4, 6 contacts": _options(None, 2, 4, max_contacts=6),
        "Euler, half the time step, 4 iterations of 8, 6 contacts": _options(
            "Euler", 4, 8, substeps=2, max_contacts=6
        ),
        "Euler, a third of the time step, 3 iterations of 6, 6 contacts": _options(
            "Euler", 3, 6, substeps=3, max_contacts=6
        ),
    },
    "walker2d": {
        "Euler, 1 iteration of 4": FLOOR,
        "Euler, 4 iterations of 8, 4 contacts": _options("Euler", 4, 8, max_contacts=4),
        "implicitfast, 4 iterations of 8, 4 contacts": _options(
            "implicitfast", 4, 8, max_contacts=4
        ),
        "RK4, 4 iterations of 8": _options(None, 4, 8),
        "RK4, 4 iterations of 8, 4 contacts": _options(None, 4, 8, max_contacts=4),
        "RK4, 3 iterations of 6, 4 contacts": _options(None, 3, 6, max_contacts=4),
        "RK4, 2 iterations of 4, 4 contacts": _options(None, 2, 4, max_contacts=4),
        "Euler, half the time step, 4 iterations of 8, 4 contacts": _options(
            "Euler", 4, 8, substeps=2, max_contacts=4
        ),
    },
    "humanoid": {
        "Euler, 1 iteration of 4": FLOOR,
        "Euler, 4 iterations of 8, 8 contacts": _options("Euler", 4, 8, max_contacts=8),
        "implicitfast, 4 iterations of 8, 8 contacts": _options(
            "implicitfast", 4, 8, max_contacts=8
        ),
        "RK4, 4 iterations of 8": _options(None, 4, 8),
        "RK4, 4 iterations of 8, no self-collisions": _options(None, 4, 8, self_collisions=False),
        "RK4, 4 iterations of 8, 8 contacts": _options(None, 4, 8, max_contacts=8),
        "RK4, 2 iterations of 4, 8 contacts": _options(None, 2, 4, max_contacts=8),
        "Euler, half the time step, 3 iterations of 6, 8 contacts": _options(
            "Euler", 3, 6, substeps=2, max_contacts=8
        ),
        "Euler, half the time step, 3 iterations of 6, 8 contacts, no self-collisions": _options(
            "Euler", 3, 6, substeps=2, max_contacts=8, self_collisions=False
        ),
    },
}


def motion(env: MujocoEnv, starts: Any, actions: np.ndarray) -> dict[str, Any]:
    """Returns positions and observations [T, N, ...] under the actions, and the step rate.

    The steps run in chunks; the rate is from the median time of a chunk.
    """
    chunks = jnp.asarray(actions).reshape(-1, min(CHUNK, len(actions)), *actions.shape[1:])
    program, compile_seconds = common.compiled(functools.partial(scan, env), starts, chunks[0])
    observations, seconds = [], []
    for chunk in chunks:
        started = time.perf_counter()
        starts, seen = jax.block_until_ready(program(starts, chunk))
        seconds.append(time.perf_counter() - started)
        observations.append(np.asarray(seen))
    return {
        "observations": np.concatenate(observations),
        "positions": np.concatenate(observations)[..., : env.model.nq],
        "rate": chunks[0].shape[0] * chunks[0].shape[1] / statistics.median(seconds),
        "compile_seconds": compile_seconds,
    }


def fidelity(env: MujocoEnv, found: dict[str, Any], truth: dict[str, Any]) -> dict[str, float]:
    """Returns the drift of the torso, and measures of random episodes."""
    torso = 2 if env.task.torso is None else 3
    away = np.linalg.norm((found["positions"] - truth["positions"])[..., :torso], axis=-1)
    steps = [n for n in DRIFT_STEPS if n <= len(away)]
    row = {f"drift_{n}_mm": 1000 * float(np.median(away[n - 1])) for n in steps}
    observations = found["observations"]
    healthy = np.asarray(env.task.healthy(observations)) & np.isfinite(observations).all(-1)
    alive = np.cumprod(healthy, axis=0).astype(bool)
    row["episode_length"] = float(alive.sum(0).mean())
    row["not_finite"] = int((~np.isfinite(observations).all(-1)).any(0).sum())
    if env.task.torso is not None:
        row["flipped_share"] = float(np.asarray(env.task.torso.flipped(observations))[alive].mean())
    depths = penetration(env.model, found["positions"][::10][alive[::10]])
    row["penetration_mm"] = 1000 * float(np.mean(depths))
    return row


def penetration(model: mujoco.MjModel, positions: np.ndarray) -> np.ndarray:
    """Returns the depth of the deepest contact with the ground, in metres, by state with one."""
    data, depths = mujoco.MjData(model), []
    for qpos in positions[:1000]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon:
            depths.append(max(-data.contact.dist.min(), 0.0))
    return np.array(depths or [0.0])


def measure(name: str, num_envs: int, num_steps: int) -> Iterator[dict[str, Any]]:
    """Yields a row for each set of options."""
    task = envs.TASKS[name]
    truth_env = MujocoEnv(task, "mujoco")
    starts, actions = settled(truth_env, num_envs, num_steps, SEED)
    truth = motion(truth_env, starts, actions)
    yield {
        "benchmark": "physics",
        "env": name,
        "options": "C, unchanged",
        "env_steps_per_second": truth["rate"],
        **fidelity(truth_env, truth, truth),
    }
    for label, options in OPTIONS[name].items():
        env = MujocoEnv(task, "mjx", options)
        found = motion(env, starts, actions)
        yield {
            "benchmark": "physics",
            "env": name,
            "options": label,
            "envs": num_envs,
            "env_steps_per_second": found["rate"],
            "compile_seconds": found["compile_seconds"],
            **fidelity(env, found, truth),
        }


def survive(name: str, num_steps: int, num_envs: int) -> dict[str, Any]:
    """Checks that no NaN gets through under full-scale random actions, in MJX with `fast`."""
    env = envs.make(name, "mjx", "fast")
    key_init, key_steps = jax.random.split(jax.random.key(SEED))

    def step(carry, key):
        episodes, counts = carry
        key_act, key_env = jax.random.split(key)
        action = jax.random.uniform(key_act, (num_envs, env.action_size), minval=-1, maxval=1)
        episodes, seen = base.step(env, episodes, action, 1000, key_env)
        finite = jnp.isfinite(seen.observation).all() & jnp.isfinite(seen.next_observation).all()
        now = jnp.stack([jnp.sum(~seen.valid), jnp.sum(~finite), jnp.sum(seen.terminated)])
        return (episodes, counts + now), None

    scan_steps = jax.jit(lambda carry, keys: jax.lax.scan(step, carry, keys)[0])
    carry = base.init(env, num_envs, 4096, key_init), jnp.zeros(3, jnp.int32)
    num_chunks = -(-num_steps // (num_envs * CHUNK))  # rounded up
    for key in jax.random.split(key_steps, num_chunks):
        carry = scan_steps(carry, jax.random.split(key, CHUNK))
    invalid, leaked, ended = carry[1].tolist()
    return {
        "benchmark": "physics",
        "env": name,
        "options": "fast",
        "random_steps": num_chunks * num_envs * CHUNK,
        "not_finite_resets": invalid,
        "vector_steps_with_nan_observed": leaked,
        "episodes_ended": ended,
    }


def learn(name: str, label: str, seed: int) -> dict[str, Any]:
    """Trains one iteration of preset `quick` on a physics, and plays the mixture on it."""
    row, task = registry.ENVIRONMENTS[name], envs.TASKS[name]._replace(fast=OPTIONS[name][label])
    registry.ENVIRONMENTS[name] = row._replace(entry=entries.of_task(task))
    components._make.cache_clear()
    jax.clear_caches()  # they identify the environment by its name
    config = preset("quick", env=name, physics="fast", backend="mujoco", seed=seed)
    started = time.perf_counter()
    programs = algorithm.programs(config)
    state, _ = programs.begin(algorithm.start(config))
    for _ in range(config.budget.num_segments):
        state, _ = programs.train_segment(state)
    _, metrics = programs.end(state)
    return {
        "benchmark": "physics",
        "env": name,
        "options": label,
        "seed": seed,
        "cells": int(metrics["cumulative_coverage"]),
        "mixture_cells": int(metrics["mixture_coverage"]),
        "seconds": time.perf_counter() - started,
    }


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--env", nargs="*", choices=list(OPTIONS), default=list(OPTIONS))
    flags.add_argument("--envs", type=int, default=64)
    flags.add_argument("--only", nargs="*", help="labels of options")
    flags.add_argument("--survive", type=int, help="only random env steps, this many, with `fast`")
    flags.add_argument("--learner", type=int, nargs="*", help="seeds to train on each physics")
    args = flags.parse_args()
    runtime.prepare(simulates_in_jax=True)
    common.print_versions()
    for name in args.env:
        if args.only:
            OPTIONS[name] = {k: v for k, v in OPTIONS[name].items() if k in args.only}
        if args.toy:
            OPTIONS[name] = {}
        if args.survive:
            rows = iter([survive(name, args.survive, args.envs)])
        elif args.learner:
            rows = (learn(name, label, seed) for seed in args.learner for label in OPTIONS[name])
        else:
            size = (2, 4) if args.toy else (args.envs, NUM_STEPS)
            rows = measure(name, *size)
        for row in rows:
            common.emit(row)


if __name__ == "__main__":
    main()
