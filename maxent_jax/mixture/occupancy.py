"""The states that a mixture visits: rolled out, weighted, sampled, and scored by policy."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import mixture, rewards, rollout
from maxent_jax.components import Components
from maxent_jax.config.registry import CORRECTIVE
from maxent_jax.density import entropy, histogram
from maxent_jax.density.knn import NONE_EXCLUDED, knn_distances
from maxent_jax.envs.base import State
from maxent_jax.mixture import Archive
from maxent_jax.rollout import Trajectories
from maxent_jax.sac import agent
from maxent_jax.types import Metrics


class Occupancy(NamedTuple):
    """R = T·E states of E episodes, with their share of the mixture's occupancy."""

    states: jax.Array  # [R, D]
    features: jax.Array  # [R, F]
    policy: jax.Array  # [R] int32, who reached it
    weight: jax.Array  # [R], sums to 1; 0 after an episode's end, or for a policy of weight 0
    alive: jax.Array  # [R] bool: reached before its episode's end
    episode_policy: jax.Array  # [E] int32
    num_invalid: jax.Array  # [] int32


class Scores(NamedTuple):
    """How each archived policy does under r_t, unshaped; 0 for an empty slot."""

    episode_return: jax.Array  # [P] undiscounted, mean over its episodes
    step_reward: jax.Array  # [P] mean over its states


def of_mixture(
    components: Components,
    archive: Archive,
    weights: jax.Array,
    starts: State,
    key: jax.Array,
    only_weighted: bool = False,
    deterministic: bool = False,
) -> Occupancy:
    """Rolls the mixture out, one policy for each episode.

    Unless the config pools, policies play equal numbers of episodes, up to one, and the states of
    each share its weight: episodes end early when health fails, and a pooled sample would weigh
    policies by how long they live. Pooled, policies are drawn by weight and all states count alike;
    and so they do where the config draws a policy by weight for each step.

    Args:
      weights: [P].
      starts: [E, ...].
      only_weighted: spend no episode on a policy of weight 0.
      deterministic: act by the policies' means.
    """
    key_assign, key_act = jax.random.split(key)
    num_episodes = starts.done.shape[0]
    if components.config.mixture.mixing == "step":
        act = _act_by_any(components, archive, weights, deterministic)
        reached = _play(components, act, starts, key_act)
        nobody = jnp.zeros(num_episodes, jnp.int32)
        return of_episodes(components, weights, nobody, *_visited(reached), alike=True)
    if components.config.mixture.pooled:
        plays, offset = weights, jax.random.uniform(key_assign)
    else:
        slots = jnp.arange(weights.shape[0])
        chosen = weights > 0 if only_weighted else slots < archive.size
        plays, offset = chosen / jnp.sum(chosen), jnp.asarray(0.5)
    episode_policy = mixture.assign_episodes(plays, num_episodes, offset)
    reached = play(components, archive, episode_policy, starts, key_act, deterministic)
    pooled = components.config.mixture.pooled
    return of_episodes(components, weights, episode_policy, *_visited(reached), alike=pooled)


def corrected(
    components: Components, occupancy: Occupancy, weights: jax.Array
) -> tuple[Occupancy, jax.Array]:
    """The same states with fully corrective weights where the config has them, and the weights.

    Args:
      weights: [P] with which the occupancy was made.
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
    """The states of episodes that were played, weighted as of_mixture says.

    Args:
      weights: [P].
      episode_policy: [E] int32, who played each.
      states, alive: [T, E, D] and [T, E] bool, as in Trajectories.
      alike: every state counts the same, whoever reached it.
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


def play(
    components: Components,
    archive: Archive,
    episode_policy: jax.Array,
    starts: State,
    key: jax.Array,
    deterministic: bool = False,
) -> Trajectories:
    """Episodes from `starts` [E, ...], each played by the policy in its slot, [E] int32.

    Every episode holds its own copy of the actor's weights: E times their size in memory.
    """
    policies = mixture.policy(archive, episode_policy).policy

    def act(observation, key_step):
        keys = jax.random.split(key_step, episode_policy.shape[0])
        one = lambda policy, s, k: agent.act(components.sac, policy, s, k, deterministic)
        return jax.vmap(one)(policies, observation, keys)

    return _play(components, act, starts, key)


def _act_by_any(components: Components, archive: Archive, weights: jax.Array, deterministic: bool):
    """observation [E, D], key -> [E, A] by a policy drawn by weight for each episode's step.

    All policies act, and one action is taken: weights of networks are not moved.
    """

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


def _visited(reached: Trajectories) -> tuple[jax.Array, jax.Array, jax.Array]:
    return reached.states, reached.alive, reached.num_invalid


def score(
    components: Components,
    occupancy: Occupancy,
    points: jax.Array,
    rows: jax.Array,
    archive: Archive,
    num_filled: jax.Array | None = None,
) -> Scores:
    """Each policy's return under the reward that the reference points define.

    Args:
      points: [M, F] the reference.
      rows: [M] int32, which row of the occupancy each point is; -1 for none. A state does not see
        itself, nor, with leave_own_out, any state of its own policy or of others that the same
        iteration archived, unless that leaves fewer than k. Points of a history carry no row: a
        state that entered it is not told apart.
      archive: whose policies are scored.
      num_filled: [] how many of the points are there; all when left out.
    """
    config = components.config
    num_rows = occupancy.policy.shape[0]
    capacity = jax.tree.leaves(archive.parameters)[0].shape[0]
    label = capacity + jnp.arange(num_rows, dtype=jnp.int32)  # by itself, or by its iteration
    if config.mixture.leave_own_out:
        iteration = (occupancy.policy + config.mixture.snapshots - 1) // config.mixture.snapshots
        owner = jnp.where(rows < 0, -1, iteration[rows])
        others = jnp.sum(owner[None] != jnp.arange(capacity)[:, None], axis=1)  # [P]
        alone = others < config.intrinsic.num_neighbors
        label = jnp.where(alone[iteration], label, iteration)
    point_label = jnp.where(rows < 0, NONE_EXCLUDED - 1, label[rows])
    distance = knn_distances(
        occupancy.features,
        points,
        config.intrinsic.num_neighbors,
        exclude=label,
        count=num_filled,
        labels=point_label,
    )[:, -1]
    reward = rewards.of_distance(
        distance, config.intrinsic.reward, config.intrinsic.reward_distance, points.shape[1]
    )
    alive = occupancy.alive.astype(jnp.float32)
    total = jnp.zeros(capacity).at[occupancy.policy].add(jnp.where(alive > 0, reward, 0.0))
    lived = jnp.zeros(capacity).at[occupancy.policy].add(alive)
    played = jnp.zeros(capacity).at[occupancy.episode_policy].add(1.0)
    return Scores(total / jnp.maximum(played, 1), total / jnp.maximum(lived, 1))


def best(scores: Scores, occupancy: Occupancy) -> jax.Array:
    """[] int32: the policy of highest return among those that played."""
    capacity = scores.episode_return.shape[0]
    played = jnp.zeros(capacity, bool).at[occupancy.episode_policy].set(True)
    return jnp.argmax(jnp.where(played, scores.episode_return, -jnp.inf)).astype(jnp.int32)


def measures(components: Components, occupancy: Occupancy, key: jax.Array) -> Metrics:
    """Coverage and entropies of the mixture, on the environment's grid and in feature space."""
    config = components.config
    cells = histogram.count(occupancy.states, components.grid, occupancy.weight)
    rows = mixture.draw_rows(occupancy.weight, config.mixture.reference_size, key)
    sample = occupancy.features[rows]
    return {
        "mixture_coverage": histogram.coverage(cells),
        "mixture_entropy": histogram.shannon_entropy(cells),
        "mixture_off_grid_share": jnp.maximum(1 - jnp.sum(cells), 0.0),  # sums round
        "mixture_knn_entropy": entropy.knn_entropy(
            sample, config.intrinsic.num_neighbors, labels=rows
        ),
        "evaluation_episode_length": jnp.sum(occupancy.alive) / occupancy.episode_policy.shape[0],
    }
