"""Compares mixtures with ηψ-learning, exactly, in tabular MDPs of a short horizon.

It is `theory trajectories`: prints tables, and writes the results as JSON.
"""

import dataclasses
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from maxent_jax.checks import check_seed
from maxent_jax.commands import cli
from maxent_jax.runs import atomic, files, progress, runtime


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compare mixtures with policies that see the episode: entropy of a trajectory, of the mean."""

    out: Path = Path("trajectories.json")
    """File for the results, JSON."""
    iterations: int = 100
    """T: iterations of V."""
    episodes: int = 10_000
    """Episodes of a run of ηψ-learning."""
    seeds: int = 10
    """Runs of ηψ-learning."""
    seed: int = 0
    """Seed of everything random."""
    toy: bool = False
    """Quick check: a tiny MDP, few episodes and iterations, whatever the other sizes say."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then computes."""
    arguments = _check(cli.parse(Arguments, argv, "theory trajectories"))
    atomic.check_file(arguments.out)
    runtime.start(simulates_in_jax=False)
    results = atomic.jsonable(study(arguments))
    atomic.write_json(arguments.out, results)
    _print(results)
    print(arguments.out)


def study(arguments: Arguments) -> dict[str, Any]:
    """Runs the study; returns JSON-ready data."""
    import jax

    from maxent_jax.theory import eta_psi, trajectories

    started = time.perf_counter()
    made = trajectories.known(arguments.toy)
    settings = eta_psi.Settings(num_episodes=arguments.episodes)
    keys = jax.random.split(jax.random.key(arguments.seed), arguments.seeds)
    return {
        "settings": dataclasses.asdict(arguments) | {"out": None} | settings._asdict(),
        "versions": files.stack(),
        "mdps": {
            name: trajectories.compare(made[name], arguments.iterations, settings, keys)
            for name in progress.track(list(made), "MDPs")
        },
        "wall_seconds": time.perf_counter() - started,
    }


def _check(arguments: Arguments) -> Arguments:
    """Returns the arguments, with toy sizes if --toy is given."""
    if arguments.toy:
        arguments = dataclasses.replace(arguments, iterations=10, episodes=200, seeds=2)
    for name in ("iterations", "episodes", "seeds"):
        cli.check_least(f"--{name}", getattr(arguments, name))
    check_seed("--seed", arguments.seed)
    return arguments


def _print(results: Mapping[str, Any]) -> None:
    for name, found in results["mdps"].items():
        print(
            f"{name}: |S| {found['states']}, {found['horizon']} steps, {found['histories']:,} "
            f"histories; entropy of a trajectory [lowest and highest run], of the mean"
        )
        for policy, entropies in found["policies"].items():
            runs, means = entropies["of_a_trajectory"], entropies["of_the_mean"]
            spread = f"[{min(runs):.3f}, {max(runs):.3f}]" if len(runs) > 1 else ""
            print(
                f"  {policy:27}  {statistics.mean(runs):.4f}  {spread:14}"
                f"  {statistics.mean(means):.4f}"
            )
    print(f"{results['wall_seconds']:.0f} seconds")
