"""The rewards of the steps that SAC learns from: r_t or a bonus, plus a task's reward."""

from typing import Any

import jax
import jax.numpy as jnp

from maxent_jax import rewards
from maxent_jax.algorithm.learner import Learner
from maxent_jax.components import Components
from maxent_jax.density import histogram
from maxent_jax.envs.skills import without_skill
from maxent_jax.intrinsic import Steps
from maxent_jax.mixture.occupancy import Occupancy
from maxent_jax.sac import agent as sac_agent
from maxent_jax.types import Experience, Metrics, Outcomes, Transition

SMALLEST_SIZE = 1e-8  # standard deviation by which a bonus is divided


def pay(
    components: Components, learner: Learner, drawn: Experience, key: jax.Array
) -> tuple[Any, jax.Array, Metrics]:
    """Pays the steps of a draw, and trains the bonus on them if there is one.

    Args:
      components: the static part.
      learner: the learner; its bonus pays before it learns.
      drawn: [updates, B] of n steps each, with their distances to the learner's reference.
      key: typed.
    Returns:
      The bonus's new state, the reward of each step [updates, B, n], and the bonus's metrics.
    """
    metrics: Metrics = {}
    if components.bonus is None:
        bonus, paid = learner.bonus, intrinsic(components, drawn.outcomes)
    else:
        bonus, paid, metrics = pay_bonus(components, learner, drawn, key)
    return bonus, with_task(components, learner, paid, drawn.outcomes), metrics


def intrinsic(components: Components, outcomes: Outcomes) -> jax.Array:
    """Returns the intrinsic reward of SAC, [...]: r_t, shaping, episodic term, alive bonus."""
    own, distances = components.config.intrinsic, outcomes.distances
    paid = components.unshaped_reward(distances.reached) + own.episodic_weight * outcomes.bonus
    if own.shaping > 0:
        paid = rewards.shaped(
            paid,
            potential=own.shaping * components.unshaped_reward(distances.potential),
            next_potential=own.shaping * components.unshaped_reward(distances.next_potential),
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


def episodic_term(
    components: Components,
    learner: Learner,
    transition: Transition,
    features: jax.Array,
    taken: jax.Array,
) -> tuple[Any, jax.Array | None, jax.Array]:
    """Rewards states that are new within their episode, and remembers the states that were left.

    Args:
      components: the static part.
      learner: the learner before the step.
      transition: [N, ...] a step of the agent in each environment.
      features: [N, F] of the states reached.
      taken: [N] int32, the steps that the episode had before this one.
    Returns:
      The bonus's new state, the new memory, and the term [N] of the states reached.
    """
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
    assert episodic is not None  # otherwise there is no memory
    memory = memory.at[rows, taken].set(episodic.embed(bonus, left))
    embedded = episodic.embed(bonus, features)
    bonus, novelty = episodic.novelty(bonus, embedded, memory, taken + 1)
    return bonus, memory, novelty


def pay_bonus(
    components: Components, learner: Learner, drawn: Experience, key: jax.Array
) -> tuple[Any, jax.Array, Metrics]:
    """Returns the bonus after learning from the draw, its reward [updates, B, 1], and metrics."""
    payer = components.bonus
    assert payer is not None
    key_value, key_learn = jax.random.split(key)
    parameters, outcomes = learner.agent.parameters, drawn.outcomes
    steps = Steps(
        features=outcomes.features[..., 0, :],
        action=drawn.action,
        next_features=outcomes.next_features[..., 0, :],
        state=_without_skill(components, drawn.observation),
        next_state=_without_skill(components, drawn.next_observation),
        value=sac_agent.value(components.sac, parameters, drawn.next_observation, key_value),
        episodic=outcomes.bonus[..., 0],
        row=drawn.row,
        cell=_cells(components, drawn.next_observation),
        skill=_skill(components, drawn.observation),
    )
    together = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps)
    bonus, found = payer.reward(learner.bonus, together)
    size = jnp.std(found)
    # SAC's temperature needs rewards of a fixed scale.
    unit = 1.0 if payer.has_scale else jnp.maximum(size, SMALLEST_SIZE)
    paid = components.config.intrinsic.reward_scale * found / unit

    def learn(bonus, batch_and_key):
        return payer.learn(bonus, *batch_and_key)

    keys = jax.random.split(key_learn, steps.value.shape[0])
    bonus, metrics = jax.lax.scan(learn, bonus, (steps, keys))
    paid = paid.reshape(*steps.value.shape, 1) + _for_living(components, outcomes)
    return bonus, paid, metrics | {"bonus_size": size}


def refresh_bonus(components: Components, bonus: Any, visited: Occupancy) -> Any:
    """Gives the bonus the cells that the mixture visits, if it uses them."""
    if components.bonus is None or components.bonus.refresh is None:
        return bonus
    return components.bonus.refresh(
        bonus, histogram.count(visited.states, components.grid, visited.weight)
    )


def _for_living(components: Components, outcomes: Outcomes) -> jax.Array:
    return components.config.intrinsic.alive_bonus * (1.0 - outcomes.terminated)


def _without_skill(components: Components, states: jax.Array) -> jax.Array:
    size = components.config.environment.skill_size
    return without_skill(states, size) if size else states


def _skill(components: Components, states: jax.Array) -> jax.Array | None:
    size = components.config.environment.skill_size
    return states[..., -size:] if size else None


def _cells(components: Components, states: jax.Array) -> jax.Array:
    flat = states.reshape(-1, states.shape[-1])
    return histogram.cells(flat, components.grid).reshape(states.shape[:-1])
