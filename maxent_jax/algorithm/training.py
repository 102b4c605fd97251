"""One vector step with its gradient steps, under the current reward."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.algorithm import experience, payment
from maxent_jax.algorithm.experience import Reference, Step
from maxent_jax.algorithm.learner import Learner, visit, visit_plane
from maxent_jax.algorithm.methods import Method
from maxent_jax.components import Components
from maxent_jax.density import histogram, reservoir
from maxent_jax.density.reservoir import Reservoir
from maxent_jax.envs import base
from maxent_jax.envs.base import Episodes
from maxent_jax.sac import agent as sac_agent
from maxent_jax.sac import losses
from maxent_jax.sac.agent import Agent
from maxent_jax.types import Experience, Metrics, Transition


class Learned(NamedTuple):
    """What gradient steps change."""

    agent: Agent
    bonus: Any


class _Keys(NamedTuple):
    """The keys of one vector step."""

    act: jax.Array
    random: jax.Array
    env: jax.Array
    history: jax.Array
    yaw: jax.Array
    draw: jax.Array
    learn: jax.Array


def _keys(key: jax.Array) -> _Keys:
    return _Keys(*jax.random.split(key, len(_Keys._fields)))


def steps(
    components: Components, method: Method, learner: Learner, keys: jax.Array
) -> tuple[Learner, Metrics]:
    """Takes a vector step with its gradient steps for each key.

    With a policy lag, the gradient steps of a vector step learn from what the replay held before
    it, and run beside the simulation.

    Args:
      components: the static part.
      method: the method.
      learner: the learner.
      keys: [T].
    Returns:
      The learner, and metrics [T]; those named num_ are counts.
    """
    if not components.config.learner.policy_lag:
        return jax.lax.scan(functools.partial(step, components, method), learner, keys)

    # Batches are drawn right after the vector step before. Drawn later, they would make XLA copy
    # the replay, which the vector step changes in place.
    def draw(learner, key_draw):
        return learner.replay.size > 0, _draw(components, learner, key_draw)

    def step_and_draw(carry, keys):
        learner, (ready, batches) = carry
        own, next_key_draw = keys
        learner, metrics = _step_beside(components, method, learner, ready, batches, own)
        return (learner, draw(learner, next_key_draw)), metrics

    every = jax.vmap(_keys)(keys)
    first = learner, draw(learner, every.draw[0])
    (learner, _), metrics = jax.lax.scan(step_and_draw, first, (every, jnp.roll(every.draw, -1)))
    return learner, metrics


def step(
    components: Components, method: Method, learner: Learner, key: jax.Array
) -> tuple[Learner, Metrics]:
    """Steps all envs once, then takes the gradient steps; metrics named num_ are counts."""
    learner = _with_cells_filled(components, learner)
    keys, length = _keys(key), components.config.environment.episode_length
    episodes, everyone = base.step(
        components.env, learner.episodes, _action(components, learner, keys), length, keys.env
    )
    learner, of_steps = _record(components, method, learner, episodes, everyone, keys)
    drawn = _draw(components, learner, keys.draw)
    learned, of_updates = _learn(components, method, learner, drawn, keys.learn)
    return _updated(components, learner, learned), of_updates | of_steps


def _step_beside(
    components: Components,
    method: Method,
    learner: Learner,
    ready: jax.Array,
    drawn: Experience,
    keys: _Keys,
) -> tuple[Learner, Metrics]:
    """Steps all envs once, and takes the gradient steps beside it unless the draw is empty."""
    length = components.config.environment.episode_length
    learner = _with_cells_filled(components, learner)

    def work(key):
        learn = functools.partial(_learn, components, method, learner, drawn)
        _, metrics = jax.eval_shape(learn, key)
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)
        unlearned = Learned(learner.agent, learner.bonus), nothing
        learned, metrics = jax.lax.cond(ready, learn, lambda _: unlearned, key)
        return (learned, metrics), learned.agent.parameters.log_temperature

    action = _action(components, learner, keys)
    episodes, everyone, (learned, of_updates) = base.step_beside(
        components.env, learner.episodes, action, length, keys.env, work, keys.learn
    )
    learner = _updated(components, learner, learned, ready)
    learner, of_steps = _record(components, method, learner, episodes, everyone, keys)
    return learner, of_updates | of_steps


def _updated(
    components: Components, learner: Learner, learned: Learned, ready: jax.Array | bool = True
) -> Learner:
    taken = components.config.updates_per_vector_step * jnp.asarray(ready, jnp.int32)
    return learner._replace(
        agent=learned.agent, bonus=learned.bonus, gradient_steps=learner.gradient_steps + taken
    )


def _with_cells_filled(components: Components, learner: Learner) -> Learner:
    """The learner whose episodes have filled the cells in which they are, if they restart there."""
    if not components.config.environment.cell_restarts:
        return learner
    # Filled before the step, which draws restarts: the other way round, XLA would copy the pool.
    cell = histogram.cells(learner.episodes.env.obs, components.grid)
    return learner._replace(episodes=base.fill_cells(learner.episodes, cell))


def _action(components: Components, learner: Learner, keys: _Keys) -> jax.Array:
    """The actions of the agent in its environments, and of the random baseline in its own."""
    config = components.config
    observation = learner.episodes.env.obs[: config.budget.num_envs]
    policy = learner.agent.parameters.policy
    action = sac_agent.act(components.sac, policy, observation, keys.act)
    if config.evaluation.random_baseline:
        random = jax.random.uniform(keys.random, action.shape, minval=-1.0, maxval=1.0)
        action = jnp.concatenate([action, random])
    return action


def _record(
    components: Components,
    method: Method,
    learner: Learner,
    episodes: Episodes,
    everyone: Transition,
    keys: _Keys,
) -> tuple[Learner, Metrics]:
    """Adds the transitions of a vector step to the replay, the history, the memory and the counts.

    The reference is refreshed if it is due.
    """
    config = components.config
    taken = base.steps_taken(learner.episodes)[: config.budget.num_envs]
    transition = jax.tree.map(lambda x: x[: config.budget.num_envs], everyone)
    others = jax.tree.map(lambda x: x[config.budget.num_envs :], everyone)

    features = components.phi(transition.next_observation)
    history = reservoir.add(learner.history, features, transition.valid, keys.history)
    reference = _refreshed(components, method, learner, history)
    bonus, memory, novelty = payment.episodic_term(components, learner, transition, features, taken)
    ring, rows = experience.add(
        components, reference, learner.replay, transition, learner.place, novelty, keys.yaw
    )
    ended = transition.terminated | transition.truncated
    learner = learner._replace(
        agent=sac_agent.see(
            components.sac, learner.agent, transition.observation, transition.valid
        ),
        replay=ring,
        place=jnp.where(ended, -1 - episodes.start[: config.budget.num_envs], rows),
        episodes=episodes,
        memory=memory,
        bonus=bonus,
        reference=reference,
        history=history,
        visits=visit(components, learner.visits, transition.next_observation, transition.valid),
        random_visits=visit(
            components, learner.random_visits, others.next_observation, others.valid
        ),
        env_steps=learner.env_steps + config.budget.num_envs,
        plane=visit_plane(components, learner.plane, transition.next_observation, transition.valid),
    )
    metrics = _step_metrics(components, ring.items, rows, transition)
    return learner, metrics | {"num_invalid": jnp.sum(~everyone.valid, dtype=jnp.int32)}


def _step_metrics(
    components: Components, items: Step, rows: jax.Array, transition: Transition
) -> Metrics:
    """Metrics of the transitions [N, ...] that the replay has just stored in `rows` [N]."""
    metrics: Metrics = {}
    if components.torso is not None:
        flipped = components.torso.flipped(transition.next_observation)
        metrics["flipped_share"] = jnp.mean(flipped.astype(jnp.float32))
    reached = items.distances.reached.at[rows, 0].get(mode="fill", fill_value=1.0)
    num_valid = jnp.maximum(jnp.sum(transition.valid), 1)
    if items.task is not None:
        earned = items.task.at[rows, 0].get(mode="fill", fill_value=0.0)
        metrics["task_step_reward"] = jnp.sum(earned * transition.valid) / num_valid
    return metrics | {
        "step_reward": jnp.sum(components.unshaped_reward(reached) * transition.valid) / num_valid,
        "num_deaths": jnp.sum(transition.terminated, dtype=jnp.int32),
        "num_time_limits": jnp.sum(transition.truncated, dtype=jnp.int32),
    }


def _refreshed(
    components: Components, method: Method, learner: Learner, history: Reservoir
) -> Reference:
    """The reference, refreshed from the history where the method's period says so."""
    # The mixture's states change only between iterations, see algorithm.begin.
    vector_step = learner.env_steps // components.config.budget.num_envs
    period = method.refresh_period
    due = _changes_within_iteration(method) & (vector_step % jnp.maximum(period, 1) == 0)
    return Reference(
        jnp.where(due, history.points, learner.reference.points),
        jnp.where(due, reservoir.count(history), learner.reference.num_filled),
    )


def _changes_within_iteration(method: Method) -> jax.Array:
    return method.from_history & (method.refresh_period > 0)


def _draw(components: Components, learner: Learner, key: jax.Array) -> Experience:
    """Draws the batches of one vector step, [updates, B]."""
    config = components.config
    shape = (config.updates_per_vector_step, config.learner.batch_size)
    starts = learner.episodes.starts.obs
    return experience.sample(components, learner.replay, starts, shape, key)


def _learn(
    components: Components, method: Method, learner: Learner, drawn: Experience, key: jax.Array
) -> tuple[Learned, Metrics]:
    """The gradient steps of one vector step, on rewards of the learner's reference."""
    config = components.config
    key_bonus, key_update = jax.random.split(key)
    # Stored distances stay valid while the reference does; the branch touches only drawn rows.
    distances = jax.lax.cond(
        _changes_within_iteration(method) & (not config.intrinsic.stale_rewards),
        lambda x: experience.measure(components, learner.reference, x.features, x.next_features),
        lambda x: x.distances,
        drawn.outcomes,
    )
    drawn = drawn._replace(outcomes=drawn.outcomes._replace(distances=distances))
    bonus, paid, of_bonus = payment.pay(components, learner, drawn, key_bonus)
    total, beyond = payment.returns(drawn.outcomes, paid, config.learner.discount)
    batches = losses.Batch(drawn.observation, drawn.action, total, drawn.next_observation, beyond)

    only_critics = None
    if config.downstream.critic_steps:
        only_critics = learner.env_steps <= config.downstream.critic_steps

    def update(agent, batch_and_key):
        batch, key = batch_and_key
        return sac_agent.update(components.sac, agent, batch, key, only_critics)

    keys = jax.random.split(key_update, config.updates_per_vector_step)
    agent, metrics = jax.lax.scan(update, learner.agent, (batches, keys))
    metrics = jax.tree.map(jnp.mean, metrics | of_bonus)
    metrics |= {
        "replay_reward": jnp.mean(components.unshaped_reward(distances.reached[..., 0])),
        "replay_paid": jnp.mean(paid[..., 0]),
        "replay_bonus": jnp.mean(drawn.outcomes.bonus[..., 0]),
    }
    return Learned(agent, bonus), metrics
