"""Loads a run, rolls out its mixture again, and reports what it covers.

Prints a table and writes evaluation.json and figures/ into the run's directory, for --seed-index 1
evaluation_seed_1.json and figures/seed_1/. With --gymnasium it also rolls out the policies in
Gymnasium's own environment and reports the sim-to-sim gap.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from maxent_jax.checks import check_seed
from maxent_jax.commands import cli
from maxent_jax.runs import atomic, files, integrity, runtime
from maxent_jax.visual import headless

if TYPE_CHECKING:
    from maxent_jax.analysis import Run


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Evaluate a run: entropy, coverage, and the returns of each policy."""

    directory: Annotated[Path, tyro.conf.Positional]
    """The run's directory."""
    episodes: int = 5
    """Episodes per policy."""
    seed: int = 1
    """Seed of the rollouts; training evaluates with seed 0."""
    seed_index: int = 0
    """Which seed to evaluate, from 0, if the run trained several."""
    gymnasium: bool = False
    """Also roll out as many episodes in Gymnasium (ant, walker2d, humanoid; C MuJoCo, float64)."""
    fallback: bool = False
    """If the last checkpoint is damaged, use the one before."""
    modules: cli.Modules = ()
    """Module, by name or path, that registers your environments, bonuses or methods."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then loads jax.

    Raises:
      UsageError: an argument is invalid.
    """
    cli.import_modules(argv)
    arguments = cli.parse(Arguments, argv, "evaluate")
    cli.check_least("--episodes", arguments.episodes)
    check_seed("--seed", arguments.seed)
    config = files.read_config(arguments.directory)
    config.check_registered()
    integrity.check_any(arguments.directory)
    files.check_writable(arguments.directory)
    headless.draw_nothing()
    runtime.start(config.simulates_in_jax)
    if arguments.gymnasium:
        from maxent_jax.analysis import gymnasium_play

        gymnasium_play.make(config).close()  # fails here rather than after the rollouts
    report = evaluate(arguments)
    atomic.write_json(files.evaluation(arguments.directory, arguments.seed_index), report)
    _print(report)


def evaluate(arguments: Arguments) -> dict[str, Any]:
    """Returns the report as JSON-ready data, and draws the figures."""
    import jax.numpy as jnp

    from maxent_jax import analysis
    from maxent_jax.density import histogram
    from maxent_jax.visual import plotting

    run = analysis.load_run(arguments.directory, arguments.seed_index, arguments.fallback)
    visited, by_policy = run.occupancies(arguments.episodes, arguments.seed)
    plotting.save_all(run, visited, by_policy)
    return {
        "run": str(run.path),
        "trained_with_seed": run.seed,
        "episodes_per_policy": arguments.episodes,
        "rollout_seed": arguments.seed,
        "reward": run.config.intrinsic.reward,
        "coordinates": run.components.grid.names,
        "deviations_from_the_paper": run.config.deviations(),
        "policies": [s._asdict() for s in run.summaries(by_policy, arguments.seed)],
        "training_coverage": int((run.histogram > 0).sum()),
        "training_entropy": float(histogram.shannon_entropy(jnp.asarray(run.histogram))),
        **(
            {"random_coverage": int((run.random_histogram > 0).sum())}
            if run.config.evaluation.random_baseline
            else {}
        ),
        **run.measures(visited, arguments.seed),
        **({"gymnasium": _gap(run, arguments)} if arguments.gymnasium else {}),
    }


def _gap(run: "Run", arguments: Arguments) -> dict[str, Any]:
    from maxent_jax.analysis import gymnasium_play

    measured = gymnasium_play.gap(run, arguments.episodes, arguments.seed)
    return {
        "environment": gymnasium_play.IDS[run.config.env],
        "sets_of_our_own": gymnasium_play.NUM_SETS,
        "measures": {name: gap._asdict() for name, gap in measured.items()},
    }


def _print(report: dict[str, Any]) -> None:
    policies = report["policies"]
    ends = ", ".join(report["coordinates"])
    print(f"policy  weight   return  reward/step  length  mean end: {ends}")
    for p in policies:
        print(
            f"{p['policy']:6d}  {p['weight']:6.3f}  {p['episode_return']:7.1f}"
            f"  {p['step_reward']:11.3f}  {p['episode_length']:6.0f}"
            f"  {p['mean_end'][0]:8.2f} {p['mean_end'][1]:8.2f}"
        )
    for name, value in report.items():
        if isinstance(value, int | float):
            print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value:,}")
    if "gymnasium" in report:
        _print_gap(report["gymnasium"])


def _print_gap(report: dict[str, Any]) -> None:
    num_sets, environment = report["sets_of_our_own"], report["environment"]
    print(f"in our simulator (mean of {num_sets} sets of episodes) and in {environment}:")
    print(f"{'':29}ours  Gymnasium  difference  by chance")
    for name, gap in report["measures"].items():
        print(
            f"{name:25}  {gap['ours']:6.4g}  {gap['gymnasium']:9.4g}"
            f"  {gap['difference']:10.3g}  {gap['chance']:9.3g}"
        )
