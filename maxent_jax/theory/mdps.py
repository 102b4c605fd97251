"""Tabular MDPs without reward: a user's own, and some from the literature. Needs only NumPy."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

Array = Any  # of NumPy, or of jax after `tabular.on_device`
ROUNDING = 1e-9  # tolerance for probabilities that should sum to one


class Dynamics(NamedTuple):
    """Where actions lead, and where episodes begin."""

    transitions: np.ndarray  # [S, A, S] float64, P(s' | s, a)
    start: np.ndarray  # [S] float64


class Mdp(NamedTuple):
    """Dynamics with a way to count time, in the form that the computations use.

    Policies and values have a leading axis of L layers: one layer for a discounted MDP, whose best
    policies are stationary, and one layer per step for a finite horizon. An episode begins in layer
    0. After a step in layer l it continues in `next_layer[l]` with probability `discount[l]`.
    """

    successors: Array  # [S, A, N] int32, the states that may follow
    probabilities: Array  # [S, A, N] float64, of each successor; 0 for padding
    start: Array  # [S] float64
    next_layer: Array  # [L] int32
    discount: Array  # [L] float64


def discounted(dynamics: Dynamics, discount: float) -> Mdp:
    """Makes a discounted MDP; its occupancy is d(s) = (1 - γ) Σ_t γ^t P(s_t = s), of sum 1.

    Raises:
      ValueError: γ is outside [0, 1), or the dynamics are not probabilities.
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount is {discount}, but must be in [0, 1)")
    return _layered(dynamics, np.zeros(1), np.full(1, float(discount)))


def finite_horizon(dynamics: Dynamics, horizon: int) -> Mdp:
    """Makes an MDP of horizon H with occupancy d(s) = (1/H) Σ_{t < H} P(s_t = s).

    Its policies depend on t.

    Raises:
      ValueError: H < 1, or the dynamics are not probabilities.
    """
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, but must be at least 1")
    steps = np.arange(1, horizon + 1)
    return _layered(dynamics, steps % horizon, (steps < horizon).astype(np.float64))


def garnet(num_states: int, num_actions: int, branching: int, seed: int) -> Dynamics:
    """Makes a random MDP: each action leads to `branching` states with random probabilities.

    It begins in state 0.

    Raises:
      ValueError: a size is below 1, or branching is above num_states.
    Source: Archibald, McKinnon & Thomas 1995.
    """
    sizes = {"num_states": num_states, "num_actions": num_actions, "branching": branching}
    for name, size in sizes.items():
        if size < 1:
            raise ValueError(f"{name} is {size}, but must be at least 1")
    if branching > num_states:
        raise ValueError(f"branching is {branching}, but there are only {num_states} states")
    random = np.random.default_rng(seed)
    transitions = np.zeros((num_states, num_actions, num_states))
    for row in transitions.reshape(-1, num_states):
        cuts = np.sort(random.random(branching - 1))
        row[random.choice(num_states, branching, replace=False)] = np.diff(
            cuts, prepend=0, append=1
        )
    return Dynamics(transitions, _point(num_states, 0))


def double_chain(length: int = 31, failure: float = 0.1) -> Dynamics:
    """Makes a chain that begins in its middle.

    The actions are left and right; one that fails moves in the other direction.

    Raises:
      ValueError: length < 2, or failure outside [0, 1].
    Source: Kaufmann et al. 2021. Tiapkin et al. 2023 use these values and a horizon of 20.
    """
    _check_length(length)
    _check_probability("failure", failure)
    state = np.arange(length)
    left, right = np.maximum(state - 1, 0), np.minimum(state + 1, length - 1)
    transitions = np.zeros((length, 2, length))
    for action, (there, elsewhere) in enumerate(((left, right), (right, left))):
        transitions[state, action, there] += 1 - failure
        transitions[state, action, elsewhere] += failure
    return Dynamics(transitions, _point(length, (length - 1) // 2))


def river_swim(length: int = 6) -> Dynamics:
    """Makes a chain with a current: left always succeeds, right rarely. It begins at the left end.

    Raises:
      ValueError: length < 2.
    Source: Strehl & Littman 2008, with the probabilities that have been in common use since.
    """
    _check_length(length)
    left, right = 0, 1
    transitions = np.zeros((length, 2, length))
    for state in range(length):
        transitions[state, left, max(state - 1, 0)] = 1
        if 0 < state < length - 1:
            transitions[state, right, state - 1 : state + 2] = 0.05, 0.6, 0.35
    transitions[0, right, :2] = 0.4, 0.6
    transitions[-1, right, -2:] = 0.4, 0.6
    return Dynamics(transitions, _point(length, 0))


def open_grid(size: int = 21, success: float = 0.95) -> Dynamics:
    """Makes a square without walls; episodes begin in its centre.

    Each of the four actions moves by one cell. With probability 1 - success the move goes to one of
    the other neighbours, each equally likely. A move out of the square has no effect.

    Raises:
      ValueError: size < 2, or success outside [0, 1].
    Source: the code published with Tiapkin et al. 2023, which uses these values, a horizon of 20,
    and no walls.
    """
    _check_length(size)
    return _grid(np.ones((size, size), bool), (size // 2, size // 2), success)


def four_rooms(size: int = 21, success: float = 0.95) -> Dynamics:
    """Makes the square of `open_grid` with walls along its middle row and column.

    Each of the four pieces of wall has a door. Episodes begin in the centre of the first room.

    Raises:
      ValueError: size is even or below 5, or success is outside [0, 1].
    """
    if size < 5 or size % 2 == 0:
        raise ValueError(f"size is {size}, but must be odd and at least 5")
    middle, door = size // 2, size // 4
    free = np.ones((size, size), bool)
    free[middle], free[:, middle] = False, False
    for place in (door, size - 1 - door):
        free[middle, place], free[place, middle] = True, True
    return _grid(free, (door, door), success)


def _grid(free: np.ndarray, start: tuple[int, int], success: float) -> Dynamics:
    _check_probability("success", success)
    index = np.full(np.add(free.shape, 2), -1)  # with a border
    index[1:-1, 1:-1][free] = np.arange(free.sum())
    rows, columns = np.nonzero(free)
    moves = ((0, -1), (0, 1), (-1, 0), (1, 0))
    neighbors = np.stack([index[rows + 1 + dy, columns + 1 + dx] for dy, dx in moves], axis=1)
    transitions = np.zeros((len(rows), len(moves), len(rows)))
    for state, around in enumerate(neighbors):
        for action, there in enumerate(around):
            others = [s for i, s in enumerate(around) if s >= 0 and i != action]
            if there < 0:
                transitions[state, action, state] = 1
                continue
            transitions[state, action, there] = success if others else 1
            transitions[state, action, others] = (1 - success) / max(len(others), 1)
    return Dynamics(transitions, _point(len(rows), index[start[0] + 1, start[1] + 1]))


def _layered(dynamics: Dynamics, next_layer: np.ndarray, discount: np.ndarray) -> Mdp:
    transitions, start = (np.asarray(x, np.float64) for x in dynamics)
    _check(transitions, start)
    most = int((transitions > 0).sum(-1).max())
    successors = np.argsort(-transitions, axis=-1, kind="stable")[..., :most]
    probabilities = np.take_along_axis(transitions, successors, axis=-1)
    return Mdp(
        successors.astype(np.int32),
        probabilities / probabilities.sum(-1, keepdims=True),
        start / start.sum(),
        next_layer.astype(np.int32),
        discount,
    )


def _check(transitions: np.ndarray, start: np.ndarray) -> None:
    if (
        transitions.ndim != 3
        or transitions.shape[0] != transitions.shape[2]
        or not transitions.size
    ):
        raise ValueError(f"transitions have shape {transitions.shape}, but must be [S, A, S]")
    if start.shape != transitions.shape[:1]:
        raise ValueError(f"start has shape {start.shape}, but there are {len(transitions)} states")
    for name, rows in (("a row of transitions", transitions), ("start", start)):
        off = np.abs(rows.sum(-1) - 1)
        if not ((rows >= 0).all() and (off <= ROUNDING).all()):  # NaN fails too
            raise ValueError(f"{name} must be 0 or more and sum to one, not to 1 ± {off.max():.3g}")


def _point(num_states: int, state: int) -> np.ndarray:
    return np.eye(num_states)[state]


def _check_length(length: int) -> None:
    if length < 2:
        raise ValueError(f"a side of {length} states is too short: at least 2 are needed")


def _check_probability(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"{name} is {value}, but must be in [0, 1]")


def stack(mdps: Sequence[Mdp]) -> Mdp:
    """Stacks MDPs of the same shape: each field gets a leading axis [N].

    Raises:
      ValueError: there are none, or their shapes differ.
    """
    shapes = {tuple(field.shape for field in mdp) for mdp in mdps}
    if len(shapes) != 1:
        raise ValueError(f"{len(mdps)} MDPs of {len(shapes)} shapes cannot be stacked")
    return Mdp(*(np.stack(fields) for fields in zip(*mdps, strict=True)))
