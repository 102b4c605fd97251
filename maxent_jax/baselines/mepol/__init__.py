"""MEPOL: one policy, by gradient ascent on the k-nearest-neighbour entropy of the states it visits.

    epoch    a batch of episodes, and gradient steps on it within a trust region (ascent.py), by
             estimates of the states that the policy would visit (estimates.py)
    iterate  epochs, then an evaluation of the policy

Three things differ from the official code. There, no episode ends before its time limit; here,
health termination ends episodes, and the states after it do not count. There, the mean of the
policy is first trained towards 0; here, it starts at 0. There, densities are measured over the
whole state or its first coordinates; here, over φ, as for all methods.

Source: Mutti, Pratissoli & Restelli 2021 (arXiv 2007.04640); github.com/muttimirco/mepol.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs.base import Wrapper

from maxent_jax import algorithm, rollout
from maxent_jax.algorithm.learner import Visits, visit
from maxent_jax.baselines.mepol import ascent, estimates
from maxent_jax.baselines.mepol.ascent import Batch
from maxent_jax.baselines.mepol.settings import Settings
from maxent_jax.components import Components
from maxent_jax.envs import base
from maxent_jax.mixture import occupancy
from maxent_jax.rollout import Trajectories
from maxent_jax.sac.networks import GaussianPolicy
from maxent_jax.types import Metrics

__all__ = ["Settings", "State", "batch_of", "epoch", "evaluate", "init", "iterate", "play"]


class State(NamedTuple):
    """All that the next epoch needs."""

    key: jax.Array  # typed
    policy: Any  # parameters
    optimizer: Any
    starts: base.State  # [R, ...] random starts
    visits: Visits  # of all training episodes
    env_steps: jax.Array  # [] int32, of all training episodes
    gradient_steps: jax.Array  # [] int32, refused ones included


@functools.partial(jax.jit, static_argnums=(0, 1))
def init(components: Components, settings: Settings, key: jax.Array) -> State:
    """Returns the state before the first epoch: the policy is a Gaussian of mean 0 everywhere."""
    key, key_policy, key_starts = jax.random.split(key, 3)
    inputs = components.sac.inputs(jnp.zeros(components.sac.observation_size))
    policy = module(components, settings).init(key_policy, inputs)
    zero = jnp.zeros((), jnp.int32)
    return State(
        key=key,
        policy=policy,
        optimizer=ascent.ADAM.init(policy),
        starts=base.init(
            components.env, 1, components.config.environment.num_starts, key_starts
        ).starts,
        visits=Visits(jnp.zeros(components.grid.bins, jnp.int32), zero),
        env_steps=zero,
        gradient_steps=zero,
    )


@functools.partial(jax.jit, static_argnums=(0, 1))
def iterate(components: Components, settings: Settings, state: State) -> tuple[State, Metrics]:
    """Runs `num_epochs` epochs, then measures the policy as a mixture is measured.

    For several seeds, jax.vmap over the state. An epoch takes num_episodes × episode_length env
    steps if no episode ends early.

    Raises:
      ValueError: num_neighbors is not smaller than that number of env steps.
    """
    state, in_epochs = jax.lax.scan(
        lambda s, _: epoch(components, settings, s), state, length=settings.num_epochs
    )
    at_end = {
        "env_steps": state.env_steps,
        "gradient_steps": state.gradient_steps,
        **algorithm.coverage("cumulative", state.visits),
        **evaluate(components, settings, state),
    }
    return state, algorithm.reduce_metrics(in_epochs) | at_end


def epoch(components: Components, settings: Settings, state: State) -> tuple[State, Metrics]:
    """Plays a batch of episodes and takes steps on it; metrics named num_ are counts."""
    key, key_starts, key_play = jax.random.split(state.key, 3)
    starts = base.draw_starts(state.starts, settings.num_episodes, key_starts)
    played = play(components, settings, state.policy, starts, key_play)
    batch = batch_of(components, settings, starts, played)
    after, played_entropy = ascent.ascend(
        module(components, settings), settings, state.policy, state.optimizer, batch
    )
    num_steps = jnp.sum(played.alive, dtype=jnp.int32)
    num_updates = after.num_accepted + after.num_refused
    state = state._replace(
        key=key,
        policy=after.policy,
        optimizer=after.optimizer,
        visits=visit(
            components,
            state.visits,
            played.states.reshape(-1, played.states.shape[-1]),
            played.alive.reshape(-1),
        ),
        env_steps=state.env_steps + num_steps + played.num_invalid,
        gradient_steps=state.gradient_steps + num_updates,
    )
    return state, {
        "knn_entropy": played_entropy,
        "next_knn_entropy": after.entropy,  # of the next policy, estimated from the same states
        "kl": after.kl,
        "num_updates": num_updates,
        "num_backtracks": after.num_refused,
        "num_rollout_steps": num_steps,
        "num_rollout_invalid": played.num_invalid,
        "rollout_episode_length": num_steps / settings.num_episodes,
    }


def play(
    components: Components, settings: Settings, policy: Any, starts: base.State, key: jax.Array
) -> Trajectories:
    """Plays episodes of the policy from `starts` [E, ...]; the actions are not yet clipped."""
    network = module(components, settings)

    def act(observation, key_step):
        mean, log_std = ascent.gaussian(network, policy, components.sac.inputs(observation))
        return mean + jnp.exp(log_std) * jax.random.normal(key_step, mean.shape)

    env = Clipped(components.env)
    return rollout.episodes(env, starts, act, components.config.environment.episode_length, key)


def batch_of(
    components: Components, settings: Settings, starts: base.State, played: Trajectories
) -> Batch:
    """Makes the batch from episodes that were played from `starts` [E, ...]."""
    left = jnp.concatenate([starts.obs[None], played.states[:-1]])
    features = components.phi(played.states)
    return Batch(
        inputs=components.sac.inputs(left),
        actions=played.actions,
        particles=estimates.particles(features, played.alive, settings.num_neighbors),
    )


def evaluate(components: Components, settings: Settings, state: State) -> Metrics:
    """Measures the policy like a mixture with this one policy, over as many episodes.

    It uses the same randomness every time, and its episodes enter no count.
    """
    key_starts, key_play, key_rows = jax.random.split(jax.random.key(algorithm.EVALUATION_SEED), 3)
    num_episodes = components.config.mixture.mixture_episodes
    starts = base.draw_starts(state.starts, num_episodes, key_starts)
    played = play(components, settings, state.policy, starts, key_play)
    alone, by_it = jnp.ones(1), jnp.zeros(num_episodes, jnp.int32)
    visited = occupancy.of_episodes(
        components, alone, by_it, played.states, played.alive, played.num_invalid
    )
    return occupancy.measures(components, visited, key_rows)


def module(components: Components, settings: Settings) -> GaussianPolicy:
    """Returns the policy's network."""
    return GaussianPolicy(
        action_size=components.env.action_size,
        num_layers=settings.hidden_layers,
        size=settings.hidden_size,
        initial_log_std=settings.initial_log_std,
    )


class Clipped(Wrapper):
    """An environment that clips actions to [-1, 1]."""

    def step(self, state: base.State, action: jax.Array) -> base.State:
        """Takes one control step of one environment with the action [A], clipped."""
        return self.env.step(state, jnp.clip(action, -1.0, 1.0))
