"""Policies that depend on the episode so far, exactly, in small MDPs of a finite horizon.

A *history* is the current state and the number of visits to each state, this one included. The
entropy of a trajectory's visits depends on the last history alone. So the best policy that sees
histories is as good as any that sees the whole episode, and dynamic programming finds it.
"""

from typing import NamedTuple

import numpy as np
from scipy import special

from maxent_jax.theory.mdps import Mdp

MOST = 500_000  # histories, for which each computation takes seconds


class Histories(NamedTuple):
    """The X histories that an episode of L steps can reach, in order of time.

    As in mdps.Mdp, an action has N successors.
    """

    state: np.ndarray  # [X] int
    counts: np.ndarray  # [X, S] float64, visits
    following: np.ndarray  # [X, A, N] int, the history after each successor
    probabilities: np.ndarray  # [X, A, N] float64, of each successor; 0 for padding
    start: np.ndarray  # [X₀] float64, of the first step's histories
    times: list[slice]  # L slices of X, one per step


class Visits(NamedTuple):
    """What each of P policies visits."""

    trajectory_entropy: np.ndarray  # [P] expected entropy of a single trajectory's visits, nats
    occupancy: np.ndarray  # [P, S] each state's expected share of the steps


def enumerate_all(mdp: Mdp) -> Histories:
    """Enumerates the histories of an MDP of finite horizon.

    Raises:
      ValueError: the MDP is discounted, or has more than MOST histories.
    """
    if mdp.discount[-1] > 0:
        raise ValueError("the MDP is discounted, but must have a finite horizon")
    begun = np.flatnonzero(mdp.start)
    layers = [np.column_stack([np.eye(len(mdp.start), dtype=np.int16)[begun], begun])]
    following, total = [], len(begun)
    for _ in mdp.discount[1:]:
        reached, rows = _step(mdp, layers[-1])
        following.append(total + reached)
        layers.append(rows)
        total += len(rows)
        if total > MOST:
            raise ValueError(f"there are more than {MOST:,} histories: shorten the horizon")
    following.append(np.zeros((len(layers[-1]), *mdp.successors.shape[1:]), int))
    rows = np.concatenate(layers)
    ends = np.cumsum([len(layer) for layer in layers])
    return Histories(
        rows[:, -1],
        rows[:, :-1].astype(np.float64),
        np.concatenate(following),
        mdp.probabilities[rows[:, -1]],
        mdp.start[begun],
        [slice(end - len(layer), end) for end, layer in zip(ends, layers, strict=True)],
    )


def _step(mdp: Mdp, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The next step's rows of counts and state, and the index [X, A, N] into them."""
    possible = np.nonzero(mdp.probabilities[rows[:, -1]])
    following = rows[possible[0]]
    following[:, -1] = mdp.successors[rows[:, -1]][possible]
    following[np.arange(len(following)), following[:, -1]] += 1
    unique, index = np.unique(following, axis=0, return_inverse=True)
    reached = np.zeros((len(rows), *mdp.successors.shape[1:]), int)
    reached[possible] = index
    return reached, unique


def entropy(counts: np.ndarray) -> np.ndarray:
    """Returns the entropy of counts [..., S] divided by their sum, [...] nats."""
    return special.entr(counts / counts.sum(-1, keepdims=True)).sum(-1)


def best_policy(histories: Histories) -> np.ndarray:
    """Returns a policy [X, A] of the largest expected trajectory entropy.

    Source: Mutti et al. 2022, who show that such a policy can be deterministic, and need not be
    Markovian.
    """
    value = entropy(histories.counts)  # of the last step's histories; replaced for all others
    best = np.zeros(len(value), int)
    for now in reversed(histories.times[:-1]):
        worth = (histories.probabilities[now] * value[histories.following[now]]).sum(-1)
        best[now], value[now] = worth.argmax(-1), worth.max(-1)
    return np.eye(histories.following.shape[1])[best]


def of_markov(histories: Histories, policy: np.ndarray) -> np.ndarray:
    """Returns a policy of step and state as one of histories.

    Args:
      policy: [L, S, A] probabilities.
    Returns:
      [X, A] probabilities.
    """
    return policy[histories.counts.sum(-1).astype(int) - 1, histories.state]


def evaluate(histories: Histories, policies: np.ndarray) -> Visits:
    """Computes what each policy [P, X, A] visits."""
    end = histories.times[-1]
    reached = np.array([_reached(histories, policy)[end] for policy in policies])
    counts = histories.counts[end]
    return Visits(reached @ entropy(counts), reached @ counts / len(histories.times))


def _reached(histories: Histories, policy: np.ndarray) -> np.ndarray:
    """[X] the probability with which an episode reaches each history."""
    reached = np.zeros(len(policy))
    reached[histories.times[0]] = histories.start
    for now in histories.times[:-1]:
        chances = (reached[now, None] * policy[now])[..., None] * histories.probabilities[now]
        reached += np.bincount(histories.following[now].ravel(), chances.ravel(), len(reached))
    return reached
