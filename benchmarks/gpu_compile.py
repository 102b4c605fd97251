"""How does XLA compile our programs for a GPU? Answered without a GPU.

Needs `jax[cuda13]`, but no device: programs are compiled for an H100 as NVIDIA describes it. For
each program it prints the compile time on this machine, the memory that it needs in addition to its
arguments, and the number of kernel launches (a loop counts as often as it runs). Launches dominate
kernels of this size, at 2 to 5 µs each, so their number is the best available prediction of what a
step costs. Kernels are chosen without timing them (`--xla_gpu_autotune_level=0`).
"""

import functools
import os
import re
import time
import warnings
from collections.abc import Callable
from typing import Any

os.environ["JAX_SKIP_CUDA_CONSTRAINTS_CHECK"] = "1"  # skips libraries that need a driver
os.environ["JAX_PLATFORMS"] = "cpu"  # for all that runs outside the compiled programs
os.environ["XLA_FLAGS"] = f"--xla_gpu_autotune_level=0 {os.environ.get('XLA_FLAGS', '')}"

import jax
import jax.numpy as jnp
from jax.experimental import topologies
from jax.sharding import NamedSharding, PartitionSpec

from benchmarks import common, sac
from benchmarks.envs import begin_episodes, step_episodes
from maxent_jax import algorithm, envs
from maxent_jax.config import preset
from maxent_jax.density import knn

# In the form in which XLA describes a device that it finds.
H100 = """
platform_name: "CUDA"
device_description_str: "NVIDIA H100 80GB HBM3"
dnn_version_info { major: 9 minor: 10 }
runtime_version { major: 13 }
gpu_device_info {
  cuda_compute_capability { major: 9 }
  core_count: 132 fpus_per_core: 128 clock_rate_ghz: 1.98
  threads_per_block_limit: 1024 threads_per_warp: 32 threads_per_core_limit: 2048
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  shared_memory_per_block: 49152 shared_memory_per_core: 233472
  shared_memory_per_block_optin: 232448
  l2_cache_size: 52428800 memory_bandwidth: 3352320000000 device_memory_size: 84929347584
}
"""
# Instructions that launch nothing.
FREE = {
    "parameter",
    "constant",
    "tuple",
    "get-tuple-element",
    "bitcast",
    "after-all",
    "partition-id",
}
INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?\S+ = (?:\(.*?\)|\S+) ([a-z\-]+)\(")
BEGINS = re.compile(r"^(ENTRY )?%?(\S+) \(.*\{$")
CALLED = re.compile(r"(?:body|to_apply|calls|branch_computations)=\{?([%\w.\-, ]+)")
TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')


def compiled_for(device: Any, function: Callable, *args: Any) -> tuple[Any, float, float]:
    """Returns the program, and the seconds to trace and to compile it."""
    mesh = jax.sharding.Mesh([device], ("devices",))
    here = NamedSharding(mesh, PartitionSpec())
    started = time.perf_counter()
    # The first argument is donated, as a run donates its state.
    donating = jax.jit(function, in_shardings=here, out_shardings=here, donate_argnums=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # if none of it can be reused
        lowered = donating.lower(*args)
    traced = time.perf_counter()
    program = lowered.compile()
    return program, traced - started, time.perf_counter() - traced


def launches(text: str) -> tuple[int, int]:
    """Counts a program's kernel launches, and its kernels, from its optimised HLO."""
    bodies: dict[str, list[str]] = {}
    entry = name = ""
    for line in text.splitlines():
        if found := BEGINS.match(line):
            name = found[2]
            bodies[name] = []
            entry = name if found[1] else entry
        elif name and INSTRUCTION.match(line):
            bodies[name].append(line)

    @functools.cache
    def count(name: str) -> tuple[int, int]:
        total = once = 0
        for line in bodies.get(name, []):
            found = INSTRUCTION.match(line)
            opcode = found[1] if found else ""
            if opcode in FREE:
                continue
            if opcode not in ("while", "conditional", "call"):
                total, once = total + 1, once + 1
                continue
            called = CALLED.search(line.replace("condition=", "of="))
            names = re.findall(r"[\w.\-]+", called[1]) if called else []
            parts = [count(name) for name in names]
            trips = TRIPS.search(line)
            times = int(trips[1]) if trips else 1
            if parts:  # the longest branch counts
                total += times * max(part[0] for part in parts)
                once += sum(part[1] for part in parts)
        return total, once

    return count(entry)


def steps(name: str, num_envs: int, num_steps: int) -> tuple[Callable, tuple]:
    """Returns random episodes in MJX with profile `fast`, as `benchmarks.gpu` measures them."""
    env = envs.make(name, "mjx", "fast")
    begin = functools.partial(begin_episodes, env, num_envs, num_steps)
    return functools.partial(step_episodes, env), jax.eval_shape(begin, jax.random.key(0))


def search(num_queries: int, num_points: int) -> tuple[Callable, tuple]:
    shape = lambda rows: jax.ShapeDtypeStruct((rows, 7), jnp.float32)
    whole = lambda rows: jax.ShapeDtypeStruct((rows,), jnp.int32)
    arguments = shape(num_queries), shape(num_points), whole(num_queries), whole(num_points)
    number = jax.ShapeDtypeStruct((), jnp.int32)
    return functools.partial(knn.by_reduction, 3), (*arguments, number)


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--only", nargs="*", help="beginnings of program names")
    args = flags.parse_args()
    try:
        chips = topologies.get_topology_desc("h100", "cuda", target_config=H100, topology="1x1x1")
    except NotImplementedError:
        flags.error('XLA\'s compiler for GPUs is not installed: pip install "jax[cuda13]".')
    common.print_versions()
    config = preset("gpu", env="ant", backend="mjx").program()
    state = jax.eval_shape(functools.partial(algorithm.start, config))
    part = lambda function: (functools.partial(function, config), (state,))
    programs: dict[str, tuple[int, Callable[[], tuple[Callable, tuple]]]] = {
        "kNN 64 x 65,536": (1, lambda: search(64, 65_536)),
        "kNN 100,000 x 100,000": (1, lambda: search(100_000, 100_000)),
        "20 updates, batch 256": (20, lambda: sac.many_updates(256, 256, True, 1, 20)),
        "20 updates, batch 256, 8 seeds": (20, lambda: sac.many_updates(256, 256, True, 8, 20)),
        "5 steps of 4,096 ants": (5, lambda: steps("ant", 4096, 5)),
        "5 steps of 4,096 walkers": (5, lambda: steps("walker2d", 4096, 5)),
        "5 steps of 4,096 humanoids": (5, lambda: steps("humanoid", 4096, 5)),
        "ant, begin": (config.environment.episode_length, lambda: part(algorithm.begin)),
        "ant, train_segment": (config.vector_steps, lambda: part(algorithm.train_segment)),
        "ant, end": (config.environment.episode_length, lambda: part(algorithm.end)),
    }
    if args.toy:
        programs = {"kNN 8 x 64": (1, lambda: search(8, 64))}
    for name, (times, make) in programs.items():
        if args.only and not name.startswith(tuple(args.only)):
            continue
        function, arguments = make()
        shapes = jax.eval_shape(lambda *x: x, *arguments)
        program, trace_seconds, compile_seconds = compiled_for(chips.devices[0], function, *shapes)
        total, once = launches(program.as_text())
        common.emit(
            {
                "benchmark": "gpu_compile",
                "program": name,
                "kernels": once,
                "launches_a_step": total / times,
                "temporary_gigabytes": program.memory_analysis().temp_size_in_bytes / 1e9,
                "trace_seconds": trace_seconds,
                "compile_seconds": compile_seconds,
            }
        )


if __name__ == "__main__":
    main()
