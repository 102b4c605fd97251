"""The largest smoothed entropy of any policy of a tabular MDP, with a certified accuracy."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize, sparse

from maxent_jax.theory import tabular
from maxent_jax.theory.mdps import Mdp

# Scales of the objective and tolerances of the solver, in the order of trial: none suits all MDPs.
ATTEMPTS = ((1e4, 1e-10), (1e3, 1e-12), (1e4, 1e-12), (1e2, 1e-13))
MAX_STEPS = 500


class OptimumError(RuntimeError):
    """The solver did not reach the tolerance."""


class _Problem(NamedTuple):
    """The unknowns are the occupancies of U triples: a layer, a reachable state and an action."""

    flow: sparse.csr_array  # [V, U] out of a layer's state minus into it
    begun: np.ndarray  # [V] where episodes begin
    total: sparse.csr_array  # [S, U] to the states
    first: np.ndarray  # [U] of the uniform policy
    visited: np.ndarray  # [L, S, A] bool, U of them true


class Optimum(NamedTuple):
    """A policy, and by how much any other can be better."""

    policy: np.ndarray  # [L, S, A]
    occupancy: np.ndarray  # [S]
    objective: float  # H_σ of the occupancy, nats
    duality_gap: float  # the optimum exceeds `objective` by no more than this, nats


def solve(mdp: Mdp, smoothing: float, tolerance: float = 1e-8) -> Optimum:
    """Finds the optimum of H_σ by convex optimisation over occupancies (SciPy's trust-constr).

    Occupancies x(l, s, a) >= 0 form a polytope: the flow into a state equals the flow out of it.
    H_σ is concave on it. The solver's point is turned into a policy with exact occupancy d. As H_σ
    is concave, no policy's H_σ exceeds that of d by more than max_π <d_π - d, ∇H_σ(d)>. Planning
    bounds this duality gap, so it is certain whatever the solver did.

    Args:
      smoothing: σ.
      tolerance: of the duality gap, nats.
    Returns:
      The optimum, with its duality gap.
    Raises:
      ValueError: σ <= 0 or tolerance <= 0.
      OptimumError: no attempt reached the tolerance.
    """
    for name, value in (("smoothing", smoothing), ("tolerance", tolerance)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} is {value}, but must be a positive number")
    problem, found = _problem(mdp), []
    for scale, precision in ATTEMPTS:
        found.append(_certify(mdp, _attempt(problem, smoothing, scale, precision), smoothing))
        if found[-1].duality_gap <= tolerance:
            return found[-1]
    nearest = min(optimum.duality_gap for optimum in found)
    raise OptimumError(f"the duality gap is {nearest:.1e}, above the tolerance of {tolerance:.1e}")


def duality_gap(mdp: Mdp, occupancy: np.ndarray, smoothing: float) -> float:
    """Returns a bound on how far any policy's H_σ exceeds that of an occupancy [S], nats."""
    # Twice as many steps as elsewhere, so that planning does not limit the accuracy of the gap.
    steps = 2 * tabular.converged_steps(mdp)
    with tabular.float64():
        return float(_gap(tabular.on_device(mdp), jnp.asarray(occupancy), smoothing, steps))


@functools.partial(jax.jit, static_argnames="steps")
def _gap(mdp, occupancy, smoothing, steps):
    reward = tabular.gradient(occupancy, smoothing)
    return tabular.best_value(mdp, reward, steps) - reward @ occupancy


@jax.jit
def _evaluate(mdp, policy, smoothing):
    occupancy = tabular.occupancy(mdp, policy)
    return occupancy, tabular.objective(occupancy, smoothing)


def _attempt(problem: _Problem, smoothing: float, scale: float, precision: float) -> np.ndarray:
    """[L, S, A] occupancies that nearly maximise the objective."""
    num_states = problem.total.shape[0]  # scales the unknowns to about 1

    def of(function, x, factor):
        return -scale * factor * function(problem.total @ x / num_states, smoothing)

    def hessian(x):
        diagonal = sparse.diags_array(of(_curvature, x, 1 / num_states**2))
        return problem.total.T @ diagonal @ problem.total

    begun = num_states * problem.begun
    solved = optimize.minimize(
        lambda x: of(_objective, x, 1),
        num_states * problem.first,
        jac=lambda x: problem.total.T @ of(_gradient, x, 1 / num_states),
        hess=hessian,
        method="trust-constr",
        bounds=optimize.Bounds(0, np.inf),
        constraints=optimize.LinearConstraint(problem.flow, begun, begun),
        options={
            "gtol": precision,
            "xtol": 1e-16,
            "barrier_tol": precision / 10,
            "maxiter": MAX_STEPS,
        },
    )
    occupancies = np.zeros(problem.visited.shape)
    occupancies[problem.visited] = np.maximum(solved.x, 0)
    return occupancies


def _certify(mdp: Mdp, occupancies: np.ndarray, smoothing: float) -> Optimum:
    visits = occupancies.sum(-1, keepdims=True)
    share = np.divide(occupancies, visits, where=visits > 0, out=np.ones_like(occupancies))
    policy = share / share.sum(-1, keepdims=True)
    with tabular.float64():
        found = _evaluate(tabular.on_device(mdp), jnp.asarray(policy), smoothing)
    occupancy = np.asarray(found[0])
    return Optimum(policy, occupancy, float(found[1]), duality_gap(mdp, occupancy, smoothing))


def _problem(mdp: Mdp) -> _Problem:
    num_layers, (num_states, num_actions, most) = len(mdp.discount), mdp.successors.shape
    size = num_layers * num_states
    layer, state, action, which = np.indices((num_layers, num_states, num_actions, most)).reshape(
        4, -1
    )
    entering = mdp.discount[layer] * mdp.probabilities[state, action, which]
    row = mdp.next_layer[layer] * num_states + mdp.successors[state, action, which]
    column = (layer * num_states + state) * num_actions + action
    of_actions = sparse.kron(sparse.eye_array(size), np.ones((1, num_actions)), format="csr")
    arrivals = sparse.csr_array((entering, (row, column)), (size, size * num_actions))

    begun = np.zeros(size)
    begun[:num_states] = mdp.start
    visited = _closure(begun > 0, arrivals @ of_actions.T)
    flow = (of_actions - arrivals)[visited][:, np.repeat(visited, num_actions)]
    spread = of_actions[visited][:, np.repeat(visited, num_actions)].T / num_actions
    visits = sparse.linalg.spsolve(sparse.csc_array(flow @ spread), begun[visited])
    length = visits.sum()
    over_layers = sparse.kron(np.ones((1, num_layers)), sparse.eye_array(num_states)) @ of_actions
    shape = num_layers, num_states, num_actions
    return _Problem(
        flow,
        begun[visited] / length,
        sparse.csr_array(over_layers)[:, np.repeat(visited, num_actions)],
        spread @ visits / length,
        np.broadcast_to(visited.reshape(shape[:2])[..., None], shape),
    )


def _closure(visited: np.ndarray, arrivals: sparse.sparray) -> np.ndarray:
    """[L S] the reachable states: the solver needs an interior, which the others lack."""
    while True:
        reached = visited | (arrivals @ visited > 0)
        if (reached == visited).all():
            return visited
        visited = reached


# H_σ and its derivatives. Below 0, where the solver's steps may lead, they use the expansion at 0.
def _objective(occupancy: np.ndarray, smoothing: float) -> float:
    inside, beyond = np.maximum(occupancy, 0), np.minimum(occupancy, 0)
    continued = beyond * np.log(smoothing) + beyond**2 / smoothing
    return -(inside * np.log(inside + smoothing) + continued).sum()


def _gradient(occupancy: np.ndarray, smoothing: float) -> np.ndarray:
    inside, beyond = np.maximum(occupancy, 0), np.minimum(occupancy, 0)
    total = inside + smoothing
    return -np.log(total) - inside / total - 2 * beyond / smoothing


def _curvature(occupancy: np.ndarray, smoothing: float) -> np.ndarray:
    inside = np.maximum(occupancy, 0)
    return -(inside + 2 * smoothing) / (inside + smoothing) ** 2
