"""The interface of a bonus: an intrinsic reward with a state, as pure functions.

Every bonus rewards the state that a transition reached. It sees transitions drawn from a replay,
as in URLB (Laskin et al. 2021, github.com/rll-research/url_benchmark): what its method computes
from the newest rollout, it computes from the batch. It computes the rewards of all minibatches of a
vector step together, and then learns from one minibatch after the other. It sees
features φ(s), as the distance to the reference does, and the states themselves.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import optax

from maxent_jax.types import Metrics

State = Any
"""A pytree of fixed shapes and dtypes."""

# Of every bonus network. URLB has 1024 units; 256 is the size of the paper's actor and critics.
HIDDEN_LAYERS, HIDDEN_SIZE = 2, 256
# Of embeddings in which distances are measured: RE3's feature_dim, and that of VCSE's ICM.
EMBEDDING_SIZE = 50


class Steps(NamedTuple):
    """A batch of transitions, as a bonus sees it."""

    features: jax.Array  # [B, F] φ of the state left
    action: jax.Array  # [B, A], in [-1, 1]
    next_features: jax.Array  # [B, F] φ of the state reached
    value: jax.Array  # [B] the critics' value of the state reached
    episodic: jax.Array  # [B] from Episodic.novelty when the step was taken; 0 without it
    row: jax.Array  # [B] int32, equal for copies of one transition that was drawn more than once
    cell: jax.Array  # [B] int32 of the grid, where the step arrived; num_cells off it
    state: jax.Array  # [B, I] the state left, as the networks see it, without the skill
    next_state: jax.Array  # [B, I]
    skill: jax.Array | None = None  # [B, Z]; None without skills


class Episodic(NamedTuple):
    """The part that is computed when a step is taken, since it depends on the episode so far."""

    size: int  # E of an embedding
    embed: Callable[[State, jax.Array], jax.Array]
    """state, features [N, F] -> embedding [N, E]"""
    novelty: Callable[[State, jax.Array, jax.Array, jax.Array], tuple[State, jax.Array]]
    """state, embedding [N, E], earlier [N, T, E], count [N] -> state, [N]

    `earlier` holds the embeddings of each episode's earlier states; the first `count` are filled.
    """


def _no_learning(state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """What a bonus does that does not learn."""
    del steps, key
    return state, {}


class Bonus(NamedTuple):
    """Functions that can be jitted and mapped over seeds; a scan can carry the state."""

    init: Callable[[jax.Array], State]
    """key -> state"""
    reward: Callable[[State, Steps], tuple[State, jax.Array]]
    """state, steps -> state with updated running normalisers, reward [B]"""
    learn: Callable[[State, Steps, jax.Array], tuple[State, Metrics]] = _no_learning
    """state, steps, key -> state after one step of learning"""
    episodic: Episodic | None = None
    refresh: Callable[[State, jax.Array], State] | None = None
    """state, share [bins, bins] of the mixture's states in each cell -> state; called when an
    iteration begins"""
    has_scale: bool = False
    """Whether the reward's size has a meaning; else it is divided by its standard deviation."""


class Setting(NamedTuple):
    """The arguments from which every bonus is made."""

    num_features: int  # F
    action_size: int  # A
    scale: jax.Array  # [F] positive, the unit of each feature
    learning_rate: float  # of Adam, if the bonus learns by gradients
    num_cells: int  # of the grid on which coverage is counted
    state_size: int  # I, of what the networks see, without the skill
    skill_size: int = 0  # Z
    hidden_size: int = HIDDEN_SIZE  # of the actor and the critics


def scaled(setting: Setting, features: jax.Array) -> jax.Array:
    """Returns features [B, F] in units of the scale, as networks and distances see them."""
    return features / setting.scale[None]


def optimizer(setting: Setting) -> optax.GradientTransformation:
    """Returns Adam, which every method here that learns by gradients has in its code."""
    return optax.adam(setting.learning_rate)


def no_state(key: jax.Array) -> State:
    """The `init` of a bonus without a state."""
    del key
    return ()
