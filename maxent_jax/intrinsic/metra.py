"""METRA: steps in a learned space, along the skill that the episode was given.

Park, Rybkin & Levine 2024, "METRA: scalable unsupervised RL with metric-aware abstraction", arXiv
2310.08887, and its code (github.com/seohongpark/METRA) for states. The reward of a step from s to
s' under the skill z is (φ(s') - φ(s))·z. φ is trained to raise it, under the constraint that a step
moves by at most 1 in each dimension of φ's space, in the mean of squares; a dual variable λ
enforces it. The policy sees z in its observation (envs/skills.py).

Departures: φ sees states normalised by the moments of those drawn until the replay holds 10,000
steps, and the policy by their running moments; their code has constants measured once. The rewards
of a vector step come before its gradient steps of φ, theirs after each. Their learner waits for
10,000 transitions; ours begins at once. At a time limit ours bootstraps; theirs takes it for the
end. φ's hidden layers are as wide as the critics': theirs all have 1,024 units.
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax import moments
from maxent_jax.intrinsic import descent, protocol
from maxent_jax.intrinsic.descent import Learned
from maxent_jax.intrinsic.protocol import HIDDEN_LAYERS, Bonus, Setting, Steps
from maxent_jax.moments import Moments
from maxent_jax.sac.networks import Mlp
from maxent_jax.types import Metrics

INITIAL_MULTIPLIER = 30.0  # dual_lam
SLACK = 1e-3  # dual_slack
NUM_MEASURED = 10_000  # steps in the replay until φ's units are set
LARGEST_INPUT = 1e6  # standard deviations: positions grow without bounds


class Metra(NamedTuple):
    """The static part."""

    setting: Setting
    network: Mlp
    optimizer: optax.GradientTransformation


class Parameters(NamedTuple):
    """What learns."""

    phi: Any
    log_multiplier: jax.Array  # [] log λ


class State(NamedTuple):
    """φ and λ with their optimiser, and the moments of early states."""

    learned: Learned
    inputs: Moments  # [I]


def make(setting: Setting) -> Bonus:
    """Makes the bonus (φ(s') - φ(s))·z, of either sign; it is not divided by its deviation."""
    metra = build(setting)
    return Bonus(
        init=functools.partial(init, metra),
        reward=functools.partial(reward, metra),
        learn=functools.partial(learn, metra),
        has_scale=True,
    )


def build(setting: Setting) -> Metra:
    """Makes the static part."""
    network = Mlp(HIDDEN_LAYERS, setting.hidden_size, setting.skill_size)
    return Metra(setting, network, protocol.optimizer(setting))


def init(metra: Metra, key: jax.Array) -> State:
    """Returns a random φ, and λ = 30."""
    size = metra.setting.state_size
    parameters = Parameters(
        phi=metra.network.init(key, jnp.zeros((1, size))),
        log_multiplier=jnp.log(jnp.asarray(INITIAL_MULTIPLIER, jnp.float32)),
    )
    return State(descent.begin(metra.optimizer, parameters), moments.init((size,)))


def reward(metra: Metra, state: State, steps: Steps) -> tuple[State, jax.Array]:
    """Returns the reward [B]; states of the first steps set the units of φ's inputs.

    Raises:
      ValueError: the steps have no skill.
    """
    if steps.skill is None:
        raise ValueError("METRA rewards skills, but the steps have none")
    measuring = jnp.full(steps.row.shape, jnp.max(steps.row) < NUM_MEASURED)
    state = state._replace(inputs=moments.update(state.inputs, steps.next_state, measuring))
    return state, along(displacement(metra, state, state.learned.parameters.phi, steps), steps)


def learn(metra: Metra, state: State, steps: Steps, key: jax.Array) -> tuple[State, Metrics]:
    """Takes one gradient step of φ and λ."""
    del key

    def loss(parameters: Parameters):
        moved = displacement(metra, state, parameters.phi, steps)
        room = jnp.mean(jnp.minimum(1.0 - jnp.mean(moved**2, axis=-1), SLACK))
        multiplier = jnp.exp(parameters.log_multiplier)
        of_phi = -jnp.mean(along(moved, steps)) - jax.lax.stop_gradient(multiplier) * room
        of_multiplier = parameters.log_multiplier * jax.lax.stop_gradient(room)
        metrics = {"bonus_room": room, "bonus_multiplier": multiplier}
        return of_phi + of_multiplier, metrics

    learned, metrics = descent.descend(metra.optimizer, state.learned, loss)
    return state._replace(learned=learned), metrics


def displacement(metra: Metra, state: State, phi: Any, steps: Steps) -> jax.Array:
    """Returns φ(s') - φ(s), [B, Z]."""

    def embed(states):
        inputs = moments.normalized(state.inputs, states, LARGEST_INPUT)
        return cast(jax.Array, metra.network.apply(phi, inputs))

    return embed(steps.next_state) - embed(steps.state)


def along(moved: jax.Array, steps: Steps) -> jax.Array:
    """Returns how far a displacement [B, Z] goes along the skill of its step, [B]."""
    return jnp.sum(moved * jnp.asarray(steps.skill), axis=-1)
