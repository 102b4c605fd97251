"""Restarts at visited cells, in training: what is stored, drawn, replayed and evaluated."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import user_module  # noqa: F401  registers user:point

from maxent_jax import algorithm, components, envs
from maxent_jax.config import preset
from maxent_jax.density import histogram
from maxent_jax.envs import base, cells

SHORT = dict(env="user:point", episode_length=12, reference_size=64, num_segments=1)


def short(**changes):
    """Episodes of a point in the plane that end every 12 steps: many begin in an iteration."""
    return preset("smoke", **{**SHORT, "cell_restarts": 0.9, **changes})


@functools.lru_cache
def trained(**changes):
    """The state after the segment of the first iteration: 100 vector steps."""
    config = short(**changes)
    state = algorithm.start(config)
    programs = algorithm.programs(config)
    begun, _ = programs.begin(state)
    state, _ = programs.train_segment(begun)
    return config, state


def numpy(tree):
    return jax.tree.map(np.asarray, tree)


def test_cells_are_drawn_in_proportion_to_one_over_their_visits(key):
    known = cells.Cells(jnp.ones(1), jnp.zeros(5, jnp.int32), jnp.array([0, 1, 2, 0, 4], jnp.int32))
    cell, has_state = cells.draw(known, 7000, key)
    assert has_state.all()
    # 1 : 1/2 : 1/4 are 4000, 2000 and 1000 of 7000.
    count = np.bincount(cell, minlength=5)
    assert count[0] == count[3] == 0
    expected = np.array([4000, 2000, 1000])
    # A chi-square of 2 degrees of freedom, above 18 once in ten thousand seeds.
    assert np.sum((count[[1, 2, 4]] - expected) ** 2 / expected) < 18


def test_visits_count_the_states_that_the_agents_steps_left():
    config, state = trained()
    visits = state.learner.episodes.restarts.visits
    assert visits.sum() == config.budget.steps_per_iteration  # no state is off the grid
    ring = numpy(state.learner.replay.items)
    size = int(state.learner.replay.size)
    left = left_states(state)[:size]
    counts = histogram.count(left, components.make(config).grid)
    np.testing.assert_array_equal(counts.reshape(-1), visits)
    assert size == 400 and (ring.previous[:size] < 0).sum() > 20


def left_states(state):
    """The states that the replay's items left, as `experience.Step` says."""
    items, starts = numpy((state.learner.replay.items, state.learner.episodes.starts.obs))
    of_start = starts[np.maximum(-1 - items.previous, 0)]
    return np.where((items.previous < 0)[:, None], of_start, items.state[items.previous])


def test_the_replay_finds_the_stored_state_that_a_restarted_episode_left():
    config, state = trained()
    items, size = numpy(state.learner.replay.items), int(state.learner.replay.size)
    left = left_states(state)
    np.testing.assert_allclose(
        items.state[:size], left[:size] + 0.2 * items.action[:size], atol=1e-6
    )
    again = -1 - items.previous[:size] >= config.environment.num_starts
    cell = histogram.cells(left[:size][again], components.make(config).grid)
    stored = -1 - items.previous[:size][again] - config.environment.num_starts
    assert again.sum() > 15
    np.testing.assert_array_equal(cell, stored)


def test_each_cell_holds_the_first_state_that_was_left_there():
    config, state = trained()
    grid, episodes = components.make(config).grid, state.learner.episodes
    left = left_states(state)[: int(state.learner.replay.size)]
    cell = np.asarray(histogram.cells(left, grid))
    found, first = np.unique(cell, return_index=True)
    np.testing.assert_array_equal(found, np.flatnonzero(episodes.restarts.visits))
    stored = np.asarray(episodes.starts.obs)[config.environment.num_starts :]
    np.testing.assert_allclose(stored[found], left[first], atol=1e-6)
    age = np.asarray(episodes.restarts.age)[found]
    assert age.min() == 0 and age.max() < config.environment.episode_length


def test_the_random_baseline_keeps_to_the_starts():
    config, state = trained()
    start = np.asarray(state.learner.episodes.start)
    n, num_starts = config.budget.num_envs, config.environment.num_starts
    assert (start[n:] < num_starts).all() and start.shape == (2 * n,)
    random_only = algorithm.start(config).learner.episodes.restarts.share
    np.testing.assert_allclose(random_only, [0.9] * n + [0.0] * n)


def test_the_mixture_begins_at_starts_alone():
    config, state = trained()
    episodes, first = state.learner.episodes, config.environment.num_starts
    moved = episodes.starts.replace(obs=episodes.starts.obs.at[first:].set(1.0))
    elsewhere = state._replace(
        learner=state.learner._replace(episodes=episodes._replace(starts=moved))
    )
    for part in ("begin", "end"):
        program = getattr(algorithm.programs(config), part)
        (_, one), (_, other) = (program(jax.tree.map(jnp.copy, s)) for s in (state, elsewhere))
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_the_episodic_term_of_a_restarted_episode_sees_that_episode_alone():
    config, state = trained(episodic_weight=1.0)
    items, size = numpy(state.learner.replay.items), int(state.learner.replay.size)
    again = -1 - items.previous[:size] >= config.environment.num_starts
    # The only earlier state is the one that the step left: k times the distance to it.
    moved = 0.2 * np.linalg.norm(items.action[:size], axis=-1)
    expected = config.intrinsic.num_neighbors * moved
    assert again.sum() > 15
    np.testing.assert_allclose(items.bonus[:size][again], expected[again], rtol=1e-4)


@pytest.mark.parametrize("changes", [dict(policy_lag=1), dict(method="ngu"), dict(method="la")])
def test_every_way_of_learning_goes_with_restarts(changes):
    config, state = trained(**changes)
    start = np.asarray(state.learner.episodes.start[: config.budget.num_envs])
    assert np.isfinite(state.learner.agent.parameters.log_temperature)
    assert (state.learner.episodes.restarts.visits > 0).sum() > 10
    assert (start >= config.environment.num_starts).any()


def random_coverage(share, key):
    """Cells of Mountain Car that random actions reach in 1,000 steps of 8 episodes at once."""
    env, grid, num = envs.make("mountain_car"), envs.entry("mountain_car").grid, 8
    episodes = base.init(env, num, 64, key)
    episodes = base.with_cells(episodes, grid.num_cells, jnp.full(num, share))

    def step(episodes, key):
        key_act, key_step = jax.random.split(key)
        episodes = base.fill_cells(episodes, histogram.cells(episodes.env.obs, grid))
        action = jax.random.uniform(key_act, (num, 1), minval=-1.0, maxval=1.0)
        return base.step(env, episodes, action, 200, key_step)[0], None

    episodes, _ = jax.lax.scan(step, episodes, jax.random.split(key, 1000))
    return histogram.coverage(episodes.restarts.visits)


def test_random_actions_reach_more_cells_when_episodes_begin_at_cells():
    keys = jax.random.split(jax.random.key(0), 8)
    reached = jax.jit(jax.vmap(random_coverage, (None, 0)))
    without, with_restarts = reached(1e-9, keys), reached(0.9, keys)
    # 24 and 35 cells on average; the standard error of the difference is 3.
    assert with_restarts.mean() > without.mean() + 4
