"""The records that travel between modules, and the one legend of axis letters.

N envs, T time, B batch, D state, A action, F feature, M reference points, K neighbours,
P policies, S seeds. Leading axes come first in every shape; `...` stands for any of them.
"""

from typing import NamedTuple, Protocol

import jax

Metrics = dict[str, jax.Array]
"""Diagnostics by name; nothing in it is needed for the next step."""


class Features(Protocol):
    """phi(s[..., D]) -> [..., F]: the space in which densities are measured."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the features, [F]."""

    def __call__(self, observation: jax.Array, /) -> jax.Array:
        """The features of states."""


class Transition(NamedTuple):
    """One environment step.

    `next_observation` is the true state reached, also where the next episode starts from another.
    Where `valid` is false the simulator left the finite numbers: the step ended its episode, and
    nothing but the count of such steps may use it.
    """

    observation: jax.Array  # [..., D]
    action: jax.Array  # [..., A], in [-1, 1]
    next_observation: jax.Array  # [..., D]
    terminated: jax.Array  # [...] bool: health failed
    truncated: jax.Array  # [...] bool: time limit alone
    valid: jax.Array  # [...] bool


class Distances(NamedTuple):
    """Of a transition's ends to the reference that defines r_t, feature units."""

    reached: jax.Array  # [...] R(s')
    potential: jax.Array  # [...] R(s) in the space of the potential; 0 without shaping
    next_potential: jax.Array  # [...] the same of s'


class Outcomes(NamedTuple):
    """What n steps in a row of one episode brought, the first `taken` of them."""

    features: jax.Array  # [..., n, F] of the state left
    next_features: jax.Array  # [..., n, F] of the state reached
    bonus: jax.Array  # [..., n] episodic term, feature units
    terminated: jax.Array  # [..., n] bool
    distances: Distances  # [..., n]
    taken: jax.Array  # [..., n] bool


class Experience(NamedTuple):
    """What the learner draws from the replay, see experience.py: n steps of one episode."""

    observation: jax.Array  # [..., num_seen] before the first
    action: jax.Array  # [..., A] the first, in [-1, 1]
    next_observation: jax.Array  # [..., num_seen] after the last that was taken
    outcomes: Outcomes  # [..., n]
    row: jax.Array  # [...] int32, of the first step in the replay
