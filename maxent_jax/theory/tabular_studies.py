"""The studies of the command `theory`: each takes problems and returns numbers, ready for JSON."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special, stats

from maxent_jax import rewards
from maxent_jax.config.registry import METHODS, MethodRow
from maxent_jax.theory import bounds, loop, mdps, optimum, peers, reference, tabular
from maxent_jax.theory import tabular_problems as problems
from maxent_jax.theory.tabular_problems import FIT_FROM, Problem

STATES = (2, 10, 100, 1_000, 10_000, 1_000_000)
ETAS = (0.1, 0.01, 0.001)
V, LA, H = (METHODS[name] for name in ("v", "la", "h"))
ARCHIVED_EVERY = 64  # planning steps in an iteration, where planning does not converge


def bound_table() -> list[dict[str, Any]]:
    """Tabulates Prop. 2 and 3, and the T from which Theorem 1 is informative, by |S|."""
    rows = []
    for states in STATES:
        smoothing = 1 / states
        constants = bounds.objective_range(states, smoothing), bounds.smoothness(smoothing)
        half = 0.5 * np.log(states)
        rows.append(
            {
                "states": states,
                "eta_upper_bound": bounds.eta_upper_bound(states),
                "min_iterations": bounds.min_iterations(states),
                "smoothed_from": bounds.veritas_iterations(half, *constants),
                "smoothed_from_printed": bounds.veritas_iterations(half, *constants, "printed"),
                "entropy_from": bounds.informative_iterations(states),
                "entropy_epsilon_at_20": bounds.entropy_epsilon(20, states)[0],
            }
        )
    return rows


def rate(problem: Problem, iterations: int) -> dict[str, Any]:
    """Measures how fast V's gap falls, compares it with Theorem 1, and splits the last gap."""
    started = time.perf_counter()
    trace = problems.run(problem, V, iterations)
    seconds = time.perf_counter() - started
    gap = problems.gaps(problem, trace.objective)
    times = problems.checkpoints(iterations)
    bound = problems.veritas_bounds(problem, trace, times)
    of_range, beta = problem.constants
    return {
        "states": problem.num_states,
        "layers": len(problem.mdps[0].discount),
        "smoothing": problem.smoothing,
        "B": of_range,
        "beta": beta,
        "optimum": problem.objective.mean(),
        "duality_gap": max(found.duality_gap for found in problem.best),
        "planning_error": trace.planning_error.max(),
        "times": times,
        "gap": gap[:, times],
        "tight": bound[0],
        "printed": problems.veritas_bounds(problem, trace, times, "printed")[0],
        "largest_share_of_bound": (gap[:, times] / bound).max(),
        "informative_from": bounds.veritas_iterations(
            0.5 * np.log(problem.num_states), of_range, beta
        ),
        **_slope(gap),
        **_parts(problem, trace, gap[:, -1]),
        "wall_seconds": seconds,
    }


def _slope(gap: np.ndarray) -> dict[str, Any]:
    """Slope of log gap over log T from T = 10 on, least squares: mean over seeds, 95 % interval."""
    times = np.unique(np.geomspace(FIT_FROM, gap.shape[1] - 1, 60).round().astype(int))
    slopes = np.polyfit(np.log(times), np.log(gap[:, times]).T, 1)[0]
    half = stats.t.ppf(0.975, len(slopes) - 1) * stats.sem(slopes)
    return {"slope": slopes.mean(), "slope_interval": [slopes.mean() - half, slopes.mean() + half]}


def _parts(problem: Problem, trace: loop.Trace, gap: np.ndarray) -> dict[str, Any]:
    """The last gap, and its linear share: that of policies which the optimum does not use."""
    reward = problem.reward_at_optimum()
    linear = (reward * (problem.optimal_occupancy - trace.mixture)).sum(1)
    return {"final_gap": gap.mean(), "linear_share": (linear / gap).mean()}


def compare(problem: Problem, iterations: int) -> dict[str, Any]:
    """Compares H, LA, V and the reference rules: their gaps, and the bound of each."""
    covered = lambda trace, times: problems.veritas_bounds(problem, trace, times)
    found = {
        "V": _method(problem, V, iterations, covered),
        # If planning converged at each refresh, LA's reference would be V's mixture. So LA plans
        # with a reward that changes with every planning step, as it is meant to.
        "LA": _method(
            problem, LA, max(FIT_FROM, iterations // 10), covered, planning_steps=ARCHIVED_EVERY
        ),
        "linear weights": _method(problem, V._replace(weights="linear"), iterations),
    }
    for eta in ETAS:
        recursive = H._replace(weights="recursive")
        of_h = lambda trace, times, eta=eta: problems.hazan_bounds(problem, trace, times, eta)
        found[f"H, η = {eta}"] = _method(problem, recursive, iterations, of_h, eta=eta)
        found[f"official H, η = {eta}"] = _method(problem, H, iterations, eta=eta)
    lengths = {"line search": iterations, "fully corrective": min(iterations, 50)}
    for name, rule in reference.RULES.items():
        objective = reference.run(
            problem.mdps[0], rule, problem.first[0], lengths[name], problem.smoothing
        )
        times = problems.checkpoints(lengths[name])
        found[name] = {"times": times, "gap": problem.objective[:1, None] - objective[None, times]}
    return {"states": problem.num_states, "methods": found}


def _method(
    problem: Problem,
    row: MethodRow,
    iterations: int,
    bound: Callable[[loop.Trace, np.ndarray], np.ndarray] | None = None,
    **options: Any,
) -> dict[str, Any]:
    trace = problems.run(problem, row, iterations, **options)
    gap, times = problems.gaps(problem, trace.objective), problems.checkpoints(iterations)
    found = {
        "times": times,
        "gap": gap[:, times],
        "last_tenth": gap[:, -max(1, iterations // 10) :].mean(),
    }
    if row.reference == "history":
        found["history_gap"] = problems.gaps(problem, trace.history_objective)[:, times]
    if bound is not None:
        limit = bound(trace, times)
        found |= {"bound": limit.mean(0), "largest_share_of_bound": (gap[:, times] / limit).max()}
    return found


def refresh(problem: Problem, budget: int) -> dict[str, Any]:
    """Measures the gap after a fixed number of planning steps, by steps between two refreshes."""
    periods = [2**i for i in range(10) if 8 * 2**i <= budget]
    found: dict[str, Any] = {"periods": periods, "budget": budget}
    series: dict[str, list[np.ndarray]] = {
        name: [] for name in ("V", "V from last", "LA", "LA, history")
    }
    for period in periods:
        for name, row in (("V", V), ("V from last", V._replace(start="last"))):
            trace = problems.run(problem, row, budget // period, planning_steps=period)
            series[name].append(problems.gaps(problem, trace.objective)[:, -1])
        steps = max(period, min(ARCHIVED_EVERY, budget // 8))
        row = LA._replace(refresh_period=period)
        trace = problems.run(problem, row, budget // steps, planning_steps=steps)
        series["LA"].append(problems.gaps(problem, trace.objective)[:, -1])
        series["LA, history"].append(problems.gaps(problem, trace.history_objective)[:, -1])
    found["gap"] = {name: np.array(gap) for name, gap in series.items()}  # [periods, N]
    middle = {name: np.median(gap, axis=1) for name, gap in found["gap"].items()}
    # Compared with V whose iterations have as many planning steps as LA's.
    same = periods.index(min(ARCHIVED_EVERY, periods[-1]))
    found["better_until"] = {
        name: max(
            (p for p, gap in zip(periods, middle[name], strict=True) if gap < middle["V"][same]),
            default=0,
        )
        for name in ("LA", "LA, history")
    }
    return found


def noise(problem: Problem, iterations: int) -> list[dict[str, Any]]:
    """Compares V under inexact oracles with Theorem 1 for the same errors."""
    rows = []
    for density in (0.0, 0.003, 0.01, 0.03):
        for planning in (0.0, 0.01, 0.1):
            trace = problems.run(
                problem, V, iterations, density_noise=density, planning_noise=planning
            )
            times = problems.checkpoints(iterations)
            gap = problems.gaps(problem, trace.objective)[:, times]
            bound = problems.veritas_bounds(problem, trace, times)
            rows.append(
                {
                    "density_noise": density,
                    "planning_noise": planning,
                    "gap": gap[:, -1].mean(),
                    "bound": bound[:, -1].mean(),
                    "largest_share_of_bound": (gap / bound).max(),
                }
            )
    return rows


def lost(
    length: int, num_seeds: int, seed: int, tolerance: float, iterations: int
) -> dict[str, Any]:
    """Measures a case in which V loses: one policy is nearly optimal, but π_0 keeps its weight."""
    mdp = mdps.discounted(mdps.river_swim(length), 0.9)
    problem = problems.make("long river swim", [mdp], num_seeds, seed, tolerance)
    found = compare(problem, iterations)["methods"]
    with tabular.float64():
        begun = jax.vmap(lambda policy: tabular.occupancy(tabular.on_device(mdp), policy))
        first = np.asarray(begun(jnp.asarray(problem.first)))
    forever = (problem.reward_at_optimum() * (problem.optimal_occupancy - first)).sum(1)
    return {"length": length, "methods": found, "first_policy_costs": forever.mean()}


def game(problem: Problem, iterations: int, tolerance: float) -> dict[str, Any]:
    """Compares V and EntGame by the entropy itself, without smoothing."""
    one = problem.seeds(1)._replace(first=problem.first, keys=problem.keys)
    # This smoothing changes the entropy by at most 1e-7 nats.
    found_best = optimum.solve(one.mdps[0], 1e-7 / problem.num_states, tolerance)
    with tabular.float64():
        best = float(tabular.objective(jnp.asarray(found_best.occupancy), 0.0))
    times = problems.checkpoints(iterations)
    found: dict[str, Any] = {"times": times}
    for share in (1.0, 0.01):
        rough = one._replace(smoothing=share / problem.num_states)
        entropy = problems.run(rough, V, iterations).entropy
        found[f"V, σ = {share:g}/|S|"] = (best - entropy)[:, times]
    for name, sampled in (("EntGame, expected visits", False), ("EntGame, one episode", True)):
        played = peers.ent_game(one.mdps[0], one.first, iterations, 1.0, sampled, one.keys)
        found[name] = (best - played.entropy)[:, times]
    return found


def proposition_1(sizes: tuple[int, ...], neighbors: int = 3) -> list[dict[str, Any]]:
    """Compares LA's reward p log R with H's, for the estimated and the true density of a Gaussian.

    The volume of the k-th neighbour's ball, times N and the density, is distributed about as
    Gamma(k). So, given the density, LA's reward scatters with variance ψ'(k), and the difference of
    the two rewards has mean -ψ(k) + log k.
    """
    rows = []
    for dims in (1, 2, 7):
        for size in sizes:
            key = jax.random.fold_in(jax.random.key(dims), size)
            points = jax.random.normal(key, (size, dims))
            itself = jnp.arange(size)
            la, h = (
                np.asarray(x, np.float64)
                for x in (
                    rewards.knn_reward(points, points, neighbors, form="paper", exclude=itself),
                    rewards.hazan_reward(points, points, neighbors, exclude=itself),
                )
            )
            squared = (np.asarray(points, np.float64) ** 2).sum(1)
            true = 0.5 * squared + 0.5 * dims * np.log(2 * np.pi) - 1  # -log p - 1
            line = np.polyfit(true, la, 1)
            rows.append(
                {
                    "dimensions": dims,
                    "samples": size,
                    "slope_of_estimates": np.polyfit(la, h, 1)[0],
                    "estimates_off_the_line": np.ptp(h - la),
                    "slope_to_truth": line[0],
                    "scatter": (la - np.polyval(line, true)).std(),
                    "scatter_predicted": np.sqrt(special.polygamma(1, neighbors)),
                    "offset": (true - h).mean(),
                    "offset_predicted": np.log(neighbors) - special.digamma(neighbors),
                }
            )
    return rows
