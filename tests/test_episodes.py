"""Many episodes at once: limits, true last states, fresh starts, and non-finite numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State, Wrapper

from maxent_jax import envs
from maxent_jax.envs import base
from maxent_jax.envs.skills import WithSkill
from maxent_jax.envs.task import MujocoEnv

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
    episodes = base.with_restarts(episodes, within, base.Restarts(jnp.full(many, share), ages))
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
    restarts = base.Restarts(jnp.zeros(N), jnp.zeros(4, jnp.int32))
    for _ in range(2):
        episodes = base.with_restarts(episodes, states, restarts)
        assert episodes.starts.done.shape == (68,)
    assert len(np.unique(base.only_starts(episodes).obs)) == 64


NUM_CELLS = 6  # of the line, from 0 to 6


def in_cells(share, key, starts=64):
    """Episodes on the line that restart at its cells of length 1."""
    episodes = base.init(LINE, N, starts, key)
    return base.with_cells(episodes, NUM_CELLS, jnp.broadcast_to(share, (N,)))


def fill(episodes):
    x = episodes.env.obs[:, 0]
    inside = (x >= 0) & (x < NUM_CELLS)
    cell = jnp.where(inside, jnp.floor(x), NUM_CELLS).astype(jnp.int32)
    return jax.jit(base.fill_cells)(episodes, cell)


def at(episodes, *x):
    """The episodes, moved to these places."""
    return episodes._replace(env=episodes.env.replace(obs=jnp.array(x, jnp.float32)[:, None]))


def stored(episodes):
    return np.asarray(episodes.starts.obs[-NUM_CELLS:, 0])


def test_a_cell_keeps_the_first_state_from_which_an_episode_goes_on(key):
    episodes = in_cells(0.5, key)
    assert not episodes.restarts.visits.any()
    episodes = fill(at(episodes._replace(age=jnp.array([3, 1, 2])), 1.5, 1.25, 2.5))
    episodes = fill(at(episodes._replace(age=jnp.array([9, 8, 7])), 1.75, 4.5, 2.25))
    episodes = fill(at(episodes, -3.0, jnp.nan, 6.5))  # off the grid
    np.testing.assert_array_equal(episodes.restarts.visits, [0, 3, 2, 0, 1, 0])
    np.testing.assert_array_equal(stored(episodes)[[1, 2, 4]], [1.5, 2.5, 4.5])
    np.testing.assert_array_equal(episodes.restarts.age, [0, 3, 2, 0, 8, 0])
    assert base.only_starts(episodes).done.shape == (64,)
    assert np.isin(stored(episodes)[[0, 3, 5]], episodes.starts.obs[:64, 0]).all()


def test_every_entry_of_a_stored_state_is_of_one_episode(key):
    episodes = in_cells(1.0, key)
    moved = at(episodes, 3.1, 3.2, 3.3)
    moved = moved._replace(env=moved.env.replace(pipeline_state=jnp.array([31.0, 32.0, 33.0])))
    after = fill(moved._replace(age=jnp.array([1, 2, 3])))
    row = jax.tree.map(lambda x: x[64 + 3], after.starts)
    first = jax.tree.map(lambda x: x[0], moved.env)
    assert all(jax.tree.leaves(jax.tree.map(jnp.array_equal, row, first)))
    assert (row.obs[0], row.pipeline_state) == (jnp.float32(3.1), 31.0)
    assert after.restarts.age[3] == 1 and after.restarts.visits[3] == 3


def test_neither_a_terminal_nor_an_invalid_nor_a_last_state_is_stored(key):
    episodes = at(in_cells(1e-9, key), 2.0, 2.0, 2.0)
    for move, limit in (((3.5, 3.5, 3.5), LIMIT), ((-8, -8, -8), LIMIT), ((1, 1, 1), 1)):
        after, transition = step(episodes, act(*move), key, limit)
        assert (transition.terminated | transition.truncated).all()
        np.testing.assert_array_equal(np.flatnonzero(fill(after).restarts.visits), [0])
    after, _ = step(episodes, act(1, 1, 1), key)
    np.testing.assert_array_equal(np.flatnonzero(fill(after).restarts.visits), [3])


def test_an_episode_without_a_share_neither_restarts_nor_fills(key):
    episodes = in_cells(jnp.array([1.0, 1.0, 0.0]), key)
    episodes = fill(at(episodes, 1.5, 2.5, 3.5))
    np.testing.assert_array_equal(episodes.restarts.visits, [0, 1, 1, 0, 0, 0])
    for key_step in jax.random.split(key, 20):
        begun = base.begin_again(episodes, key_step)
        assert (np.asarray(begun.start) >= 64).tolist() == [True, True, False]


def test_without_a_visited_cell_all_episodes_begin_at_starts(key):
    episodes = in_cells(1.0, key)
    begun = base.begin_again(episodes, key)
    assert (begun.start < 64).all() and (begun.age == 0).all() and is_start(begun, slice(None))


def test_a_share_of_the_episodes_begins_at_stored_states_of_their_age(key):
    many = 400
    episodes = base.with_cells(base.init(LINE, many, 64, key), NUM_CELLS, jnp.full(many, 0.5))
    x = jnp.linspace(1.0, 4.9, many)
    moved = episodes._replace(
        env=episodes.env.replace(obs=x[:, None], pipeline_state=jnp.arange(400.0)),
        age=jnp.arange(many, dtype=jnp.int32),
    )
    cell = jnp.floor(x).astype(jnp.int32)
    episodes = base.fill_cells(moved, cell)
    after, _ = step(episodes, act(*[10.0] * many), key, 1000)  # all die
    again = np.asarray(after.start) >= 64
    assert abs(again.mean() - 0.5) < 0.125  # a standard deviation of 0.025
    kept = np.asarray(x)[np.unique(cell, return_index=True)[1]]
    assert set(np.asarray(after.env.obs[again, 0])) == set(kept)
    np.testing.assert_array_equal(after.age[again], after.env.pipeline_state[again])
    assert (after.age[~again] == 0).all() and (base.steps_taken(after) == 0).all()
    once, _ = step(after, act(*[0.0] * many), key, 1000)
    assert (base.steps_taken(once) == 1).all()
    np.testing.assert_array_equal(once.age, after.age + 1)


def test_an_episode_from_a_cell_ends_at_the_time_limit(key):
    episodes = fill(at(in_cells(1.0, key), 1.5, 1.5, 1.5)._replace(age=jnp.full(N, LIMIT - 2)))
    episodes = base.begin_again(episodes, key)
    assert (episodes.age == LIMIT - 2).all()
    episodes, transition = step(episodes, act(0, 0, 0), key)
    assert not transition.truncated.any()
    _, transition = step(episodes, act(0, 0, 0), key)
    assert transition.truncated.all()


def test_every_simulator_state_can_be_stored_and_begun_at(key):
    env = envs.make("ant", backend="mujoco")
    episodes = base.with_cells(base.init(env, 2, 8, key), 3, jnp.ones(2))
    go = jax.jit(base.step, static_argnums=(0, 3))
    episodes, _ = go(env, episodes, jnp.full((2, 8), 0.3), 100, key)
    filled = base.fill_cells(episodes, jnp.array([2, 0]))
    begun = base.begin_again(filled, key)
    for i, row in enumerate(begun.start):
        source = {8: 1, 10: 0}[int(row)]  # the cell of episode 1, and of episode 0
        mine = jax.tree.map(lambda x, i=i: x[i], begun.env)
        theirs = jax.tree.map(lambda x, i=source: x[i], episodes.env)
        assert all(jax.tree.leaves(jax.tree.map(jnp.array_equal, mine, theirs)))
    assert (begun.age == 1).all()


class Faster(Wrapper):
    """Moves twice as far. It knows nothing of `step_beside`."""

    def step(self, state, action):
        return self.env.step(state, 2 * action)


class Doubled(MujocoEnv):
    """The same by inheritance."""

    def step(self, state, action):
        return super().step(state, 2 * action)


@pytest.mark.parametrize(
    ("make", "has_own_step"),
    [
        (lambda ant: ant, False),
        (lambda ant: WithSkill(ant, 2), False),
        (lambda ant: Faster(ant), True),
        (lambda ant: WithSkill(Faster(ant), 2), True),
        (lambda ant: Faster(WithSkill(ant, 2)), True),
        (lambda ant: Doubled(ant.task, "mujoco"), True),
        (lambda ant: LINE, False),
    ],
    ids=["ant", "skill", "wrapper", "skill of wrapper", "wrapper of skill", "subclass", "line"],
)
def test_what_steps_beside_takes_the_steps_of_every_layer(make, has_own_step, key):
    env = make(envs.make("ant", backend="mujoco"))
    if has_own_step:  # and yet finds a step_beside, which leaves it out
        assert env.step_beside
    episodes = base.init(env, 2, 4, key)
    action = 0.4 * jnp.ones((2, env.action_size))
    work = lambda key: (jnp.ones(()), jnp.zeros(()))
    expected, _ = jax.jit(lambda: base.step(env, episodes, action, 9, key))()
    found, _, result = jax.jit(lambda: base.step_beside(env, episodes, action, 9, key, work, key))()
    np.testing.assert_allclose(found.env.obs, expected.env.obs, rtol=1e-5, atol=1e-6)
    assert result == 1
