"""The first state of a run that starts from the archived policies of another run."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import components, mixture
from maxent_jax.algorithm import experience, loop
from maxent_jax.algorithm.learner import NUM_RESTARTS, Learner, of_agent, visit, visit_plane
from maxent_jax.algorithm.loop import SEED_AXES, State
from maxent_jax.components import Components
from maxent_jax.config import Config, names
from maxent_jax.density import reservoir
from maxent_jax.envs import base
from maxent_jax.envs.base import Episodes
from maxent_jax.mixture import Archive, occupancy
from maxent_jax.precision import in_32_bits
from maxent_jax.rollout import Trajectories
from maxent_jax.sac import agent as sac_agent
from maxent_jax.sac.agent import Parameters
from maxent_jax.types import Transition


class Start(NamedTuple):
    """What the first episodes found; with several seeds, leaves have a leading axis [S, ...]."""

    policy: jax.Array  # [] int32, the policy that the run starts from; -1: from scratch
    task_return: jax.Array  # [P] of each policy, mean over its episodes; NaN if it played none
    num_steps: jax.Array  # [] int32, env steps of the first episodes


@in_32_bits
def start(config: Config, archive: Archive) -> tuple[State, Start]:
    """Returns the first state of a run that starts from an archive, as `downstream` says.

    With best, mixture and both, each policy first plays `first_episodes` episodes. Some play more
    if the episodes cannot be divided evenly into groups of `num_envs`. All of them count as env
    steps of the run.

    Args:
      config: the run's; its networks are those of the archive's policies.
      archive: of the run to start from.
    """
    own, size = config.downstream, int(archive.size)
    from_archive = functools.partial(
        _from_archive, config.program(), own.start_from, own.first_episodes * size, size
    )
    if config.num_seeds > 1:
        from_archive = jax.vmap(from_archive, (SEED_AXES, None), (SEED_AXES, 0))
    return jax.jit(from_archive)(loop.start(config), archive)


def _from_archive(
    config: Config, start_from: str, num_episodes: int, size: int, state: State, archive: Archive
) -> tuple[State, Start]:
    p, learner = components.make(config), state.learner
    key, key_first = jax.random.split(state.key)
    returns, num_steps = jnp.full(size, jnp.nan), jnp.zeros((), jnp.int32)
    if start_from in names.PLAYING:
        fills = start_from in names.FILLING
        learner, returns, num_steps = _play(
            p, learner, archive, size, num_episodes, fills, key_first
        )
    policy = jnp.asarray(-1, jnp.int32)
    if start_from in ("best", "both"):  # the newest of equals: of a sparse task all may fail
        policy = (size - 1 - jnp.argmax(returns[::-1])).astype(jnp.int32)
    elif start_from == "last":
        policy = jnp.asarray(size - 1, jnp.int32)
    if start_from in names.WITH_ITS_AGENT:
        parameters = mixture.policy(archive, policy)
        if p.config.downstream.restart_critics:
            fresh = learner.agent.parameters
            parameters = parameters._replace(critic=fresh.critic, target_critic=fresh.target_critic)
        learner = learner._replace(agent=sac_agent.restart(p.sac, parameters))
    initial: Parameters = learner.agent.parameters
    own = mixture.append(mixture.init(initial, config.archive_size), initial)
    learner = learner._replace(first_steps=num_steps)
    state = state._replace(key=key, learner=learner, archive=own)
    return state, Start(policy, returns, num_steps)


class _Played(NamedTuple):
    learner: Learner
    task_return: jax.Array  # [P] sums over the episodes
    episodes: jax.Array  # [P]
    num_steps: jax.Array  # [] int32


class _Episode(NamedTuple):
    """What restarts are drawn from, of E episodes."""

    env: base.State  # [T, E, ...]
    goes_on: jax.Array  # [T, E] bool: the episode continues after the state
    task_return: jax.Array  # [E]


def _play(
    p: Components,
    learner: Learner,
    archive: Archive,
    size: int,
    num_episodes: int,
    fills: bool,
    key: jax.Array,
) -> tuple[Learner, jax.Array, jax.Array]:
    """Plays the policies in turn; returns the learner, the mean returns [P], and the env steps."""
    # As many at once as the run has environments: the ring relies on this, see experience.
    num_groups = -(-num_episodes // p.config.budget.num_envs)
    at_once = -(-num_episodes // num_groups)
    numbers = jnp.arange(num_groups * at_once, dtype=jnp.int32).reshape(num_groups, at_once)
    policies = numbers % size
    nothing = jnp.zeros(size)

    def group(played: _Played, policy_and_key):
        policy, key = policy_and_key
        key_rows, key_play, key_history, key_fill = jax.random.split(key, 4)
        learner = played.learner
        rows = base.draw_rows(base.only_starts(learner.episodes), at_once, key_rows)
        starts = base.rows_of(learner.episodes.starts, rows)
        reached = occupancy.play(p, archive, policy, starts, key_play)
        returns = occupancy.task_returns(p, starts, reached)
        assert returns is not None  # Config demands a task
        states = reached.states.reshape(-1, reached.states.shape[-1])
        alive = reached.alive.reshape(-1)
        learner = learner._replace(
            history=reservoir.add(learner.history, p.phi(states), alive, key_history),
            visits=visit(p, learner.visits, states, alive),
            plane=visit_plane(p, learner.plane, states, alive),
        )
        if fills:
            learner = learner._replace(
                replay=_filled(p, learner, starts, reached, -1 - rows, key_fill),
                agent=sac_agent.see(p.sac, learner.agent, states, alive),
            )
        played = _Played(
            learner=learner,
            task_return=played.task_return.at[policy].add(returns),
            episodes=played.episodes.at[policy].add(1.0),
            num_steps=played.num_steps + jnp.sum(alive, dtype=jnp.int32),
        )
        goes_on = (reached.alive & ~reached.terminated).at[-1].set(False)  # the time limit
        return played, _Episode(reached.env, goes_on, returns)

    first = _Played(learner, nothing, nothing, jnp.zeros((), jnp.int32))
    key, key_restarts = jax.random.split(key)
    played, found = jax.lax.scan(group, first, (policies, jax.random.split(key, num_groups)))
    learner = played.learner
    if p.config.downstream.restart_share:
        together = jax.tree.map(_groups_side_by_side, found._replace(task_return=None))
        together = together._replace(task_return=found.task_return.reshape(-1))
        episodes = _restarting(p, learner.episodes, together, key_restarts)
        place = -1 - episodes.start[: p.config.budget.num_envs]
        learner = learner._replace(episodes=episodes, place=place)
    return learner, played.task_return / played.episodes, played.num_steps


def _groups_side_by_side(x: jax.Array) -> jax.Array:
    """[G, T, E, ...] -> [T, G·E, ...]."""
    x = jnp.swapaxes(x, 0, 1)
    return x.reshape(x.shape[0], x.shape[1] * x.shape[2], *x.shape[3:])  # x may be empty


def _restarting(p: Components, episodes: Episodes, found: _Episode, key: jax.Array) -> Episodes:
    """Lets a share of the agent's episodes begin at states of the best tenth of those found.

    An episode is drawn in proportion to how far its return is above the worst. If all returns are
    equal, as when a sparse task was never solved, all episodes are alike. One that ends with its
    first step has no state to begin at.
    """
    key_episode, key_time, key_begin = jax.random.split(key, 3)
    num = min(NUM_RESTARTS, p.config.environment.num_starts)
    returns = found.task_return
    least_of_best = jax.lax.top_k(returns, -(-returns.shape[0] // 10))[0][-1]
    has_any = jnp.any(found.goes_on, axis=0).astype(jnp.float32)
    above = has_any * jnp.where(returns >= least_of_best, returns - jnp.min(returns), 0.0)
    share = jnp.where(jnp.max(above) > 0, above, jnp.where(jnp.max(has_any) > 0, has_any, 1.0))
    chosen = jax.random.choice(key_episode, share.shape[0], (num,), p=share / jnp.sum(share))
    logits = jnp.where(found.goes_on[:, chosen], 0.0, -jnp.inf)
    time = jax.random.categorical(key_time, logits, axis=0)
    states = jax.tree.map(lambda x: x[time, chosen], found.env)
    restarts = base.Restarts(
        of_agent(p.config, episodes, p.config.downstream.restart_share), time + 1
    )
    episodes = base.with_restarts(episodes, states, restarts)
    return base.begin_again(episodes, key_begin)


def _filled(
    p: Components,
    learner: Learner,
    starts: base.State,
    reached: Trajectories,
    previous: jax.Array,
    key: jax.Array,
):
    """The replay with the episodes from `starts` [E, ...], whose first `previous` is given [E]."""
    before = jnp.concatenate([starts.obs[None], reached.states[:-1]])
    transitions = Transition(
        observation=before,
        action=reached.actions,
        next_observation=reached.states,
        terminated=reached.terminated,
        truncated=jnp.zeros_like(reached.terminated),
        valid=reached.alive,
        reward=reached.env.reward,
    )
    no_bonus = jnp.zeros(previous.shape[0])

    def add(carry, transition_and_key):
        ring, previous = carry
        transition, key = transition_and_key
        return experience.add(p, learner.reference, ring, transition, previous, no_bonus, key), None

    keys = jax.random.split(key, before.shape[0])
    (ring, _), _ = jax.lax.scan(add, (learner.replay, previous), (transitions, keys))
    return ring
