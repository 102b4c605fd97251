"""One vector step with its gradient steps, under the current reward."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import rewards
from maxent_jax.algorithm import experience
from maxent_jax.algorithm.experience import Reference
from maxent_jax.algorithm.methods import Method
from maxent_jax.components import Components
from maxent_jax.density import histogram, plane, reservoir
from maxent_jax.density.reservoir import Reservoir
from maxent_jax.envs import base
from maxent_jax.envs.base import Episodes
from maxent_jax.envs.skills import without_skill
from maxent_jax.intrinsic import Steps
from maxent_jax.mixture.occupancy import Occupancy
from maxent_jax.sac import agent as sac_agent
from maxent_jax.sac import losses
from maxent_jax.sac.agent import Agent
from maxent_jax.sac.replay import Replay
from maxent_jax.types import Experience, Metrics, Outcomes, Transition

NUM_RESTARTS = 1024  # at most, see base.Restarts
SMALLEST_SIZE = 1e-8  # standard deviation by which a bonus is divided


class Visits(NamedTuple):
    """Counts of every state visited so far."""

    cells: jax.Array  # [bins, bins] int32
    off_grid: jax.Array  # [] int32


class Learner(NamedTuple):
    """All that training within an iteration changes."""

    agent: Agent
    replay: Replay
    place: jax.Array  # [N] int32, where the replay finds each env's state: see experience.Step
    episodes: Episodes  # [N] of the agent, then [N] of the random baseline if there is one
    memory: jax.Array | None  # [N, T, F] states of each episode so far, for an episodic term
    bonus: Any  # the bonus's state; None without one
    reference: Reference
    history: Reservoir
    visits: Visits
    random_visits: Visits
    env_steps: jax.Array  # [] int32, of the agent
    gradient_steps: jax.Array  # [] int32
    first_steps: jax.Array | None = None  # [] int32, env steps before training, see finetune
    plane: jax.Array | None = None  # visited unit cells; None where positions are not metres


class Learned(NamedTuple):
    """What gradient steps change."""

    agent: Agent
    bonus: Any


def init(components: Components, key: jax.Array) -> Learner:
    """Returns a new learner with new episodes, an empty replay and an empty reference."""
    config, sac = components.config, components.sac
    zero = jnp.zeros((), jnp.int32)
    key_agent, key_episodes, key_bonus = jax.random.split(key, 3)
    num_rows = config.budget.num_envs * (2 if config.evaluation.random_baseline else 1)
    dims = len(components.phi.names)
    episodes = base.init(components.env, num_rows, config.environment.num_starts, key_episodes)
    if config.downstream.restart_share:  # until finetune puts others in their place
        restarts = jax.tree.map(lambda x: x[:NUM_RESTARTS], episodes.starts)
        no_age = jnp.zeros(restarts.done.shape, jnp.int32)
        episodes = base.with_restarts(episodes, restarts, base.Restarts(jnp.zeros(()), no_age))
    if config.environment.cell_restarts:
        of_agent = (jnp.arange(num_rows) < config.budget.num_envs).astype(jnp.float32)
        share = config.environment.cell_restarts * of_agent
        episodes = base.with_cells(episodes, components.grid.num_cells, share)
    episodic = components.bonus and components.bonus.episodic
    remembered = episodic.size if episodic else dims
    memory = None
    if config.intrinsic.episodic_weight > 0 or episodic:
        memory = jnp.zeros((config.budget.num_envs, config.environment.episode_length, remembered))
    unvisited = Visits(jnp.zeros(components.grid.bins, jnp.int32), zero)
    return Learner(
        agent=sac_agent.init(sac, key_agent),
        replay=experience.init(components),
        place=-1 - episodes.start[: config.budget.num_envs],
        episodes=episodes,
        memory=memory,
        bonus=components.bonus.init(key_bonus) if components.bonus else None,
        reference=Reference(jnp.zeros((config.mixture.reference_size, dims)), zero),
        history=reservoir.init(config.mixture.reference_size, dims),
        visits=unvisited,
        random_visits=unvisited,
        env_steps=zero,
        gradient_steps=zero,
        first_steps=None if components.task is None else zero,
        plane=plane.empty() if components.in_metres else None,
    )


class _Keys(NamedTuple):
    """The keys of one vector step."""

    act: jax.Array
    random: jax.Array
    env: jax.Array
    history: jax.Array
    yaw: jax.Array
    learn: jax.Array


def _keys(key: jax.Array) -> _Keys:
    return _Keys(*jax.random.split(key, 6))


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
    def draw(learner, key_learn):
        return learner.replay.size > 0, _draw(components, learner, key_learn)

    def step_and_draw(carry, keys):
        learner, (ready, batches) = carry
        own, next_key_learn = keys
        learner, metrics = _step_beside(components, method, learner, ready, batches, own)
        return (learner, draw(learner, next_key_learn)), metrics

    every = jax.vmap(_keys)(keys)
    first = learner, draw(learner, every.learn[0])
    (learner, _), metrics = jax.lax.scan(step_and_draw, first, (every, jnp.roll(every.learn, -1)))
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
    drawn = _draw(components, learner, keys.learn)
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
    """Steps all envs once; beside it, takes the gradient steps, if the draw holds anything."""
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
    """Adds the transitions of a vector step to all that remembers them."""
    config = components.config
    taken = base.steps_taken(learner.episodes)[: config.budget.num_envs]
    transition = jax.tree.map(lambda x: x[: config.budget.num_envs], everyone)
    others = jax.tree.map(lambda x: x[config.budget.num_envs :], everyone)

    features = components.phi(transition.next_observation)
    history = reservoir.add(learner.history, features, transition.valid, keys.history)
    reference = _refreshed(components, method, learner, history)
    bonus, memory, novelty = _episodic(components, learner, transition, features, taken)
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
        plane=_visit_plane(components, learner, transition),
    )
    metrics: Metrics = {}
    if components.torso is not None:
        flipped = components.torso.flipped(transition.next_observation)
        metrics["flipped_share"] = jnp.mean(flipped.astype(jnp.float32))
    reached = ring.items.distances.reached.at[rows, 0].get(mode="fill", fill_value=1.0)
    num_valid = jnp.maximum(jnp.sum(transition.valid), 1)
    if ring.items.task is not None:
        earned = ring.items.task.at[rows, 0].get(mode="fill", fill_value=0.0)
        metrics["task_step_reward"] = jnp.sum(earned * transition.valid) / num_valid
    metrics |= {
        "step_reward": jnp.sum(unshaped_reward(components, reached) * transition.valid) / num_valid,
        "num_deaths": jnp.sum(transition.terminated, dtype=jnp.int32),
        "num_time_limits": jnp.sum(transition.truncated, dtype=jnp.int32),
        "num_invalid": jnp.sum(~everyone.valid, dtype=jnp.int32),
    }
    return learner, metrics


def unshaped_reward(components: Components, distance: jax.Array) -> jax.Array:
    """Returns r_t of states at a distance, [...] -> [...], for scores and plots."""
    config = components.config
    return rewards.of_distance(
        distance,
        config.intrinsic.reward,
        config.intrinsic.reward_distance,
        len(components.phi.names),
    )


def reward(components: Components, outcomes: Outcomes) -> jax.Array:
    """Returns the intrinsic reward of SAC, [...]: r_t, shaping, episodic term, alive bonus."""
    own, distances = components.config.intrinsic, outcomes.distances
    paid = unshaped_reward(components, distances.reached) + own.episodic_weight * outcomes.bonus
    if own.shaping > 0:
        potential = unshaped_reward(components, distances.potential)
        next_potential = unshaped_reward(components, distances.next_potential)
        paid = rewards.shaped(
            paid,
            potential=own.shaping * potential,
            next_potential=own.shaping * next_potential,
            discount=components.config.learner.discount,
            alive=1.0 - outcomes.terminated,
            survives_death=own.shaping_survives_death,
        )
    return own.reward_scale * paid + _for_living(components, outcomes)


def with_task(
    components: Components, learner: Learner, intrinsic: jax.Array, outcomes: Outcomes
) -> jax.Array:
    """Returns the task's reward plus β times the intrinsic reward, [..., n], if there is a task."""
    if outcomes.task is None:
        return intrinsic
    own = components.config.downstream
    weight = jnp.asarray(own.intrinsic_weight)
    if own.intrinsic_decay:
        weight *= jnp.maximum(1.0 - learner.env_steps / own.intrinsic_decay, 0.0)
    return own.task_scale * outcomes.task + weight * intrinsic


def _for_living(components: Components, outcomes: Outcomes) -> jax.Array:
    return components.config.intrinsic.alive_bonus * (1.0 - outcomes.terminated)


def returns(outcomes: Outcomes, paid: jax.Array, discount: float) -> tuple[jax.Array, jax.Array]:
    """Returns the discounted n-step reward [...], and the factor [...] on γ V(s') after it.

    The entropy of the policy counts from the last state on, as usual in n-step SAC.

    Args:
      paid: [..., n] the reward of each step.
      discount: γ.
    """
    taken = outcomes.taken.astype(jnp.float32)
    before = jax.lax.broadcasted_iota(jnp.float32, paid.shape, paid.ndim - 1)
    terminated = jnp.any(outcomes.terminated & outcomes.taken, axis=-1)
    beyond = discount ** (jnp.sum(taken, -1) - 1) * (1.0 - terminated)
    return jnp.sum(paid * taken * discount**before, axis=-1), beyond


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


def _episodic(components, learner, transition: Transition, features, taken):
    """The bonus, the memory with the states left, and the episodic term of the states reached."""
    config, bonus, memory = components.config, learner.bonus, learner.memory
    if memory is None:
        return bonus, memory, jnp.zeros(config.budget.num_envs)
    rows, left = jnp.arange(config.budget.num_envs), components.phi(transition.observation)
    if components.bonus is None:
        memory = memory.at[rows, taken].set(left)
        novelty = rewards.episodic_bonus(
            features, memory, taken + 1, config.intrinsic.num_neighbors
        )
        return bonus, memory, novelty
    episodic = components.bonus.episodic
    memory = memory.at[rows, taken].set(episodic.embed(bonus, left))
    embedded = episodic.embed(bonus, features)
    bonus, novelty = episodic.novelty(bonus, embedded, memory, taken + 1)
    return bonus, memory, novelty


def visit(components: Components, visits: Visits, states: jax.Array, counts: jax.Array) -> Visits:
    """Adds states to the counts.

    Args:
      states: [B, D] states.
      counts: [B] bool, the states that count.
    Returns:
      The new counts.
    """
    number = counts.astype(jnp.int32)
    cells = histogram.count(states, components.grid, number)
    return Visits(visits.cells + cells, visits.off_grid + jnp.sum(number) - jnp.sum(cells))


def _visit_plane(
    components: Components, learner: Learner, transition: Transition
) -> jax.Array | None:
    if learner.plane is None:
        return None
    places = histogram.locate(transition.next_observation, components.grid)
    return plane.visit(learner.plane, places, transition.valid)


def _draw(components: Components, learner: Learner, key: jax.Array) -> Experience:
    """Draws the batches of one vector step, [updates, B]."""
    config = components.config
    key_sample, _ = jax.random.split(key)
    shape = (config.updates_per_vector_step, config.learner.batch_size)
    starts = learner.episodes.starts.obs
    return experience.sample(components, learner.replay, starts, shape, key_sample)


def _learn(
    components: Components, method: Method, learner: Learner, drawn: Experience, key: jax.Array
) -> tuple[Learned, Metrics]:
    """The gradient steps of one vector step, on rewards of the learner's reference."""
    config = components.config
    _, key_update = jax.random.split(key)
    # Stored distances stay valid while the reference does; the branch touches only drawn rows.
    distances = jax.lax.cond(
        _changes_within_iteration(method) & (not config.intrinsic.stale_rewards),
        lambda x: experience.measure(components, learner.reference, x.features, x.next_features),
        lambda x: x.distances,
        drawn.outcomes,
    )
    outcomes = drawn.outcomes._replace(distances=distances)
    of_bonus: Metrics = {}
    if components.bonus is None:
        bonus, paid = learner.bonus, reward(components, outcomes)
    else:
        key_bonus = jax.random.fold_in(key, 2)
        bonus, paid, of_bonus = _paid_by_bonus(components, learner, drawn, key_bonus)
    paid = with_task(components, learner, paid, outcomes)
    total, beyond = returns(outcomes, paid, config.learner.discount)
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
        "replay_reward": jnp.mean(unshaped_reward(components, distances.reached[..., 0])),
        "replay_paid": jnp.mean(paid[..., 0]),
        "replay_bonus": jnp.mean(outcomes.bonus[..., 0]),
    }
    return Learned(agent, bonus), metrics


def _paid_by_bonus(
    components: Components, learner: Learner, drawn: Experience, key: jax.Array
) -> tuple[Any, jax.Array, Metrics]:
    """The bonus after learning from the draw, its reward before learning [..., 1], and metrics."""
    # It sees features, as every other reward does; with skills also states. Unless it has a scale,
    # its reward is divided by the standard deviation over the draw: SAC's temperature needs one.
    payer = components.bonus
    assert payer is not None
    key_value, key_learn = jax.random.split(key)
    parameters, outcomes = learner.agent.parameters, drawn.outcomes
    steps = Steps(
        observation=outcomes.features[..., 0, :],
        action=drawn.action,
        next_observation=outcomes.next_features[..., 0, :],
        value=sac_agent.value(components.sac, parameters, drawn.next_observation, key_value),
        episodic=outcomes.bonus[..., 0],
        row=drawn.row,
        cell=_cells(components, drawn.next_observation),
        **_states(components, drawn),
    )
    together = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps)
    bonus, found = payer.reward(learner.bonus, together)
    size = jnp.std(found)
    unit = 1.0 if payer.has_scale else jnp.maximum(size, SMALLEST_SIZE)
    paid = components.config.intrinsic.reward_scale * found / unit

    def learn(bonus, batch_and_key):
        return payer.learn(bonus, *batch_and_key)

    keys = jax.random.split(key_learn, steps.value.shape[0])
    bonus, metrics = jax.lax.scan(learn, bonus, (steps, keys))
    paid = paid.reshape(*steps.value.shape, 1) + _for_living(components, outcomes)
    return bonus, paid, metrics | {"bonus_size": size}


def _states(components: Components, drawn: Experience) -> dict[str, jax.Array]:
    """Before and after the step, what the networks see; and the skill, apart."""
    size = components.config.environment.skill_size
    if not size:
        return {}
    return {
        "state": without_skill(drawn.observation, size),
        "next_state": without_skill(drawn.next_observation, size),
        "skill": drawn.observation[..., -size:],
    }


def _cells(components: Components, states: jax.Array) -> jax.Array:
    flat = states.reshape(-1, states.shape[-1])
    return histogram.cells(flat, components.grid).reshape(states.shape[:-1])


def refresh_bonus(components: Components, bonus: Any, visited: Occupancy) -> Any:
    """Gives the bonus the cells that the mixture visits, if it uses them."""
    if components.bonus is None or components.bonus.refresh is None:
        return bonus
    return components.bonus.refresh(
        bonus, histogram.count(visited.states, components.grid, visited.weight)
    )
