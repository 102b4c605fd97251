"""How many env steps per second does training make with several seeds in parallel?

It times a segment of a preset on Ant, with gradient steps and reward, for all seeds as one program.
The rate of one seed is that of runs one after another.
"""

from collections.abc import Iterator
from typing import Any

from benchmarks import common
from maxent_jax import algorithm
from maxent_jax.config import preset
from maxent_jax.config.presets import PRESETS
from maxent_jax.config.registry import BACKENDS, ENVS
from maxent_jax.runs import runtime


def seconds_per_segment(config, repeats: int) -> float:
    """Returns the median time of a segment, after one to warm up; each continues the last."""
    programs = algorithm.programs(config)
    state, _ = programs.begin(algorithm.start(config))
    taken, _ = common.continued_seconds(programs.train_segment, state, repeats)
    return taken


def measure(name: str, settings: dict[str, Any], counts, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields a row for each number of seeds; the others are compared with the first."""
    first = 0.0
    for count in counts:
        config = preset(name, num_seeds=count, **settings)
        steps = count * config.budget.num_envs * config.vector_steps
        rate = steps / seconds_per_segment(config, repeats)
        first = first or rate
        yield {
            "benchmark": "seeds",
            "env": config.env,
            "preset": name,
            "seeds": count,
            "envs_of_each": config.budget.num_envs,
            "batch_size": config.learner.batch_size,
            "updates_per_step": config.budget.updates_per_step,
            "env_steps_per_second": rate,
            "over_one_by_one": rate / first,
        }


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--env", choices=ENVS, default="ant")
    flags.add_argument("--backend", choices=BACKENDS, default="auto")
    flags.add_argument("--preset", choices=list(PRESETS), default="quick")
    flags.add_argument("--num-envs", type=int, help="of a seed; the preset's by default")
    flags.add_argument("--batch-size", type=int, help="of a seed; the preset's by default")
    flags.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 4, 8])
    args = flags.parse_args()
    runtime.prepare(simulates_in_jax=args.backend == "mjx")
    common.print_versions()
    if args.toy:
        rows = measure("smoke", {"env": "pendulum"}, (1, 2), args.repeats)
    else:
        settings = {"env": args.env, "backend": args.backend}
        sizes = {"num_envs": args.num_envs, "batch_size": args.batch_size}
        settings |= {name: size for name, size in sizes.items() if size is not None}
        rows = measure(args.preset, settings, args.seeds, args.repeats)
    for row in rows:
        common.emit(row)


if __name__ == "__main__":
    main()
