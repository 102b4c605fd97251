"""How do the costs of an iteration grow with the number of policies, the replay, and the reference?

Each part starts from a state as it is late in a run of `quick` on Ant: a full archive, a full
replay, or a large reference.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from matplotlib.figure import Figure

from benchmarks import common, replay
from maxent_jax import algorithm, components, mixture
from maxent_jax.algorithm import State, experience
from maxent_jax.algorithm.experience import Reference
from maxent_jax.algorithm.learner import Learner
from maxent_jax.config import Config, preset
from maxent_jax.runs import memory, runtime

ITERATIONS = (5, 20, 60)
ROWS = (100_000, 1_000_000, 10_000_000)
POINTS = (8_192, 65_536, 1_000_000)
EPISODES = 64  # of the mixture, so that each of 61 policies plays
MEASURED = 100_000  # rows of the replay that are measured against the reference


def seconds(program: Callable, state: State, repeats: int) -> float:
    """Returns the median time of a program that donates its state, which stays intact."""
    copies = iter([jax.tree.map(jnp.copy, state) for _ in range(repeats + 1)])
    return common.median_seconds(lambda: program(next(copies)), repeats)


def late(config: Config) -> State:
    """Returns a state before the last iteration: every policy but the last is in the archive."""
    state = algorithm.start(config)
    archive, untrained = state.archive, state.learner.agent.parameters
    for _ in range(config.archive_size - 1 - config.mixture.snapshots):
        archive = mixture.append(archive, untrained)
    return state._replace(archive=archive)


def policies(settings: dict[str, Any], counts, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields the time of an iteration late in runs of several lengths."""
    first = 0.0
    for num_iterations in counts:
        config = preset(**settings, num_iterations=num_iterations)
        programs, state = algorithm.programs(config), late(config)
        begin = seconds(programs.begin, state, repeats)
        begun, _ = programs.begin(jax.tree.map(jnp.copy, state))
        segment = seconds(programs.train_segment, begun, repeats)
        end = seconds(programs.end, begun, repeats)
        whole = begin + config.budget.num_segments * segment + end
        first = first or whole
        yield {
            "benchmark": "growth",
            "of": "iterations",
            "number": num_iterations,
            "begin_seconds": begin,
            "segments_seconds": config.budget.num_segments * segment,
            "end_seconds": end,
            "seconds": whole,
            "over_first": whole / first,
        }


def replay_rows(settings: dict[str, Any], sizes, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields the time of a gradient step, and of `begin`, with full replays of several sizes."""
    first = 0.0
    for size in sizes:
        config = preset(**settings, replay_size=size, replay_dtype="float16", yaw_copies=0)
        programs, state = algorithm.programs(config), algorithm.start(config)
        gigabytes = memory.nbytes(state.learner.replay) / 1e9
        full = replay.ring_of(config, full=True)
        state = state._replace(learner=state.learner._replace(replay=full))
        begin, state = common.continued_seconds(programs.begin, state, repeats)
        segment, _ = common.continued_seconds(programs.train_segment, state, repeats)
        update = segment / (config.vector_steps * config.updates_per_vector_step)
        first = first or update
        yield {
            "benchmark": "growth",
            "of": "replay rows",
            "number": size,
            "gigabytes": gigabytes,
            "begin_seconds": begin,
            "seconds": update,
            "over_first": update / first,
        }


def measure_seconds(p: components.Components, learner: Learner, repeats: int) -> float:
    """Returns the time to measure the whole replay against the learner's reference."""
    measure = jax.jit(functools.partial(experience.measure_all, p))
    arguments = learner.reference, learner.replay, learner.episodes.starts.obs
    return common.median_seconds(lambda: measure(*arguments), repeats)


def reference_points(
    settings: dict[str, Any], sizes, measured: int, repeats: int
) -> Iterator[dict[str, Any]]:
    """Yields the time of a vector step, and of measuring the replay, with several references."""
    first = 0.0
    for size in sizes:
        episodes = -(-size // preset(**settings).environment.episode_length)
        more = {"mixture_episodes": max(EPISODES, episodes), "replay_size": measured}
        config = preset(**(settings | more), reference_size=size)
        p, state = components.make(config), algorithm.start(config)
        points = jax.random.normal(jax.random.key(0), (size, len(p.phi.names)))
        learner = state.learner._replace(
            reference=Reference(points, jnp.asarray(size)), replay=replay.ring_of(config, full=True)
        )
        state = state._replace(learner=learner)
        segment = seconds(algorithm.programs(config).train_segment, state, repeats)
        measuring = measure_seconds(p, learner, repeats)
        step = segment / config.vector_steps
        first = first or step
        yield {
            "benchmark": "growth",
            "of": "reference points",
            "number": size,
            "measure_seconds": measuring,
            "seconds": step,
            "over_first": step / first,
        }


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws the three curves, relative to their first points, into a file."""
    what = {
        "iterations": "an iteration",
        "replay rows": "a gradient step",
        "reference points": "a vector step",
    }
    figure = Figure(figsize=(10, 2.8), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (of, name) in zip(axes, what.items(), strict=True):
        own = [row for row in rows if row["of"] == of]
        numbers = [row["number"] for row in own]
        ax.plot(numbers, [row["over_first"] for row in own], marker="o", label="measured")
        ax.plot(numbers, [n / numbers[0] for n in numbers], color="0.7", ls="--", label="linear")
        ax.set(xscale="log", yscale="log", xlabel=f"number of {of}", title=name, ylim=(0.7, 15))
        labels = [f"{n:,}" if n < 10**6 else f"{n // 10**6} million" for n in numbers]
        ax.set_xticks(numbers, labels=labels)
        ax.minorticks_off()
    axes[0].set_yticks([1, 2, 5, 10], labels=["1", "2", "5", "10"])
    axes[0].set_ylabel("time over the first")
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--figure", type=Path, help="draw the curves into this file")
    args = flags.parse_args()
    runtime.prepare(simulates_in_jax=False)
    common.print_versions()
    settings: dict[str, Any] = {"name": "quick", "env": "ant", "mixture_episodes": EPISODES}
    numbers: tuple[Any, Any, Any, int] = ITERATIONS, ROWS, POINTS, MEASURED
    if args.toy:
        settings = {"name": "smoke", "env": "ant"}
        numbers = (1, 2), (1_000, 2_000), (256, 512), 1_000
    counts, rows, points, measured = numbers
    found = []
    for row in itertools.chain(
        policies(settings, counts, args.repeats),
        replay_rows(settings, rows, args.repeats),
        reference_points(settings, points, measured, args.repeats),
    ):
        common.emit(row)
        found.append(row)
    if args.figure:
        draw(found, args.figure)


if __name__ == "__main__":
    main()
