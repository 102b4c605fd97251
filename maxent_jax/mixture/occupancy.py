"""The states that a mixture visits: rolls them out, weighs them, and measures them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import mixture, rollout
from maxent_jax.components import Components
from maxent_jax.config.registry import CORRECTIVE
from maxent_jax.density import entropy, histogram, plane
from maxent_jax.envs.base import State
from maxent_jax.mixture import Archive
from maxent_jax.rollout import Trajectories
from maxent_jax.sac import agent
from maxent_jax.types import Metrics


class Occupancy(NamedTuple):
    """The R = T·E states of E episodes, step by step, with their shares of the occupancy."""

    states: jax.Array  # [R, D]
    features: jax.Array  # [R, F]
    policy: jax.Array  # [R] int32, the policy that reached the state
    weight: jax.Array  # [R], sums to 1; 0 after an episode's end, or for a policy of weight 0
    alive: jax.Array  # [R] bool: reached before the episode's end
    episode_policy: jax.Array  # [E] int32
    num_invalid: jax.Array  # [] int32
    task_return: jax.Array | None = None  # [E] of each episode, undiscounted; None without a task

    @property
    def num_episodes(self) -> int:
        """E."""
        return self.episode_policy.shape[0]


def of_mixture(
    components: Components,
    archive: Archive,
    weights: jax.Array,
    starts: State,
    key: jax.Array,
    only_weighted: bool = False,
    deterministic: bool = False,
) -> Occupancy:
    """Rolls the mixture out; one policy plays each episode.

    By default the policies play equal numbers of episodes (they differ by at most one), and the
    states of a policy share its weight. Health termination ends episodes early, so a pooled sample
    would give long-lived policies more weight. With `pooled`, policies are drawn by weight and all
    states count the same. With `mixing` step, a policy is drawn by weight at each step, and all
    states count the same too.

    Args:
      weights: [P] of the policies.
      starts: [E, ...] first states.
      only_weighted: a policy of weight 0 plays no episode.
      deterministic: the policies act by their means.
    Returns:
      The occupancy, R = T·E states.
    """
    key_assign, key_act = jax.random.split(key)
    own, num_episodes = components.config.mixture, starts.done.shape[0]
    if own.mixing == "step":
        act = _act_by_any(components, archive, weights, deterministic)
        reached = _play(components, act, starts, key_act)
        episode_policy = jnp.zeros(num_episodes, jnp.int32)  # no episode belongs to one policy
    else:
        if own.pooled:
            plays, offset = weights, jax.random.uniform(key_assign)
        else:
            slots = jnp.arange(weights.shape[0])
            chosen = weights > 0 if only_weighted else slots < archive.size
            plays, offset = chosen / jnp.sum(chosen), jnp.asarray(0.5)
        episode_policy = mixture.assign_episodes(plays, num_episodes, offset)
        reached = play(components, archive, episode_policy, starts, key_act, deterministic)
    alike = own.pooled or own.mixing == "step"
    played = reached.states, reached.alive, reached.num_invalid
    found = of_episodes(components, weights, episode_policy, *played, alike)
    return found._replace(task_return=task_returns(components, starts, reached))


def corrected(
    components: Components, occupancy: Occupancy, weights: jax.Array
) -> tuple[Occupancy, jax.Array]:
    """Reweighs the states by fully corrective weights, if the config asks for them.

    Args:
      weights: [P] with which the occupancy was made.
    Returns:
      The occupancy and the weights [P]; both unchanged under any other kind of weights.
    """
    if components.config.mixture.weights != CORRECTIVE:
        return occupancy, weights

    def cells_of(slot):
        share = jnp.where(occupancy.policy == slot, occupancy.weight, 0.0)
        share = share / jnp.maximum(jnp.sum(share), 1e-30)
        return histogram.count(occupancy.states, components.grid, share).reshape(-1)

    cells = jax.vmap(cells_of)(jnp.arange(weights.shape[0]))
    off_grid = jnp.maximum(1 - jnp.sum(cells, axis=1, keepdims=True), 0.0)
    found = mixture.most_entropic_weights(jnp.concatenate([cells, off_grid], axis=1), weights)
    factor = jnp.where(weights > 0, found / jnp.where(weights > 0, weights, 1), 0.0)
    weight = occupancy.weight * factor[occupancy.policy]
    return occupancy._replace(weight=weight / jnp.sum(weight)), found


def of_episodes(
    components: Components,
    weights: jax.Array,
    episode_policy: jax.Array,
    states: jax.Array,
    alive: jax.Array,
    num_invalid: jax.Array,
    alike: bool = False,
) -> Occupancy:
    """Makes an occupancy from episodes that were played, weighted as in `of_mixture`.

    Args:
      weights: [P] of the policies.
      episode_policy: [E] int32, the policy that played each episode.
      states: [T, E, D], as in Trajectories.
      alive: [T, E] bool, as in Trajectories.
      num_invalid: [] int32, states that were not finite.
      alike: every state counts the same, whichever policy reached it.
    Returns:
      The occupancy, R = T·E states.
    """
    states = states.reshape(-1, states.shape[-1])
    policy = jnp.broadcast_to(episode_policy, alive.shape).reshape(-1)
    lives = alive.reshape(-1).astype(jnp.float32)
    if alike:
        weight = lives
    else:
        lived = jnp.zeros(weights.shape[0]).at[policy].add(lives)
        weight = lives * (weights / jnp.maximum(lived, 1))[policy]
    return Occupancy(
        states=states,
        features=components.phi(states),
        policy=policy,
        weight=weight / jnp.sum(weight),
        alive=lives > 0,
        episode_policy=episode_policy,
        num_invalid=num_invalid,
    )


def task_returns(components: Components, starts: State, reached: Trajectories) -> jax.Array | None:
    """Returns what the task pays for each episode from `starts` [E, ...], undiscounted, [E]."""
    if components.task is None:
        return None
    before = jnp.concatenate([starts.obs[None], reached.states[:-1]])
    paid = components.task.pay(before, reached.actions, reached.states, reached.env.reward)
    return jnp.sum(jnp.where(reached.alive, paid, 0.0), axis=0)


def play(
    components: Components,
    archive: Archive,
    episode_policy: jax.Array,
    starts: State,
    key: jax.Array,
    deterministic: bool = False,
) -> Trajectories:
    """Plays an episode from each of `starts` [E, ...] by the policy in slot `episode_policy` [E].

    Each episode holds its own copy of the actor's weights: E times their size in memory.
    """
    policies = mixture.policy(archive, episode_policy).policy

    def act(observation, key_step):
        keys = jax.random.split(key_step, episode_policy.shape[0])
        one = lambda policy, s, k: agent.act(components.sac, policy, s, k, deterministic)
        return jax.vmap(one)(policies, observation, keys)

    return _play(components, act, starts, key)


def _act_by_any(components: Components, archive: Archive, weights: jax.Array, deterministic: bool):
    """observation [E, D], key -> [E, A], by a policy drawn by weight at each step of an episode."""

    # All policies act and one action is taken: this copies no network weights.
    def act(observation, key_step):
        key_draw, key_act = jax.random.split(key_step)
        keys = jax.random.split(key_act, weights.shape[0])
        one = lambda policy, k: agent.act(components.sac, policy, observation, k, deterministic)
        actions = jax.vmap(one)(archive.parameters.policy, keys)  # [P, E, A]
        drawn = jax.random.categorical(key_draw, jnp.log(weights), shape=observation.shape[:1])
        return jnp.take_along_axis(actions, drawn[None, :, None], axis=0)[0]

    return act


def _play(components, act, starts, key):
    return rollout.episodes(
        components.env, starts, act, components.config.environment.episode_length, key
    )


def measures(components: Components, occupancy: Occupancy, key: jax.Array) -> Metrics:
    """Measures the mixture's coverage and entropies (nats), on the grid and in feature space."""
    config = components.config
    cells = histogram.count(occupancy.states, components.grid, occupancy.weight)
    # Copies of a state would be each other's neighbours, and the estimate biased.
    rows, count = mixture.draw_distinct(
        occupancy.weight, config.mixture.reference_size, key, occupancy.num_episodes
    )
    off_grid = histogram.cells(occupancy.states, components.grid) == components.grid.num_cells
    return {
        "mixture_coverage": histogram.coverage(cells),
        "mixture_entropy": histogram.shannon_entropy(cells),
        "mixture_off_grid_share": jnp.sum(jnp.where(off_grid, occupancy.weight, 0.0)),
        "mixture_knn_entropy": entropy.knn_entropy(
            occupancy.features[rows], config.intrinsic.num_neighbors, count
        ),
        "evaluation_episode_length": jnp.sum(occupancy.alive) / occupancy.episode_policy.shape[0],
        **_unit_cells(components, occupancy),
        **_task_measures(components, occupancy),
    }


def _unit_cells(components: Components, occupancy: Occupancy) -> Metrics:
    if not components.in_metres:
        return {}
    places = histogram.locate(occupancy.states, components.grid)
    visited = plane.visit(plane.empty(), places, occupancy.weight > 0)
    return {"mixture_cells_1m": plane.num_cells(visited)}


def _task_measures(components: Components, occupancy: Occupancy) -> Metrics:
    """The task's mean return over the episodes, and the share of successes if it is sparse."""
    if components.task is None or occupancy.task_return is None:
        return {}
    found = {"task_return": jnp.mean(occupancy.task_return)}
    if components.task.sparse:
        found["task_success"] = jnp.mean(occupancy.task_return > 0)
    return found
