"""Many episodes at once: limits, true last states, fresh starts, and non-finite numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from maxent_jax import envs
from maxent_jax.envs import base

EDGE, POISON = 5.0, -5.0
N, LIMIT = 3, 4


class Line(Env):
    """A point on a line that the action moves: health ends at EDGE, numbers at POISON.

    Starts are far apart within [0, 1), and a hidden coordinate counts the steps taken.
    """

    def reset(self, rng):
        return self._state(jax.random.uniform(rng), jnp.zeros(()))

    def step(self, state, action):
        x = state.obs[0] + action[0]
        return self._state(jnp.where(x <= POISON, jnp.nan, x), state.pipeline_state + 1)

    def _state(self, x, steps):
        return State(steps, x[None], jnp.zeros(()), (x >= EDGE).astype(jnp.float32))

    observation_size = 1
    action_size = 1
    backend = "none"


LINE = Line()


@pytest.fixture
def episodes(key):
    return base.init(LINE, N, 64, key)


def act(*moves):
    return jnp.array(moves, jnp.float32)[:, None]


def step(episodes, action, key, limit=LIMIT):
    return jax.jit(base.step, static_argnums=(0, 3))(LINE, episodes, action, limit, key)


def is_start(episodes, rows):
    pool = episodes.starts
    fresh = np.isin(episodes.env.obs[:, 0], pool.obs[:, 0]) & (episodes.env.pipeline_state == 0)
    return np.asarray(fresh)[rows].all()


def test_starts_of_the_pool_differ_and_episodes_begin_at_them(key):
    starts = base.init(LINE, N, 64, key).starts
    assert len(np.unique(starts.obs)) == 64
    ant = base.init(envs.make("ant", backend="mujoco"), 2, 16, key)
    assert len(np.unique(ant.starts.obs, axis=0)) == 16
    assert np.isin(ant.env.obs, ant.starts.obs).all()


def test_starts_are_drawn_from_the_whole_pool_evenly(episodes, key):
    drawn = base.draw_starts(episodes.starts, 6400, key)
    _, count = np.unique(drawn.obs[:, 0], return_counts=True)
    assert len(count) == 64
    # Means of 100: a chi-square of 63 degrees of freedom, above 114 once in ten thousand seeds.
    assert np.sum((count - 100.0) ** 2 / 100) < 114


def test_a_time_limit_is_not_a_termination(episodes, key):
    for age in range(1, LIMIT + 1):
        assert (episodes.age == age - 1).all()
        episodes, transition = step(episodes, act(0.1, 0.1, 0.1), key)
        assert not transition.terminated.any()
        assert (transition.truncated == (age == LIMIT)).all()
        assert transition.valid.all()
    assert (episodes.age == 0).all()
    assert is_start(episodes, slice(None))


def test_failing_at_the_time_limit_is_a_termination_alone(episodes, key):
    _, transition = step(episodes, act(0, 10, 0), key, limit=1)
    np.testing.assert_array_equal(transition.terminated, [False, True, False])
    np.testing.assert_array_equal(transition.truncated, [True, False, True])


def test_the_true_last_state_is_kept_where_the_next_episode_starts(episodes, key):
    before = episodes.env.obs
    after, transition = step(episodes, act(0.5, 10, 0.5), key)
    np.testing.assert_array_equal(transition.observation, before)
    np.testing.assert_array_equal(transition.action, act(0.5, 10, 0.5))
    np.testing.assert_array_equal(transition.next_observation, before + act(0.5, 10, 0.5))
    np.testing.assert_array_equal(transition.terminated, [False, True, False])
    np.testing.assert_array_equal(after.age, [1, 0, 1])
    assert is_start(after, 1)
    running = jnp.array([0, 2])
    np.testing.assert_array_equal(after.env.obs[running], transition.next_observation[running])
    np.testing.assert_array_equal(after.env.pipeline_state[running], 1)


def test_fresh_starts_differ_between_envs_and_between_episodes(episodes):
    starts = []
    for key in jax.random.split(jax.random.key(1), 20):
        episodes, _ = step(episodes, act(10, 10, 10), key)
        starts.append(episodes.env.obs[:, 0])
    starts = np.asarray(starts)
    for first, second in [(starts[:-1], starts[1:]), (starts[:, :-1], starts[:, 1:])]:
        # By chance 1 draw in 64 repeats: of 57 or 40 pairs 6 or more, once in 3000 seeds.
        assert (first == second).sum() < 6


@pytest.mark.parametrize("at_the_limit", [False, True])
def test_a_non_finite_state_ends_its_episode_and_goes_nowhere(episodes, key, at_the_limit):
    before = episodes.env.obs
    after, transition = step(episodes, act(0, -10, 0), key, limit=1 if at_the_limit else LIMIT)
    np.testing.assert_array_equal(transition.valid, [True, False, True])
    np.testing.assert_array_equal(transition.terminated, [False, True, False])
    np.testing.assert_array_equal(transition.truncated, [at_the_limit, False, at_the_limit])
    np.testing.assert_array_equal(transition.next_observation, before)
    assert after.age[1] == 0 and is_start(after, 1)
    assert np.isfinite(after.env.obs).all()


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_diverging_physics_is_replaced_by_a_fresh_start(key, poison, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it stands
    env = envs.make("ant", backend="mujoco")
    episodes = base.init(env, N, 16, key)
    physics = episodes.env.pipeline_state
    poisoned = physics._replace(qvel=physics.qvel.at[1, 8].set(poison))
    episodes = episodes._replace(env=episodes.env.replace(pipeline_state=poisoned))
    after, transition = jax.jit(base.step, static_argnums=(0, 3))(
        env, episodes, jnp.zeros((N, 8)), 1000, key
    )
    np.testing.assert_array_equal(transition.valid, [True, False, True])
    np.testing.assert_array_equal(transition.terminated, [False, True, False])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((transition, after)))
    fresh = [x[1] for x in after.env.pipeline_state]
    pool = after.starts.pipeline_state
    assert any(
        all(np.array_equal(x, y[row]) for x, y in zip(fresh, pool, strict=True))
        for row in range(16)
    )


def test_rows_are_finite_only_if_every_number_is(episodes):
    state = episodes.env
    for poisoned in (
        state.replace(pipeline_state=state.pipeline_state.at[1].set(jnp.inf)),
        state.replace(obs=state.obs.at[1, 0].set(-jnp.inf)),
        state.replace(reward=state.reward.at[1].set(jnp.nan)),
        state.replace(metrics={"height": jnp.array([0, jnp.nan, 0])}),
    ):
        np.testing.assert_array_equal(base.finite_rows(poisoned), [True, False, True])
    whole = state.replace(info={"count": jnp.array([1, 2, 3])})
    assert base.finite_rows(whole).all()


def test_rows_are_selected_in_trees_of_any_rank():
    mask = jnp.array([True, False, True])
    ones = {"a": jnp.ones(3), "b": jnp.ones((3, 2), jnp.int32), "c": jnp.ones((3, 2, 4))}
    chosen = base.select_rows(mask, ones, jax.tree.map(jnp.zeros_like, ones))
    for name, rows in chosen.items():
        assert rows.dtype == ones[name].dtype
        flat = np.asarray(rows).reshape(3, -1)
        np.testing.assert_array_equal(flat, np.broadcast_to([[1], [0], [1]], flat.shape))


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_the_episodes_begins_within_earlier_ones(share, key):
    many, ages = 400, jnp.arange(1, 9, dtype=jnp.int32)
    episodes = base.init(LINE, many, 64, key)
    within = jax.vmap(LINE.reset)(jax.random.split(key, 8))
    within = within.replace(obs=within.obs + 2.0, pipeline_state=ages.astype(jnp.float32))
    episodes = base.with_restarts(episodes, within, base.Restarts(jnp.asarray(share), ages))
    assert base.only_starts(episodes).done.shape == (64,)
    for begun in (
        base.begin_again(episodes, key),
        step(episodes, act(*[EDGE] * many), key, limit=100)[0],  # all die
    ):
        again = np.asarray(begun.start) >= 64
        # 400 draws: a standard deviation of 0.025 at one half.
        assert abs(again.mean() - share) < 0.125
        assert (np.asarray(begun.env.obs[:, 0] >= 2.0) == again).all()
        np.testing.assert_array_equal(begun.age, begun.env.pipeline_state)
        np.testing.assert_array_equal(begun.env.obs, begun.starts.obs[begun.start])
        if share:
            assert set(np.unique(begun.age[again])) == set(range(1, 9))


def test_other_restarts_take_the_place_of_the_first(episodes, key):
    states = base.draw_starts(episodes.starts, 4, key)
    restarts = base.Restarts(jnp.zeros(()), jnp.zeros(4, jnp.int32))
    for _ in range(2):
        episodes = base.with_restarts(episodes, states, restarts)
        assert episodes.starts.done.shape == (68,)
    assert len(np.unique(base.only_starts(episodes).obs)) == 64
