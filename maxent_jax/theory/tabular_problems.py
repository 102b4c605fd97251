"""The MDPs of the command `theory`, their optima and bounds, and runs compared with these."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.config.registry import MethodRow
from maxent_jax.errors import UsageError
from maxent_jax.theory import bounds, loop, mdps, optimum, tabular
from maxent_jax.theory.mdps import Dynamics, Mdp

FIT_FROM = 10  # the first iteration of the fit of the rate


class Problem(NamedTuple):
    """An MDP for each of N seeds, with the optimum, the bounds' constants and first policies."""

    name: str
    mdps: list[Mdp]  # one for all seeds, or one for each
    smoothing: float
    best: list[optimum.Optimum]  # one for each of `mdps`
    first: np.ndarray  # [N, L, S, A]
    keys: jax.Array  # [N]

    @property
    def num_states(self) -> int:
        """|S|, the number of states."""
        return len(self.mdps[0].start)

    @property
    def constants(self) -> tuple[float, float]:
        """B and β of the smoothed entropy."""
        return (
            bounds.objective_range(self.num_states, self.smoothing),
            bounds.smoothness(self.smoothing),
        )

    @property
    def mdp(self) -> Mdp:
        """The MDP in the form that `loop.run` takes."""
        return self.mdps[0] if len(self.mdps) == 1 else mdps.stack(self.mdps)

    @property
    def objective(self) -> np.ndarray:
        """The largest H_σ of each seed, [N] nats."""
        each = [found.objective for found in self.best]
        return np.array(each * (len(self.first) // len(each)))

    @property
    def optimal_occupancy(self) -> np.ndarray:
        """The optimal occupancy of each seed, [N, S]."""
        each = [found.occupancy for found in self.best]
        return np.array(each * (len(self.first) // len(each)))

    def reward_at_optimum(self) -> np.ndarray:
        """Returns the gradient of H_σ at the optimum, [N, S]: the worth of each state there."""
        with tabular.float64():
            return np.asarray(tabular.gradient(jnp.asarray(self.optimal_occupancy), self.smoothing))

    @property
    def converged(self) -> int:
        """Number of planning steps until values have converged."""
        return tabular.converged_steps(self.mdps[0])

    def seeds(self, number: int) -> "Problem":
        """Returns the problem with its first `number` seeds."""
        some = slice(None, number)
        kept = slice(None, number if len(self.mdps) > 1 else None)
        return self._replace(
            mdps=self.mdps[kept], best=self.best[kept], first=self.first[some], keys=self.keys[some]
        )


def make(
    name: str, of_seeds: Sequence[Mdp], num_seeds: int, seed: int, tolerance: float
) -> Problem:
    """Makes a problem with σ = 1/|S|, so that β = 2|S|, and with random first policies.

    Raises:
      UsageError: the optimum was not found within the tolerance.
    """
    smoothing = 1 / len(of_seeds[0].start)
    try:
        best = [optimum.solve(mdp, smoothing, tolerance) for mdp in of_seeds]
    except optimum.OptimumError as missed:
        raise UsageError(f"{name}: {missed}: set a larger --tolerance.") from None
    keys = jax.random.split(jax.random.key(seed), num_seeds)
    with tabular.float64():
        device = tabular.on_device(of_seeds[0])
        draw = jax.jit(jax.vmap(lambda key: tabular.random_policy(device, key)))
        first = np.asarray(draw(keys))
    return Problem(name, list(of_seeds), smoothing, best, first, keys)


def known(num_seeds: int, discount: float, toy: bool) -> dict[str, list[Mdp]]:
    """Returns MDPs by name: one for all seeds, or one per seed for Garnet."""
    some: dict[str, list[Dynamics]] = {
        "river swim": [mdps.river_swim()],
        "Garnet": [mdps.garnet(20, 4, 3, seed) for seed in range(num_seeds)],
        "four rooms": [mdps.four_rooms()],
        "small rooms": [mdps.four_rooms(11)],
        "open grid": [mdps.open_grid()],
    }
    if toy:  # all of one shape, so that each program is compiled once
        some = {"river swim": [mdps.river_swim()], "Garnet": [mdps.garnet(6, 2, 3, 0)]}
    made = {name: [mdps.discounted(each, discount) for each in some[name]] for name in some}
    if not toy:
        made["double chain"] = [mdps.finite_horizon(mdps.double_chain(), 20)]
    return made


def read(path: Path, discount: float) -> Mdp:
    """Reads a user's MDP from an .npz file with `transitions` [S, A, S] and `start` [S].

    Raises:
      UsageError: the file cannot be read, or holds no MDP.
    """
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            return mdps.discounted(Dynamics(file["transitions"], file["start"]), discount)
    except OSError as mistake:
        raise UsageError(f"--mdp {path} cannot be read: {mistake.strerror or mistake}.") from None
    except (EOFError, TypeError, zipfile.BadZipFile):  # TypeError: an .npy file
        raise UsageError(
            f"--mdp {path} is not an .npz file: save it with numpy.savez(path, transitions=..., "
            f"start=...)."
        ) from None
    except (KeyError, ValueError) as mistake:
        raise UsageError(f"--mdp {path} holds no MDP: {str(mistake).strip(chr(39))}.") from None


def run(problem: Problem, row: MethodRow, iterations: int, **options: Any) -> loop.Trace:
    """Runs the method on the problem; planning converges unless `options` say otherwise."""
    settings = loop.Settings(
        **({"planning_steps": problem.converged} | options),
        num_iterations=iterations,
        smoothing=problem.smoothing,
    )
    return loop.run(problem.mdp, row, settings, problem.first, problem.keys)


def gaps(problem: Problem, objective: np.ndarray) -> np.ndarray:
    """Returns the gap to the optimum of `objective` [N, P], [N, P] nats."""
    return problem.objective[:, None] - objective


def checkpoints(iterations: int) -> np.ndarray:
    """Returns the iterations at which curves are kept [C], equally spaced in their logarithm."""
    return np.unique(np.geomspace(1, iterations, 40).round().astype(int))


def veritas_bounds(
    problem: Problem, trace: loop.Trace, times: np.ndarray, form: str = "tight"
) -> np.ndarray:
    """Returns Theorem 1's bound after `times` [C] iterations, [N, C], with the run's errors."""
    of_range, beta = problem.constants
    return np.array(
        [
            [
                # The mixture after n iterations is that of Theorem 1 for T = n - 1.
                bounds.veritas_epsilon(n - 1, of_range, beta, density[:n], planning[:n], form)
                for n in times
            ]
            for density, planning in zip(
                trace.density_error.tolist(), trace.planning_error.tolist(), strict=True
            )
        ]
    )


def hazan_bounds(problem: Problem, trace: loop.Trace, times: np.ndarray, eta: float) -> np.ndarray:
    """Returns the bound of MaxEnt-H after `times` [C] iterations, [N, C]."""
    of_range, beta = problem.constants
    errors = zip(trace.density_error.max(1), trace.planning_error.max(1), strict=True)
    return np.array(
        [[bounds.hazan_epsilon(n, of_range, beta, eta, *worst) for n in times] for worst in errors]
    )
