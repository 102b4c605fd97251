"""MaxEnt-H, LA and V in a tabular MDP: the rows of `config.registry.METHODS`, with exact oracles.

An iteration is that of Algorithm 1. The mixture's occupancy defines the reward (the gradient of
H_σ), a planner makes a number of backups from its initial values, and its greedy policy is
archived. A *planning step*, one backup of all states, stands for a step of training: a planner with
few of them is like a learner that has not converged.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import mixture
from maxent_jax.config.registry import STARTS, MethodRow
from maxent_jax.theory import tabular
from maxent_jax.theory.mdps import Mdp


class Settings(NamedTuple):
    """Settings of a run, in addition to its method."""

    num_iterations: int  # T: policies after the first
    planning_steps: int  # in an iteration
    smoothing: float  # σ
    eta: float = 0.1  # η, for weights that use it
    density_noise: float = 0.0  # ε₀: error of every state's density, randomly up or down
    planning_noise: float = 0.0  # ε₁: value that the planner loses, towards the worst policy, nats


class Trace(NamedTuple):
    """The measures of a run for N seeds and P = T + 1 mixtures, the first of one policy."""

    objective: np.ndarray  # [N, P] H_σ of the mixture, nats
    entropy: np.ndarray  # [N, P] of the mixture, without smoothing
    history_objective: np.ndarray  # [N, P] H_σ of the history; NaN where it is not the reference
    density_error: np.ndarray  # [N, T] largest difference of a density from the mixture's
    planning_error: np.ndarray  # [N, T] bounds the value lost under the last reward, nats
    mixture: np.ndarray  # [N, S] occupancy of the last mixture


def recursive_weights(n: int, eta: float) -> np.ndarray:
    """Returns weights [n] by which the newest policy gets η, and the others shrink by 1 - η.

    The bound holds for these; `mixture.geometric_weights` are those of the official code.

    Source: Hazan et al. 2019, Algorithm 1.
    """
    return np.where(np.arange(n) > 0, eta, 1.0) * (1 - eta) ** np.arange(n - 1, -1, -1)


def linear_weights(n: int) -> np.ndarray:
    """Returns Frank-Wolfe weights [n] for step 2/(t + 2): proportional to 1 ... n, oldest first."""
    return np.arange(1, n + 1) / (n * (n + 1) / 2)


WEIGHTS: dict[str, Callable[[int, float], np.ndarray]] = {
    "uniform": lambda n, eta: mixture.uniform_weights(n),
    "geometric": mixture.geometric_weights,
    "recursive": recursive_weights,
    "linear": lambda n, eta: linear_weights(n),
}


def run(mdp: Mdp, row: MethodRow, settings: Settings, first: np.ndarray, keys: jax.Array) -> Trace:
    """Runs a method from several first policies in parallel.

    Args:
      mdp: one for all seeds, or one for each, with a leading axis [N] (mdps.stack).
      row: a row of config.registry.METHODS. Its refresh period counts planning steps, and its
        weights may be any of WEIGHTS. The history is the mean occupancy of the first policy and of
        the agent's greedy policy after each planning step.
      settings: of the run.
      first: [N, L, S, A] π_0 of each seed.
      keys: [N] typed keys for the noise.
    Returns:
      The trace of all seeds.
    Raises:
      ValueError: a size is below 1, the smoothing is not positive, a noise is negative, or the row
        holds an unknown word.
    """
    _check(row, settings)
    capacity = settings.num_iterations + 1
    table = np.zeros((capacity, capacity))
    for n in range(1, capacity + 1):
        table[n - 1, :n] = WEIGHTS[row.weights](n, settings.eta)
    shape = _Shape(
        settings.num_iterations,
        settings.planning_steps,
        keeps_history=row.reference == "history",
        plans_badly=settings.planning_noise > 0,
    )
    with tabular.float64():
        numbers = _Numbers(
            weights=jnp.asarray(table),
            refresh_period=jnp.asarray(row.refresh_period),
            start=jnp.asarray(STARTS.index(row.start)),
            smoothing=jnp.asarray(settings.smoothing),
            density_noise=jnp.asarray(settings.density_noise),
            planning_noise=jnp.asarray(settings.planning_noise),
        )
        trace = _seeds(tabular.on_device(mdp), jnp.asarray(first), keys, numbers, shape)
        found = Trace(*(np.asarray(field) for field in trace))
    if shape.keeps_history:
        return found
    return found._replace(history_objective=np.full_like(found.objective, np.nan))


class _Shape(NamedTuple):
    """What the compiled program depends on."""

    num_iterations: int
    planning_steps: int
    keeps_history: bool
    plans_badly: bool


class _Numbers(NamedTuple):
    """A method and its settings as data."""

    weights: jax.Array  # [P, P]
    refresh_period: jax.Array
    start: jax.Array  # index into STARTS
    smoothing: jax.Array
    density_noise: jax.Array
    planning_noise: jax.Array


class _Agent(NamedTuple):
    """What planning carries from step to step."""

    values: jax.Array  # [L, S]
    reward: jax.Array  # [S]
    density: jax.Array  # [S] that the reward comes from
    history: jax.Array  # [S] mean occupancy so far
    age: jax.Array  # of the history, policies


class _State(NamedTuple):
    agent: _Agent
    occupancies: jax.Array  # [P, S] of the archived policies
    archive: jax.Array  # [P, L, S] their values


@functools.partial(jax.jit, static_argnames="shape")
def _seeds(mdp, first, keys, numbers, shape):
    of_each = 0 if mdp.start.ndim == 2 else None
    one = functools.partial(_run, numbers=numbers, shape=shape)
    return jax.vmap(one, in_axes=(of_each, 0, 0))(mdp, first, keys)


def _run(mdp, first, key, numbers, shape):
    occupied = tabular.occupancy(mdp, first)
    capacity = shape.num_iterations + 1
    zeros = jnp.zeros((first.shape[0], first.shape[1]))
    state = _State(
        _Agent(zeros, occupied, occupied, occupied, jnp.ones(())),
        jnp.zeros((capacity, len(occupied))).at[0].set(occupied),
        jnp.zeros((capacity, *zeros.shape)),
    )

    def body(state, t):
        state, errors = _iterate(mdp, numbers, shape, state, t, jax.random.fold_in(key, t))
        return state, (_measure(numbers, state, t + 1), errors)

    begin = _measure(numbers, state, 0)
    state, (measures, errors) = jax.lax.scan(body, state, jnp.arange(shape.num_iterations))
    whole = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), begin, measures)
    return *whole, *errors, numbers.weights[-1] @ state.occupancies


def _measure(numbers, state, t):
    mixed = numbers.weights[t] @ state.occupancies
    return (
        tabular.objective(mixed, numbers.smoothing),
        tabular.objective(mixed, 0.0),
        tabular.objective(state.agent.history, numbers.smoothing),
    )


def _iterate(mdp, numbers, shape, state, t, key):
    mixed = numbers.weights[t] @ state.occupancies
    signs = jax.random.rademacher(key, mixed.shape, mixed.dtype)

    def refreshed(agent):
        reference = agent.history if shape.keeps_history else mixed
        density = jnp.maximum(reference + numbers.density_noise * signs, 0)
        return agent._replace(reward=tabular.gradient(density, numbers.smoothing), density=density)

    agent = refreshed(state.agent)
    agent = agent._replace(values=_start(numbers, state, agent.reward, t))
    agent = _train(mdp, numbers, shape, agent, refreshed)
    occupied, lost = _next_occupancy(mdp, numbers, shape, agent)
    state = _State(
        agent, state.occupancies.at[t + 1].set(occupied), state.archive.at[t + 1].set(agent.values)
    )
    return state, (jnp.abs(agent.density - mixed).max(), lost)


def _start(numbers, state, reward, t):
    """The values that planning starts from, in the order of STARTS."""
    archived = jnp.arange(len(state.occupancies)) <= t
    best = jnp.where(archived, state.occupancies @ reward, -jnp.inf).argmax()
    values = state.agent.values
    return jnp.stack([jnp.zeros_like(values), values, state.archive[best]])[numbers.start]


def _train(mdp, numbers, shape, agent, refreshed):
    period = numbers.refresh_period

    def step(i, agent):
        if shape.keeps_history:  # the mixture does not change within an iteration
            due = (period > 0) & (i % jnp.maximum(period, 1) == 0)
            agent = jax.tree.map(lambda a, b: jnp.where(due, a, b), refreshed(agent), agent)
        agent = agent._replace(values=tabular.plan(mdp, agent.reward, agent.values, 1))
        return _visit(mdp, agent) if shape.keeps_history else agent

    return jax.lax.fori_loop(0, shape.planning_steps, step, agent)


def _visit(mdp, agent):
    """Adds the occupancy of the agent's policy to its history."""
    occupied = tabular.greedy_occupancy(mdp, agent.reward, agent.values)
    change = (occupied - agent.history) / (agent.age + 1)
    return agent._replace(history=agent.history + change, age=agent.age + 1)


def _next_occupancy(mdp, numbers, shape, agent):
    """The occupancy to archive, and a bound on the value that it loses under the last reward."""
    best = tabular.greedy_occupancy(mdp, agent.reward, agent.values)
    lost = tabular.planning_loss(mdp, agent.reward, agent.values)
    if not shape.plans_badly:
        return best, lost
    opposite = tabular.plan(mdp, -agent.reward, jnp.zeros_like(agent.values), shape.planning_steps)
    worst = tabular.greedy_occupancy(mdp, -agent.reward, opposite)
    share = jnp.minimum(numbers.planning_noise / ((best - worst) @ agent.reward), 1)
    return best + share * (worst - best), lost + share * ((best - worst) @ agent.reward)


def _check(row: MethodRow, settings: Settings) -> None:
    for name in ("num_iterations", "planning_steps"):
        if getattr(settings, name) < 1:
            raise ValueError(f"{name} is {getattr(settings, name)}, but must be at least 1")
    if not 0 < settings.smoothing < np.inf:
        raise ValueError(f"smoothing is {settings.smoothing}, but must be a positive number")
    for name in ("density_noise", "planning_noise"):
        if not 0 <= getattr(settings, name) < np.inf:
            raise ValueError(f"{name} is {getattr(settings, name)}, but must be 0 or more")
    known = {"weights": WEIGHTS, "reference": ("mixture", "history"), "start": STARTS}
    for name, words in known.items():
        if getattr(row, name) not in words:
            raise ValueError(
                f"unknown {name} '{getattr(row, name)}': choose from {', '.join(words)}"
            )
