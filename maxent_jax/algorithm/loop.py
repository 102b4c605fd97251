"""Algorithm 1 for every method: pure functions from state to state.

    begin          roll the mixture out, define r_t from it, choose the agent to start from
    train_segment  a fixed number of env steps with their updates; archives a snapshot if one is due
    end            archive the agent, evaluate the mixture

`iterate` composes them, and `run` scans `iterate` as one program. A driver that logs and saves in
between calls the same three functions. Only a driver can end an iteration at a plateau
(convergence.py). A method is data in the state, so all methods share one program.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import components, mixture
from maxent_jax.algorithm import experience, methods, payment, training
from maxent_jax.algorithm.experience import Reference
from maxent_jax.algorithm.learner import Learner, Visits, init_learner
from maxent_jax.components import Components
from maxent_jax.config import Config
from maxent_jax.config.registry import CORRECTIVE, STARTS
from maxent_jax.density import histogram, plane, reservoir
from maxent_jax.envs import base
from maxent_jax.mixture import Archive, occupancy, scores
from maxent_jax.precision import in_32_bits
from maxent_jax.sac import agent
from maxent_jax.sac.agent import Agent
from maxent_jax.types import Metrics

EVALUATION_SEED = 0  # the mixture is measured with the same randomness every time


class State(NamedTuple):
    """All that the next step needs."""

    key: jax.Array  # typed
    iteration: jax.Array  # [] int32, completed iterations
    method: methods.Method
    archive: Archive
    learner: Learner


# With several seeds every leaf has a leading axis [S, ...], except the method, which all share:
# jax.vmap(f, (SEED_AXES,), SEED_AXES) for f: State -> State.
SEED_AXES = State(key=0, iteration=0, method=None, archive=0, learner=0)  # type: ignore[arg-type]


@in_32_bits
def init(config: Config, key: jax.Array) -> State:
    """Returns the state before the first iteration: the mixture is π_0, which is untrained."""
    return _init(config.program(), methods.make(config), key)


@in_32_bits
def start(config: Config) -> State:
    """Returns the first state of the config's seeds; [S, ...] if there are several."""
    if config.num_seeds == 1:
        return init(config, jax.random.key(config.seed))
    seeds = config.seed + jnp.arange(config.num_seeds)
    keys = jax.vmap(jax.random.key)(seeds)
    return jax.vmap(functools.partial(init, config), out_axes=SEED_AXES)(keys)


@functools.partial(jax.jit, static_argnums=0)
def _init(config: Config, method: methods.Method, key: jax.Array) -> State:
    key, key_learner = jax.random.split(key)
    learner = init_learner(components.make(config), key_learner)
    initial = learner.agent.parameters
    archive = mixture.append(mixture.init(initial, config.archive_size), initial)
    return State(key, jnp.zeros((), jnp.int32), method, archive, learner)


def shapes(config: Config) -> State:
    """Returns the shape and dtype of each leaf of one seed's first state, computing nothing."""
    table = jax.ShapeDtypeStruct((config.archive_size, config.archive_size), jnp.float32)
    number = jax.ShapeDtypeStruct((), jnp.int32)
    flag = jax.ShapeDtypeStruct((), jnp.bool_)
    method = methods.Method(table, number, flag, number)  # type: ignore[arg-type]
    key = jax.eval_shape(jax.random.key, 0)
    return jax.eval_shape(functools.partial(_init, config.program()), method, key)


@in_32_bits
def begin(config: Config, state: State) -> tuple[State, Metrics]:
    """Runs steps 1 to 3 of Algorithm 1, and chooses the agent with which step 4 starts."""
    p = components.make(config)
    learner, archive, method = state.learner, state.archive, state.method
    key, *keys = jax.random.split(state.key, 6)
    key_starts, key_rollout, key_rows, key_history, key_scratch = keys

    weights = method.weights[archive.size - 1]
    if not config.explores:  # nothing depends on what the mixture visits
        chosen = _start(p, method, archive, learner.agent, archive.size - 1, key_scratch)
        learner = learner._replace(agent=chosen)
        return state._replace(key=key, learner=learner), {"weights": weights}
    pool = base.only_starts(learner.episodes)
    starts = base.draw_starts(pool, config.mixture.mixture_episodes, key_starts)
    visited = occupancy.of_mixture(p, archive, weights, starts, key_rollout)
    visited, weights = occupancy.corrected(p, visited, weights)

    # While the history is empty, the first rollouts take its place.
    unseen = (learner.history.seen == 0) & visited.alive
    history = reservoir.add(learner.history, visited.features, unseen, key_history)
    rows = mixture.draw_rows(
        visited.weight, config.mixture.reference_size, key_rows, visited.num_episodes
    )
    rows = jnp.where(method.from_history, -1, rows)
    reference = Reference(
        jnp.where(method.from_history, history.points, visited.features[rows]),
        jnp.where(method.from_history, reservoir.count(history), config.mixture.reference_size),
    )
    earned = scores.score(p, visited, reference.points, rows, archive, reference.num_filled)
    best = scores.best(earned, visited)
    replay = learner.replay
    if not config.intrinsic.stale_rewards:
        replay = experience.measure_all(p, reference, replay, learner.episodes.starts.obs)
    learner = learner._replace(
        agent=_start(p, method, archive, learner.agent, best, key_scratch),
        replay=replay,
        reference=reference,
        history=history,
        bonus=payment.refresh_bonus(p, learner.bonus, visited),
    )
    metrics = {
        "weights": weights,
        "num_rollout_steps": jnp.sum(visited.alive, dtype=jnp.int32),
        "num_rollout_invalid": visited.num_invalid,
    }
    if config.mixture.mixing == "episode":  # otherwise no state belongs to one policy
        metrics |= {
            "best_policy": best,
            "policy_return": earned.episode_return,
            "policy_step_reward": earned.step_reward,
        }
    return state._replace(key=key, learner=learner), metrics


@in_32_bits
def train_segment(config: Config, state: State) -> tuple[State, Metrics]:
    """Trains for `config.vector_steps` vector steps with their gradient steps (step 4).

    Archives a snapshot of the agent afterwards, if one is due.
    """
    p = components.make(config)
    key, key_steps = jax.random.split(state.key)
    keys = jax.random.split(key_steps, config.vector_steps)
    learner, metrics = training.steps(p, state.method, state.learner, keys)
    archive = state.archive
    if config.mixture.snapshots > 1:
        archive = mixture.append(archive, agent.archived(learner.agent), _due(config, learner))
    return state._replace(key=key, learner=learner, archive=archive), reduce_metrics(metrics)


def _due(config: Config, learner: Learner) -> jax.Array:
    """Whether to archive a snapshot after this segment; `end` archives after the last one."""
    segments = learner.env_steps // (config.vector_steps * config.budget.num_envs)
    within = segments % config.budget.num_segments
    return (within > 0) & (within % (config.budget.num_segments // config.mixture.snapshots) == 0)


@in_32_bits
def end(config: Config, state: State) -> tuple[State, Metrics]:
    """Archives the agent, then measures the mixture and the coverage so far."""
    p = components.make(config)
    learner = state.learner
    archive = mixture.append(state.archive, agent.archived(learner.agent))
    weights = state.method.weights[archive.size - 1]
    key_starts, key_rollout, key_rows = jax.random.split(jax.random.key(EVALUATION_SEED), 3)

    def roll_out(weights, key_starts, key_rollout):
        pool = base.only_starts(learner.episodes)
        starts = base.draw_starts(pool, config.mixture.mixture_episodes, key_starts)
        deterministic = config.evaluation.deterministic
        return occupancy.of_mixture(p, archive, weights, starts, key_rollout, True, deterministic)

    if config.mixture.weights == CORRECTIVE:
        # Weights fitted to the episodes that are measured would look better than they are.
        fitted_to = roll_out(weights, *jax.random.split(jax.random.key(EVALUATION_SEED + 1)))
        _, weights = occupancy.corrected(p, fitted_to, weights)
    visited = roll_out(weights, key_starts, key_rollout)
    state = state._replace(iteration=state.iteration + 1, archive=archive)
    first_steps = 0 if learner.first_steps is None else learner.first_steps
    metrics = {
        "iteration": state.iteration,
        "env_steps": learner.env_steps + first_steps,
        "gradient_steps": learner.gradient_steps,
        "mixture_weights": weights,
        "effective_policies": jnp.exp(histogram.shannon_entropy(weights)),
        **coverage("cumulative", learner.visits),
        **({} if learner.plane is None else {"cells_1m": plane.num_cells(learner.plane)}),
        **(coverage("random", learner.random_visits) if config.evaluation.random_baseline else {}),
        **occupancy.measures(p, visited, key_rows),
    }
    return state, metrics


@in_32_bits
def iterate(config: Config, state: State) -> tuple[State, Metrics]:
    """Runs one iteration of Algorithm 1."""
    state, at_begin = begin(config, state)
    state, in_segments = jax.lax.scan(
        lambda s, _: train_segment(config, s), state, length=config.budget.num_segments
    )
    state, at_end = end(config, state)
    return state, at_begin | reduce_metrics(in_segments) | at_end


@in_32_bits
def run(config: Config, state: State, num_iterations: int) -> tuple[State, Metrics]:
    """Runs T iterations as one program; metrics are [T, ...]. Jit it with the state donated."""
    return jax.lax.scan(lambda s, _: iterate(config, s), state, length=num_iterations)


class Programs(NamedTuple):
    """The three functions of an iteration, State -> (State, Metrics)."""

    begin: Callable[[State], tuple[State, Metrics]]
    train_segment: Callable[[State], tuple[State, Metrics]]
    end: Callable[[State], tuple[State, Metrics]]


def programs(config: Config) -> Programs:
    """Returns the jitted functions for a driver that logs and saves in between; state donated."""
    return _programs(config.program(), config.num_seeds > 1)


@functools.lru_cache(maxsize=8)
def _programs(config: Config, seed_axis: bool) -> Programs:
    return Programs(*(jax.jit(f, donate_argnums=0) for f in functions(config, seed_axis)))


@functools.lru_cache(maxsize=8)
def compiled(config: Config, jitted: Programs) -> Programs:
    """Compiles the three functions for the config's state, in parallel."""
    state = jax.eval_shape(functools.partial(start, config))

    def compile_one(function: Any) -> Callable:
        return function.lower(state).compile()

    with ThreadPoolExecutor(len(jitted)) as pool:
        return Programs(*pool.map(compile_one, jitted))


def functions(config: Config, seed_axis: bool) -> Programs:
    """Returns the three functions of an iteration, not jitted; mapped over seeds if asked."""
    of_config = (functools.partial(f, config) for f in (begin, train_segment, end))
    if not seed_axis:
        return Programs(*of_config)
    return Programs(*(jax.vmap(f, (SEED_AXES,), (SEED_AXES, 0)) for f in of_config))


def reduce_metrics(metrics: Metrics) -> Metrics:
    """Reduces the leading axis: sums the counts, whose names begin with num_; averages the rest."""
    return {
        name: jnp.sum(value, 0) if name.startswith("num_") else jnp.mean(value, 0)
        for name, value in metrics.items()
    }


def _start(
    p: Components,
    method: methods.Method,
    archive: Archive,
    last: Agent,
    best: jax.Array,
    key: jax.Array,
) -> Agent:
    """The agent that the iteration starts from: one of STARTS."""
    scratch = agent.init(p.sac, key)
    restored = agent.restart(p.sac, mixture.policy(archive, best))
    candidates = dict(scratch=scratch, last=last, best=restored)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(candidates[name] for name in STARTS))
    chosen = jax.tree.map(lambda x: x[method.start], stacked)
    if not p.config.learner.restart_temperature:
        return chosen
    initial = scratch.parameters.log_temperature
    return chosen._replace(parameters=chosen.parameters._replace(log_temperature=initial))


def coverage(of: str, visits: Visits) -> Metrics:
    """Returns coverage (cells), entropy (nats) and off-grid share; `of` begins each name."""
    on_grid = jnp.sum(visits.cells)
    return {
        f"{of}_coverage": histogram.coverage(visits.cells),
        f"{of}_entropy": histogram.shannon_entropy(visits.cells),
        f"{of}_off_grid_share": visits.off_grid / jnp.maximum(on_grid + visits.off_grid, 1),
    }
