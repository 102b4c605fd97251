"""TD3+BC: learns a task from a dataset alone, with an actor that is kept near the data.

The actor maximises λ Q(s, π(s)) − mean (π(s) − a)², where λ = α / mean |Q|: it weighs return
against imitation in the same way whatever the scale of the rewards.

Source: Fujimoto & Gu 2021, "A minimalist approach to offline reinforcement learning",
arXiv 2106.06860. The settings are theirs but for the number of updates, which was a million.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from maxent_jax import rollout
from maxent_jax.components import Components
from maxent_jax.mixture import occupancy
from maxent_jax.precision import in_32_bits
from maxent_jax.sac.networks import Critic, Mlp

UPDATES_AT_ONCE = 1_000  # updates in a call of the program
DEVIATION_FLOOR = 1e-3  # theirs, added to the standard deviation of an input


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of TD3+BC."""

    num_updates: int = 50_000
    """Gradient steps of the critics."""
    batch_size: int = 256
    hidden_layers: int = 2
    hidden_size: int = 256
    learning_rate: float = 3e-4
    discount: float = 0.99
    soft_update_rate: float = 0.005
    target_noise: float = 0.2
    """Standard deviation of the noise on the target's action."""
    noise_clip: float = 0.5
    actor_period: int = 2
    """Updates of the critics for each update of the actor and of the targets."""
    return_scale: float = 2.5
    """α: the weight of the return against imitation."""


class Policy(NamedTuple):
    """A deterministic policy, and the scale of its inputs."""

    actor: Any
    mean: jax.Array  # [I] of the dataset's inputs
    deviation: jax.Array  # [I]


class _Data(NamedTuple):
    """The dataset as the networks see it, [n, ...]."""

    inputs: jax.Array
    action: jax.Array
    next_inputs: jax.Array
    reward: jax.Array
    goes_on: jax.Array  # 0 where the next state is terminal


class _State(NamedTuple):
    actor: Any
    critic: Any
    target_actor: Any
    target_critic: Any
    of_actor: optax.OptState
    of_critic: optax.OptState


@in_32_bits
def train(
    p: Components, settings: Settings, data: Mapping[str, np.ndarray], key: jax.Array
) -> Policy:
    """Learns a policy from transitions with rewards.

    Args:
      p: of a run in the dataset's environment.
      settings: of the learner.
      data: observations [n, D], actions [n, A], next_observations [n, D], rewards [n] and
        terminals [n], as from `Run.dataset(n, task=...)`.
      key: of the networks and the batches.
    Returns:
      The policy after the last update.
    """
    observed, reached = (
        p.sac.inputs(jnp.asarray(data[name])) for name in ("observations", "next_observations")
    )
    mean, deviation = jnp.mean(observed, axis=0), jnp.std(observed, axis=0) + DEVIATION_FLOOR
    scaled = jax.vmap(lambda x: (x - mean) / deviation)
    seen = _Data(
        inputs=scaled(observed),
        action=jnp.asarray(data["actions"]),
        next_inputs=scaled(reached),
        reward=jnp.asarray(data["rewards"], jnp.float32),
        goes_on=1.0 - jnp.asarray(data["terminals"], jnp.float32),
    )
    key_actor, key_critic, key = jax.random.split(key, 3)
    actor, critic = _networks(settings, p.sac.action_size)
    of_actor = actor.init(key_actor, seen.inputs[0])
    of_critic = critic.init(key_critic, seen.inputs[0], seen.action[0])
    optimizer = optax.adam(settings.learning_rate)
    state = _State(
        actor=of_actor,
        critic=of_critic,
        target_actor=of_actor,
        target_critic=of_critic,
        of_actor=optimizer.init(of_actor),
        of_critic=optimizer.init(of_critic),
    )
    for done in range(0, settings.num_updates, UPDATES_AT_ONCE):
        number = min(UPDATES_AT_ONCE, settings.num_updates - done)
        state = _updates(settings, state, seen, done + jnp.arange(number), key)
    return Policy(state.actor, mean, deviation)


def act(p: Components, settings: Settings, policy: Policy, observation: jax.Array) -> jax.Array:
    """Returns the policy's action in a state, [D] -> [A]."""
    actor, _ = _networks(settings, p.sac.action_size)
    inputs = (p.sac.inputs(observation) - policy.mean) / policy.deviation
    return jnp.tanh(actor.apply(policy.actor, inputs))


@in_32_bits
def evaluate(
    p: Components, settings: Settings, policy: Policy, num_episodes: int, key: jax.Array
) -> np.ndarray:
    """Returns the undiscounted returns [num_episodes] of the components' task."""
    return np.asarray(_returns(p, settings, num_episodes, policy, key))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _returns(
    p: Components, settings: Settings, num_episodes: int, policy: Policy, key: jax.Array
) -> jax.Array:
    key_starts, key_play = jax.random.split(key)
    starts = jax.vmap(p.env.reset)(jax.random.split(key_starts, num_episodes))
    reached = rollout.episodes(
        p.env,
        starts,
        lambda observation, _: jax.vmap(lambda s: act(p, settings, policy, s))(observation),
        p.config.environment.episode_length,
        key_play,
    )
    returns = occupancy.task_returns(p, starts, reached)
    assert returns is not None  # the components have a task
    return returns


def _networks(settings: Settings, action_size: int) -> tuple[Any, Any]:
    layers, size = settings.hidden_layers, settings.hidden_size
    return Mlp(layers, size, action_size), Critic(layers, size, layer_norm=False)


@functools.partial(jax.jit, static_argnums=0)
def _updates(
    settings: Settings, state: _State, data: _Data, steps: jax.Array, key: jax.Array
) -> _State:
    """The updates of these numbers [U], each of which is folded into the key."""
    actor, critic = _networks(settings, data.action.shape[-1])
    optimizer = optax.adam(settings.learning_rate)

    def critic_loss(parameters, state, batch, key):
        noise = settings.target_noise * jax.random.normal(key, batch.action.shape)
        noise = jnp.clip(noise, -settings.noise_clip, settings.noise_clip)
        next_action = jnp.tanh(actor.apply(state.target_actor, batch.next_inputs))
        next_action = jnp.clip(next_action + noise, -1.0, 1.0)
        after = jnp.min(critic.apply(state.target_critic, batch.next_inputs, next_action), axis=-1)
        target = batch.reward + settings.discount * batch.goes_on * after
        values = critic.apply(parameters, batch.inputs, batch.action)
        return jnp.mean(jnp.sum((values - target[:, None]) ** 2, axis=-1))

    def actor_loss(parameters, state, batch):
        action = jnp.tanh(actor.apply(parameters, batch.inputs))
        value = critic.apply(state.critic, batch.inputs, action)[..., 0]
        weight = settings.return_scale / jax.lax.stop_gradient(jnp.mean(jnp.abs(value)))
        return jnp.mean((action - batch.action) ** 2) - weight * jnp.mean(value)

    def soft(target, parameters):
        return optax.incremental_update(parameters, target, settings.soft_update_rate)

    def update_actor(state, batch):
        gradient = jax.grad(actor_loss)(state.actor, state, batch)
        change, of_actor = optimizer.update(gradient, state.of_actor)
        new = optax.apply_updates(state.actor, change)
        return state._replace(
            actor=new,
            of_actor=of_actor,
            target_actor=soft(state.target_actor, new),
            target_critic=soft(state.target_critic, state.critic),
        )

    def update(state, step):
        key_batch, key_noise = jax.random.split(jax.random.fold_in(key, step))
        rows = jax.random.randint(key_batch, (settings.batch_size,), 0, data.reward.shape[0])
        batch = jax.tree.map(lambda x: x[rows], data)
        gradient = jax.grad(critic_loss)(state.critic, state, batch, key_noise)
        change, of_critic = optimizer.update(gradient, state.of_critic)
        new = optax.apply_updates(state.critic, change)
        state = state._replace(critic=new, of_critic=of_critic)
        due = step % settings.actor_period == 0
        return jax.lax.cond(due, update_actor, lambda state, _: state, state, batch), None

    return jax.lax.scan(update, state, steps)[0]
