"""One step of all envs with its gradient steps, against the reward of the moment."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import rewards
from maxent_jax.density import histogram, reservoir
from maxent_jax.density.knn import knn_distances
from maxent_jax.density.reservoir import Reservoir
from maxent_jax.envs import base
from maxent_jax.envs.base import Episodes
from maxent_jax.methods import Method
from maxent_jax.parts import Parts
from maxent_jax.sac import agent as sac_agent
from maxent_jax.sac import losses, replay
from maxent_jax.sac.agent import Agent
from maxent_jax.sac.replay import Replay
from maxent_jax.types import Experience, Metrics, Transition

POSITION_DIMS = 2  # the features that are metres, first in every feature map


class Reference(NamedTuple):
    """The states that define r_t; the first `num_filled` points are there."""

    points: jax.Array  # [M, F]
    num_filled: jax.Array  # [] int32


class Visits(NamedTuple):
    """Every state met, as counts; they only grow."""

    cells: jax.Array  # [bins, bins] int32
    off_grid: jax.Array  # [] int32


class Learner(NamedTuple):
    """All that training within an iteration changes."""

    agent: Agent
    replay: Replay
    episodes: Episodes  # [N] of the agent; then, with the random baseline, [N] of that
    memory: jax.Array | None  # [N, T, F] states of each episode so far, for the episodic term
    reference: Reference
    history: Reservoir
    visits: Visits
    random_visits: Visits
    env_steps: jax.Array  # [] int32, of the agent
    gradient_steps: jax.Array  # [] int32


def init(parts: Parts, key: jax.Array) -> Learner:
    """A fresh learner with fresh episodes, an empty replay, and no reference yet."""
    config, sac = parts.config, parts.sac
    key_agent, key_episodes = jax.random.split(key)
    num_rows = config.num_envs * (2 if config.random_baseline else 1)
    dims = len(parts.phi.names)
    scalar, state = jnp.zeros(()), jnp.zeros(sac.observation_size)
    action = jnp.zeros(sac.action_size)
    memory = None
    if config.episodic_weight > 0:
        memory = jnp.zeros((config.num_envs, config.episode_length, dims))
    zero = jnp.zeros((), jnp.int32)
    unvisited = Visits(jnp.zeros(parts.grid.bins, jnp.int32), zero)
    return Learner(
        agent=sac_agent.init(sac, key_agent),
        replay=replay.init(Experience(state, action, state, *([scalar] * 5)), config.replay_size),
        episodes=base.init(parts.env, num_rows, config.num_starts, key_episodes),
        memory=memory,
        reference=Reference(jnp.zeros((config.reference_size, dims)), zero),
        history=reservoir.init(config.reference_size, dims),
        visits=unvisited,
        random_visits=unvisited,
        env_steps=zero,
        gradient_steps=zero,
    )


def step(parts: Parts, method: Method, learner: Learner, key: jax.Array) -> tuple[Learner, Metrics]:
    """All envs once, then the gradient steps that go with it. Metrics named num_ are counts."""
    config = parts.config
    key_act, key_random, key_env, key_history, key_yaw, key_learn = jax.random.split(key, 6)

    actor = learner.agent.parameters.actor
    observation = learner.episodes.env.obs[: config.num_envs]
    action = sac_agent.act(parts.sac, actor, observation, key_act)
    if config.random_baseline:
        random = jax.random.uniform(key_random, action.shape, minval=-1.0, maxval=1.0)
        action = jnp.concatenate([action, random])
    age = learner.episodes.age[: config.num_envs]
    episodes, everyone = base.step(
        parts.env, learner.episodes, action, config.episode_length, key_env
    )
    transition = jax.tree.map(lambda x: x[: config.num_envs], everyone)
    others = jax.tree.map(lambda x: x[config.num_envs :], everyone)

    features = parts.phi(transition.next_observation)
    history = reservoir.add(learner.history, features, transition.valid, key_history)
    reference = _refreshed(parts, method, learner, history)
    bonus, memory = _episodic(parts, learner.memory, transition, features, age)
    experience, valid = _with_yaw_copies(parts, transition, bonus, key_yaw)
    ring = replay.add(learner.replay, measure(parts, reference, experience), valid)
    learner = learner._replace(
        replay=ring,
        episodes=episodes,
        memory=memory,
        reference=reference,
        history=history,
        visits=_visit(parts, learner.visits, transition),
        random_visits=_visit(parts, learner.random_visits, others),
        env_steps=learner.env_steps + config.num_envs,
        gradient_steps=learner.gradient_steps + config.updates_per_vector_step,
    )
    learner, metrics = _learn(parts, method, learner, key_learn)
    if parts.torso is not None:
        flipped = parts.torso.flipped(transition.next_observation)
        metrics["flipped_share"] = jnp.mean(flipped.astype(jnp.float32))
    metrics |= {
        "num_deaths": jnp.sum(transition.terminated, dtype=jnp.int32),
        "num_time_limits": jnp.sum(transition.truncated, dtype=jnp.int32),
        "num_invalid": jnp.sum(~everyone.valid, dtype=jnp.int32),
    }
    return learner, metrics


def measure(parts: Parts, reference: Reference, experience: Experience) -> Experience:
    """The experience [B, ...] with its distances to the reference, in place of any it had."""
    config = parts.config

    def distance(features):
        dims = features.shape[1]
        nearest = knn_distances(
            features, reference.points[:, :dims], config.num_neighbors, count=reference.num_filled
        )
        return nearest[:, -1]

    after = parts.phi(experience.next_observation)
    experience = experience._replace(distance=distance(after))
    if config.shaping == 0:
        return experience
    before = parts.phi(experience.observation)
    if config.shaping_space == "features":
        return experience._replace(
            potential_distance=distance(before), next_potential_distance=experience.distance
        )
    ends = jnp.concatenate([before, after])[:, :POSITION_DIMS]
    at_start, at_end = jnp.split(distance(ends), 2)
    return experience._replace(potential_distance=at_start, next_potential_distance=at_end)


def unshaped_reward(parts: Parts, distance: jax.Array) -> jax.Array:
    """r_t of a state at that distance, [...] -> [...]: what scores and plots use."""
    config = parts.config
    return rewards.of_distance(
        distance, config.reward, config.reward_distance, len(parts.phi.names)
    )


def reward(parts: Parts, experience: Experience) -> jax.Array:
    """What SAC is paid for a transition, [...]: r_t, its shaping, and the episodic term."""
    config = parts.config
    form = unshaped_reward(parts, experience.distance)
    paid = form + config.episodic_weight * experience.bonus
    if config.shaping > 0:
        paid = rewards.shaped(
            paid,
            potential=config.shaping * unshaped_reward(parts, experience.potential_distance),
            next_potential=config.shaping
            * unshaped_reward(parts, experience.next_potential_distance),
            discount=config.discount,
            alive=experience.discount,
            survives_death=config.shaping_survives_death,
        )
    return config.reward_scale * paid


def _refreshed(parts: Parts, method: Method, learner: Learner, history: Reservoir) -> Reference:
    """The reference, drawn anew where the method's period says so.

    The mixture's own states change only between iterations, see algorithm.begin.
    """
    vector_step = learner.env_steps // parts.config.num_envs
    period = method.refresh_period
    due = _changes_within_iteration(method) & (vector_step % jnp.maximum(period, 1) == 0)
    return Reference(
        jnp.where(due, history.points, learner.reference.points),
        jnp.where(due, reservoir.count(history), learner.reference.num_filled),
    )


def _changes_within_iteration(method: Method) -> jax.Array:
    return method.from_history & (method.refresh_period > 0)


def _episodic(parts, memory, transition: Transition, features, age):
    """The episodic term of each state reached, and the memory with the states left behind."""
    config = parts.config
    if memory is None:
        return jnp.zeros(config.num_envs), memory
    rows = jnp.arange(config.num_envs)
    memory = memory.at[rows, age].set(parts.phi(transition.observation))
    return rewards.episodic_bonus(features, memory, age + 1, config.num_neighbors), memory


def _with_yaw_copies(parts: Parts, transition: Transition, bonus: jax.Array, key: jax.Array):
    """Experience [N·(1 + copies), ...], unmeasured, and which of its rows are valid."""
    config = parts.config
    unmeasured = jnp.zeros(config.num_envs)
    original = Experience(
        observation=transition.observation,
        action=transition.action,
        next_observation=transition.next_observation,
        discount=1.0 - transition.terminated.astype(jnp.float32),
        bonus=bonus,
        distance=unmeasured,
        potential_distance=unmeasured,
        next_potential_distance=unmeasured,
    )
    angles = jax.random.uniform(
        key, (config.yaw_copies, config.num_envs), minval=-jnp.pi, maxval=jnp.pi
    )
    copies = [_turned(parts, original, angle) for angle in angles]
    experience = jax.tree.map(lambda *rows: jnp.concatenate(rows), original, *copies)
    return experience, jnp.tile(transition.valid, 1 + config.yaw_copies)


def _turned(parts: Parts, experience: Experience, angle: jax.Array) -> Experience:
    assert parts.torso is not None and parts.torso.rotate is not None  # checked by Config
    return experience._replace(
        observation=parts.torso.rotate(experience.observation, angle),
        next_observation=parts.torso.rotate(experience.next_observation, angle),
    )


def _visit(parts: Parts, visits: Visits, transition: Transition) -> Visits:
    grid = parts.grid
    valid = transition.valid.astype(jnp.int32)
    cells = histogram.count(transition.next_observation, grid, valid)
    return Visits(visits.cells + cells, visits.off_grid + jnp.sum(valid) - jnp.sum(cells))


def _learn(
    parts: Parts, method: Method, learner: Learner, key: jax.Array
) -> tuple[Learner, Metrics]:
    """The gradient steps of one step of all envs, on rewards of the current reference."""
    config = parts.config
    shape = (config.updates_per_vector_step, config.batch_size)
    key_sample, key_update = jax.random.split(key)
    drawn = replay.sample(learner.replay, (shape[0] * shape[1],), key_sample)
    # Stored distances hold while the reference does; the branch touches the drawn rows alone.
    drawn = jax.lax.cond(
        _changes_within_iteration(method),
        lambda experience: measure(parts, learner.reference, experience),
        lambda experience: experience,
        drawn,
    )
    paid = reward(parts, drawn)
    batches = losses.Batch(
        drawn.observation, drawn.action, paid, drawn.next_observation, drawn.discount
    )
    batches = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), batches)

    def update(agent, batch_and_key):
        return sac_agent.update(parts.sac, agent, *batch_and_key)

    keys = jax.random.split(key_update, shape[0])
    agent, metrics = jax.lax.scan(update, learner.agent, (batches, keys))
    metrics = jax.tree.map(jnp.mean, metrics)
    unshaped = jnp.mean(unshaped_reward(parts, drawn.distance))
    metrics |= {
        "replay_reward": unshaped,
        "replay_paid": jnp.mean(paid),
        "replay_bonus": jnp.mean(drawn.bonus),
    }
    return learner._replace(agent=agent), metrics
