"""What a bonus is: an intrinsic reward with a state of its own, as pure functions.

Every bonus pays for the state that a transition reached. It meets transitions drawn from a replay,
as in URLB (Laskin et al. 2021, github.com/rll-research/url_benchmark): what its method computes
from the newest rollout, it computes from the batch. Rewards are computed for all minibatches of a
step of all envs together, before it learns from one after the other. What it is shown as a state's
observation is φ of it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import optax

from maxent_jax.types import Metrics

State = Any
"""A pytree of fixed shapes and dtypes."""

# Of every network here. URLB has 1024 units; 256 is the size of the paper's own actor and critics.
HIDDEN_LAYERS, HIDDEN_SIZE = 2, 256
# Of the embeddings in which distances are measured: RE3's feature_dim, and that of VCSE's ICM.
EMBEDDING_SIZE = 50


class Steps(NamedTuple):
    """A batch of transitions as a bonus sees them."""

    observation: jax.Array  # [B, D]
    action: jax.Array  # [B, A], in [-1, 1]
    next_observation: jax.Array  # [B, D]
    value: jax.Array  # [B] what the critics expect from next_observation on
    episodic: jax.Array  # [B] what Episodic.novelty gave when the step was taken; 0 without one
    row: jax.Array  # [B] int32, equal for one and the same transition, drawn more than once
    cell: jax.Array | None = None  # [B] int32 of the grid, that the step reached; num_cells off it


class Episodic(NamedTuple):
    """What is computed when a step is taken, because it depends on the episode so far."""

    size: int  # F of an embedding
    embed: Callable[[State, jax.Array], jax.Array]
    """state, observation [N, D] -> embedding [N, F]"""
    novelty: Callable[[State, jax.Array, jax.Array, jax.Array], tuple[State, jax.Array]]
    """state, embedding [N, F], earlier [N, T, F], count [N] -> state, [N]

    Of the embeddings of the states before, each episode's first `count` are filled.
    """


class Bonus(NamedTuple):
    """The functions can be jitted, and mapped over seeds; the state can be carried by a scan."""

    init: Callable[[jax.Array], State]
    """key -> state"""
    reward: Callable[[State, Steps], tuple[State, jax.Array]]
    """state, steps -> state with its running normalisers advanced, reward [B]"""
    learn: Callable[[State, Steps, jax.Array], tuple[State, Metrics]]
    """state, steps, key -> state after one step of learning; the same where nothing is learned"""
    episodic: Episodic | None = None
    refresh: Callable[[State, jax.Array], State] | None = None
    """state, share [bins, bins] of the mixture's states in each cell -> state, as an iteration
    begins"""


class Setting(NamedTuple):
    """What every bonus is made from."""

    observation_size: int
    action_size: int
    scale: jax.Array  # [D] what counts as 1 of each observation
    learning_rate: float
    num_cells: int  # of the grid on which coverage is counted


def scaled(setting: Setting, observation: jax.Array) -> jax.Array:
    """What networks and distances see of observations, [B, D]: in units of the scale."""
    return observation / setting.scale[None]


def optimizer(setting: Setting) -> optax.GradientTransformation:
    """Adam, as in the code of every method here that learns by gradients."""
    return optax.adam(setting.learning_rate)


def no_state(key: jax.Array) -> State:
    """The `init` of a bonus that keeps nothing."""
    del key
    return ()


def no_learning(state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """The `learn` of a bonus that learns nothing."""
    del steps, key
    return state, {}
