"""Compares MaxEnt-H, LA and V with their bounds and the exact optimum, in tabular MDPs.

Prints tables, and writes the results as JSON and the figures as PNG. `theory trajectories` is
another study: see commands/trajectories.py.
"""

import dataclasses
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from maxent_jax import errors
from maxent_jax.checks import check_seed
from maxent_jax.commands import cli, trajectories
from maxent_jax.runs import atomic, files, progress, runtime
from maxent_jax.visual import headless

FITTED = ("river swim", "Garnet", "double chain", "four rooms", "open grid")
PLAIN = ("river swim", "Garnet", "double chain", "small rooms")  # where an iteration is cheap
FEWEST = 20  # iterations for the fit of the rate
ON_GRIDS = 300  # iterations of the comparison in the other MDPs
PLANNING_BUDGET, TOY_BUDGET = 4096, 16
SAMPLES, TOY_SAMPLES = (1_000, 10_000, 100_000), (500, 1_000)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compare the methods with their bounds and the exact optimum, in tabular MDPs.

    `theory trajectories` compares mixtures with policies that see the episode; see its --help.
    """

    out: Path = Path("theory.json")
    """File for the results, JSON."""
    figures: Path | None = None
    """Folder for the figures; if left out, that of the results."""
    iterations: int = 1000
    """T: iterations for the fit of the rate."""
    seeds: int = 20
    """First policies, and Garnet MDPs, for the fit of the rate."""
    few_seeds: int = 5
    """First policies elsewhere."""
    seed: int = 0
    """Seed of everything random."""
    discount: float = 0.95
    """γ of the discounted MDPs."""
    tolerance: float = 1e-8
    """Largest duality gap of the optimum, in nats."""
    mdp: Path | None = None
    """Your own MDP instead of the five: .npz with transitions [S, A, S] and start [S]."""
    toy: bool = False
    """Quick check: tiny MDPs and few iterations, whatever the other sizes say."""


def main(argv: Sequence[str]) -> None:
    """Parses and checks the arguments, and only then computes."""
    if list(argv[:1]) == ["trajectories"]:
        trajectories.main(argv[1:])
        return
    arguments = _check(cli.parse(Arguments, argv, "theory"))
    folder = arguments.figures or arguments.out.parent
    atomic.check_file(arguments.out)
    atomic.check_folder(folder)
    headless.draw_nothing()
    runtime.start(simulates_in_jax=False)
    results = atomic.jsonable(study(arguments))
    from maxent_jax.theory import tabular_figures

    atomic.write_json(arguments.out, results)
    paths = tabular_figures.draw(results, folder)
    _print(results)
    print(", ".join(str(path) for path in (arguments.out, *paths)))


def study(arguments: Arguments) -> dict[str, Any]:
    """Runs every study; returns JSON-ready data.

    Raises:
      UsageError: the user's file holds no MDP, or the optimum does not reach the tolerance.
    """
    from maxent_jax.theory import tabular_problems as problems
    from maxent_jax.theory import tabular_studies as studies

    started, track = time.perf_counter(), progress.track
    known = (
        problems.known(arguments.seeds, arguments.discount, arguments.toy)
        if arguments.mdp is None
        else {arguments.mdp.stem: [problems.read(arguments.mdp, arguments.discount)]}
    )
    made = {
        name: problems.make(name, known[name], arguments.seeds, arguments.seed, arguments.tolerance)
        for name in track(list(known), "optima")
    }
    few = {name: problem.seeds(arguments.few_seeds) for name, problem in made.items()}

    def among(*names: str) -> list[str]:
        return [name for name in names if name in made] or list(made)  # a user's own

    T, budget = arguments.iterations, TOY_BUDGET if arguments.toy else PLANNING_BUDGET
    fitted, plain = among(*FITTED), among(*PLAIN)
    noisy, played = among("Garnet")[0], among("double chain")[0]
    results = {
        "settings": dataclasses.asdict(arguments) | {"out": None, "figures": None},
        "versions": files.stack(),
        "bounds": studies.bound_table(),
        "rates": {name: studies.rate(made[name], T) for name in track(fitted, "rates")},
        "methods": {
            name: studies.compare(few[name], T if name in plain else min(T, ON_GRIDS))
            for name in track(fitted, "methods")
        },
        "refresh": {name: studies.refresh(few[name], budget) for name in track(plain, "refresh")},
        "noise": {"on": noisy, "rows": studies.noise(few[noisy], T)},
        "game": {"on": played, "gap": studies.game(few[played], T, arguments.tolerance)},
        "lost": studies.lost(
            6 if arguments.toy else 20, arguments.few_seeds, arguments.seed, arguments.tolerance, T
        ),
        "proposition_1": studies.proposition_1(TOY_SAMPLES if arguments.toy else SAMPLES),
    }
    return results | {"wall_seconds": time.perf_counter() - started}


def _check(arguments: Arguments) -> Arguments:
    """Returns the arguments, with toy sizes if --toy is given."""
    if arguments.toy:
        arguments = dataclasses.replace(arguments, iterations=40, seeds=2, few_seeds=2)
    for wrong, sentence in (
        (
            not 0 < arguments.discount < 1,
            f"--discount is {arguments.discount}, but must be above 0 and below 1.",
        ),
        (
            not 0 < arguments.tolerance < float("inf"),
            f"--tolerance is {arguments.tolerance}, but must be a positive number.",
        ),
        (
            arguments.iterations < FEWEST,
            f"--iterations is {arguments.iterations}, but must be at least {FEWEST}, to fit a "
            f"rate.",
        ),
        (
            arguments.seeds < 2,
            f"--seeds is {arguments.seeds}, but must be at least 2, for an interval.",
        ),
        (
            not 1 <= arguments.few_seeds <= arguments.seeds,
            f"--few-seeds is {arguments.few_seeds}, but must be from 1 to --seeds = "
            f"{arguments.seeds}.",
        ),
    ):
        if wrong:
            raise errors.UsageError(sentence)
    check_seed("--seed", arguments.seed)
    return arguments


def _print(results: Mapping[str, Any]) -> None:
    print("      |S|    η below     H needs T   H_σ, σ = 1/|S|, from T   entropy from T")
    for row in results["bounds"]:
        print(
            f"{row['states']:9,d}  {row['eta_upper_bound']:9.3g}  {row['min_iterations']:12,d}"
            f"  {row['smoothed_from']:23,d}  {row['entropy_from']:15,d}"
        )
    for name, found in results["rates"].items():
        low, high = found["slope_interval"]
        print(
            f"{name}: |S| {found['states']}, optimum {found['optimum']:.4f}, duality gap "
            f"{found['duality_gap']:.1e}; V's gap {found['final_gap']:.2e}, slope "
            f"{found['slope']:.2f} [{low:.2f}, {high:.2f}], linear share "
            f"{found['linear_share']:.2f}; at most {found['largest_share_of_bound']:.2g} of the "
            f"bound, which is below half of log|S| from T = {found['informative_from']:,} on"
        )
    for name, found in (results["methods"] | {"long river swim": results["lost"]}).items():
        print(f"{name}: gap at the end, mean of the last tenth, largest share of the bound")
        for method, curve in found["methods"].items():
            print(f"  {method:20} {_row(curve)}")
    for name, found in results["refresh"].items():
        print(f"{name}: median gap after {found['budget']:,} planning steps by refresh period")
        print(f"  {'':14}" + "".join(f"{period:9d}" for period in found["periods"]))
        for series, gap in found["gap"].items():
            print(f"  {series:14}" + "".join(f"{statistics.median(g):9.1e}" for g in gap))
        print(f"  better than V with LA's iterations up to a period of: {found['better_until']}")
    print(f"{results['noise']['on']}, V: ε₀, ε₁, gap, Theorem 1")
    for row in results["noise"]["rows"]:
        print("  " + "  ".join(f"{row[key]:8.3g}" for key in list(row)[:4]))
    print("Prop. 1: dimensions, samples, slope to the truth, scatter, offset (predicted)")
    for row in results["proposition_1"]:
        print(
            f"  {row['dimensions']}  {row['samples']:7,d}  {row['slope_to_truth']:.3f}"
            f"  {row['scatter']:.3f} ({row['scatter_predicted']:.3f})"
            f"  {row['offset']:.3f} ({row['offset_predicted']:.3f})"
        )


def _row(curve: Mapping[str, Any]) -> str:
    end = statistics.mean(gap[-1] for gap in curve["gap"])
    mean, share = curve.get("last_tenth"), curve.get("largest_share_of_bound")
    return (
        f"T = {curve['times'][-1]:5d}  {end:9.2e}  {'' if mean is None else f'{mean:9.2e}'}"
        f"  {'' if share is None else f'{share:.2g}'}"
    )
