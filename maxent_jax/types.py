"""Records that modules exchange, and the legend of axis letters.

N environments, T time, B batch, D state, A action, F feature, M reference points, K neighbours,
P policies, S seeds. Leading axes come first in every shape; `...` stands for any number of them.
"""

from typing import NamedTuple, Protocol

import jax

Metrics = dict[str, jax.Array]
"""Diagnostics by name. The next step does not depend on them."""


class Features(Protocol):
    """A feature map, [..., D] -> [..., F]: densities are measured in the space of features."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the features, [F]."""

    def __call__(self, observation: jax.Array, /) -> jax.Array:
        """Returns the features [..., F] of states [..., D]."""


class Transition(NamedTuple):
    """One environment step.

    `next_observation` is the state that the step reached, also where the episode ended and the
    next one starts elsewhere. Where `valid` is false, the physics state was not finite: the step
    ends its episode, and is counted but never used.
    """

    observation: jax.Array  # [..., D]
    action: jax.Array  # [..., A], in [-1, 1]
    next_observation: jax.Array  # [..., D]
    terminated: jax.Array  # [...] bool: the episode ended in a terminal state
    truncated: jax.Array  # [...] bool: only the time limit ended it
    valid: jax.Array  # [...] bool
    reward: jax.Array  # [...] the environment's own, for the task `environment`; else unused


class Distances(NamedTuple):
    """Distances from a transition's two states to the reference that defines r_t, feature units."""

    reached: jax.Array  # [...] R(s')
    potential: jax.Array  # [...] R(s) in the shaping's space; 0 without shaping
    next_potential: jax.Array  # [...] the same for s'


class Outcomes(NamedTuple):
    """The results of n consecutive steps of one episode; only the first ones, `taken`, count."""

    features: jax.Array  # [..., n, F] of the state that the step left
    next_features: jax.Array  # [..., n, F] of the state that it reached
    bonus: jax.Array  # [..., n] episodic term, feature units
    terminated: jax.Array  # [..., n] bool
    distances: Distances  # [..., n]
    taken: jax.Array  # [..., n] bool
    task: jax.Array | None = None  # [..., n] the task's reward; None without a task


class Experience(NamedTuple):
    """n steps of one episode, drawn from the replay for the learner (algorithm/experience.py)."""

    observation: jax.Array  # [..., num_seen] before the first step
    action: jax.Array  # [..., A] of the first step, in [-1, 1]
    next_observation: jax.Array  # [..., num_seen] after the last step taken
    outcomes: Outcomes  # [..., n]
    row: jax.Array  # [...] int32, the first step's row in the replay
