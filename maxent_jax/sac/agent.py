"""The SAC learner: init, update, act. A Config gives the settings, the caller the sizes."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax

from maxent_jax import moments
from maxent_jax.config import Config
from maxent_jax.moments import Moments
from maxent_jax.sac import losses
from maxent_jax.sac.networks import Actor, Critic
from maxent_jax.types import Metrics

LARGEST_INPUT = 10.0  # standard deviations, at which normalised inputs are clipped
Inputs = Callable[[jax.Array], jax.Array]  # observation [..., D] -> what the networks see [..., I]


class Policy(NamedTuple):
    """What `act` needs."""

    actor: Any
    moments: Moments | None  # of the inputs; None: inputs are not normalised


class Parameters(NamedTuple):
    """The part of an agent that the mixture archives."""

    actor: Any
    critic: Any
    target_critic: Any
    log_temperature: jax.Array  # []
    moments: Moments | None = None  # of the inputs, [I]

    @property
    def policy(self) -> Policy:
        """The actor, and the moments of the inputs that it was trained with."""
        return Policy(self.actor, self.moments)


class Agent(NamedTuple):
    """A learner: its parameters and the state of its optimisers."""

    parameters: Parameters
    optimizer: Any
    average: Any  # moving average of the actor, archived in its place; None: there is none


class Sac(NamedTuple):
    """The static part of a learner: modules, settings, and the map from observations to inputs."""

    actor: Actor
    critic: Critic
    inputs: Inputs
    observation_size: int
    action_size: int
    target_entropy: float
    initial_temperature: float
    discount: float
    soft_update_rate: float
    optimizer: optax.GradientTransformation
    normalizes: bool
    lagrangian: bool
    average_rate: float


def make(config: Config, observation_size: int, action_size: int, inputs: Inputs) -> Sac:
    """Makes the static part of a learner, with the settings of the config."""
    own = config.learner
    return Sac(
        actor=Actor(action_size, own.hidden_layers, own.hidden_size),
        critic=Critic(own.hidden_layers, own.hidden_size, own.critic_layer_norm),
        inputs=inputs,
        observation_size=observation_size,
        action_size=action_size,
        target_entropy=-own.target_entropy_scale * action_size,
        initial_temperature=own.initial_temperature,
        discount=own.discount,
        soft_update_rate=own.soft_update_rate,
        optimizer=optax.adam(own.learning_rate),
        normalizes=own.normalize_inputs,
        lagrangian=own.lagrangian_entropy,
        average_rate=own.actor_average,
    )


def init(sac: Sac, key: jax.Array) -> Agent:
    """Makes a learner with random parameters."""
    key_actor, key_critic = jax.random.split(key)
    inputs = sac.inputs(jnp.zeros(sac.observation_size))
    critic = sac.critic.init(key_critic, inputs, jnp.zeros(sac.action_size))
    return restart(
        sac,
        Parameters(
            actor=sac.actor.init(key_actor, inputs),
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),  # two buffers, so both can be donated
            log_temperature=jnp.log(jnp.asarray(sac.initial_temperature, jnp.float32)),
            moments=moments.init(inputs.shape) if sac.normalizes else None,
        ),
    )


def restart(sac: Sac, parameters: Parameters) -> Agent:
    """Makes a learner with these parameters and fresh optimisers."""
    average = jax.tree.map(jnp.copy, parameters.actor) if sac.average_rate else None
    return Agent(parameters, sac.optimizer.init(_learned(parameters)), average)


def see(sac: Sac, agent: Agent, observation: jax.Array, counts: jax.Array) -> Agent:
    """Updates the moments of the inputs, if the agent has them.

    Args:
      sac: the static part.
      agent: the learner.
      observation: [N, D].
      counts: [N] bool, the states that count.
    Returns:
      The learner with updated moments.
    """
    parameters = agent.parameters
    if parameters.moments is None:
        return agent
    moved = moments.update(parameters.moments, sac.inputs(observation), counts)
    return agent._replace(parameters=parameters._replace(moments=moved))


def archived(agent: Agent) -> Parameters:
    """Returns the parameters that the mixture archives."""
    if agent.average is None:
        return agent.parameters
    return agent.parameters._replace(actor=agent.average)


def act(
    sac: Sac, policy: Policy, observation: jax.Array, key: jax.Array, deterministic: bool = False
) -> jax.Array:
    """Draws an action from the policy, or returns its mean: [..., D] -> [..., A] in [-1, 1]."""
    mean, log_std = _policy(sac, policy.actor, _inputs(sac, policy.moments, observation))
    if deterministic:
        return jnp.tanh(mean)
    return jnp.tanh(mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape))


def value(sac: Sac, parameters: Parameters, observation: jax.Array, key: jax.Array) -> jax.Array:
    """Estimates the soft value of states with one drawn action each, [..., D] -> [...]."""
    inputs = _inputs(sac, parameters.moments, observation)
    action, log_prob = losses.sample_action(*_policy(sac, parameters.actor, inputs), key)
    values = _values(sac, parameters.target_critic, inputs, action)
    surprise = log_prob + (sac.target_entropy if sac.lagrangian else 0.0)
    return jnp.min(values, axis=-1) - jnp.exp(parameters.log_temperature) * surprise


def update(
    sac: Sac,
    agent: Agent,
    batch: losses.Batch,
    key: jax.Array,
    only_critics: jax.Array | None = None,
) -> tuple[Agent, Metrics]:
    """Takes one gradient step of critics, actor and temperature, then moves the target critics.

    Args:
      sac: the static part.
      agent: the learner.
      batch: [B] transitions.
      key: of the actions drawn.
      only_critics: [] bool, whether actor and temperature stay as they are; None: they learn.
    Returns:
      The learner after the step, and metrics.
    """
    key_next, key_actor = jax.random.split(key)
    parameters = agent.parameters
    inputs = _inputs(sac, parameters.moments, batch.observation)
    target = _target(sac, parameters, batch, key_next)

    def critic_loss(critic):
        return losses.critic_loss(_values(sac, critic, inputs, batch.action), target)

    def actor_loss(actor):
        action, log_prob = losses.sample_action(*_policy(sac, actor, inputs), key_actor)
        values = _values(sac, parameters.critic, inputs, action)
        temperature = jnp.exp(parameters.log_temperature)
        return losses.actor_loss(log_prob, values, temperature), log_prob

    def temperature_loss(log_temperature):
        return losses.temperature_loss(log_temperature, log_prob, sac.target_entropy)

    critic_value, critic_gradient = jax.value_and_grad(critic_loss)(parameters.critic)
    (actor_value, log_prob), actor_gradient = jax.value_and_grad(actor_loss, has_aux=True)(
        parameters.actor
    )
    temperature_gradient = jax.grad(temperature_loss)(parameters.log_temperature)

    gradients = (actor_gradient, critic_gradient, temperature_gradient)
    steps, optimizer = sac.optimizer.update(gradients, agent.optimizer)
    if only_critics is not None:
        moves = lambda tree: jax.tree.map(lambda x: jnp.where(only_critics, 0.0, x), tree)
        steps = (moves(steps[0]), steps[1], moves(steps[2]))
    actor, critic, log_temperature = optax.apply_updates(_learned(parameters), steps)
    target_critic = optax.incremental_update(critic, parameters.target_critic, sac.soft_update_rate)
    metrics = {
        "critic_loss": critic_value,
        "actor_loss": actor_value,
        "policy_entropy": -jnp.mean(log_prob),
        "temperature": jnp.exp(log_temperature),
        "value": jnp.mean(target),
    }
    average = agent.average
    if average is not None:
        average = optax.incremental_update(actor, average, sac.average_rate)
    learned = parameters._replace(
        actor=actor,
        critic=critic,
        target_critic=target_critic,
        log_temperature=log_temperature,
    )
    return Agent(learned, optimizer, average), metrics


def _inputs(sac: Sac, of_inputs: Moments | None, observation: jax.Array) -> jax.Array:
    inputs = sac.inputs(observation)
    if of_inputs is None:
        return inputs
    return moments.normalized(of_inputs, inputs, LARGEST_INPUT)


def _policy(sac: Sac, actor: Any, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
    return cast(tuple[jax.Array, jax.Array], sac.actor.apply(actor, inputs))


def _values(sac: Sac, critic: Any, inputs: jax.Array, action: jax.Array) -> jax.Array:
    return cast(jax.Array, sac.critic.apply(critic, inputs, action))


def _target(sac: Sac, parameters: Parameters, batch: losses.Batch, key: jax.Array) -> jax.Array:
    next_value = value(sac, parameters, batch.next_observation, key)
    return losses.bellman_target(batch, next_value, sac.discount)


def _learned(parameters: Parameters) -> tuple:
    return parameters.actor, parameters.critic, parameters.log_temperature
