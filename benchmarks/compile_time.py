"""How long until a run's first training step, with an empty or a filled compilation cache?

Each measurement runs `experiments.train` in its own process, with one vector step per segment. The
time is from the start of its main to the end of the first segment: imports, compilation, the first
rollouts of the mixture, and one vector step with its gradient steps.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import common
from maxent_jax.config import preset
from maxent_jax.config.presets import PRESETS
from maxent_jax.config.registry import ENVS
from maxent_jax.runs import files

TRAIN = ("-m", "experiments.train", "--num-iterations", "1")


def first_step(env: str, name: str, directory: Path, cache: Path) -> float:
    """Returns the seconds until a run's first step; the run ends soon after it."""
    config = preset(name, env=env)
    steps = config.budget.num_envs * config.budget.num_segments
    flags = ("--env", env, "--preset", name, "--steps-per-iteration", str(steps))
    subprocess.run(
        [sys.executable, *TRAIN, *flags, "--out", str(directory)],
        env=os.environ | {"XDG_CACHE_HOME": str(cache)},
        capture_output=True,
        check=True,
    )
    (row,) = files.read_metrics(directory)
    return row["wall_first_step"]


def measure(env: str, name: str, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields a row with an empty cache, and one with the cache that the first runs filled."""
    with tempfile.TemporaryDirectory() as folder:
        caches = [Path(folder, f"cache-{i}") for i in range(repeats)]
        for kind in ("cold", "warm"):
            seconds = [
                first_step(env, name, Path(folder, f"{kind}-{i}"), cache)
                for i, cache in enumerate(caches)
            ]
            yield {
                "benchmark": "compile_time",
                "env": env,
                "preset": name,
                "cache": kind,
                "seconds_to_first_step": statistics.median(seconds),
                "runs": repeats,
            }


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--env", choices=ENVS, default="ant")
    flags.add_argument("--preset", choices=list(PRESETS), default="quick")
    args = flags.parse_args()
    common.print_versions()
    toy = ("pendulum", "smoke", 1)
    for row in measure(*(toy if args.toy else (args.env, args.preset, args.repeats))):
        common.emit(row)


if __name__ == "__main__":
    main()
