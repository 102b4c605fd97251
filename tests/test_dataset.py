"""Transitions for offline learning: whole episodes in order, of policies drawn by weight."""

import dataclasses
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from untrained import make_run

from maxent_jax import envs
from maxent_jax.analysis import dataset
from maxent_jax.errors import ConfigError

LENGTH = 100  # the time limit of the preset


@pytest.fixture(scope="module")
def run():
    return make_run()


@pytest.fixture(scope="module")
def rows(run):
    return run.dataset(10_000)


@pytest.fixture(scope="module")
def ended(rows):
    return rows["terminals"] | rows["timeouts"]


def test_columns_are_as_documented(run, rows):
    shapes = {name: (x.shape[1:], x.dtype.name) for name, x in rows.items()}
    assert shapes == {
        "observations": ((29,), "float32"),
        "actions": ((8,), "float32"),
        "next_observations": ((29,), "float32"),
        "terminals": ((), "bool"),
        "timeouts": ((), "bool"),
        "policy": ((), "int32"),
        "features": ((7,), "float32"),
    }
    assert {len(x) for x in rows.values()} == {10_000}
    assert np.abs(rows["actions"]).max() <= 1
    expected = run.features(rows["next_observations"])
    np.testing.assert_allclose(rows["features"], expected, rtol=1e-5, atol=1e-5)


def test_episodes_are_contiguous_and_end_once(rows, ended):
    follows = (rows["observations"][1:] == rows["next_observations"][:-1]).all(1)
    np.testing.assert_array_equal(follows, ~ended[:-1])
    changes = np.diff(rows["policy"]) != 0
    assert not (changes & ~ended[:-1]).any()
    assert not (rows["terminals"] & rows["timeouts"]).any() and ended[-1]


def test_terminals_are_unhealthy_and_timeouts_are_late(run, rows, ended):
    healthy = run.components.env.task.healthy(rows["next_observations"])
    np.testing.assert_array_equal(rows["terminals"], ~np.asarray(healthy))
    lengths = np.diff(np.flatnonzero(ended), prepend=-1)
    late = rows["timeouts"][ended]
    assert 0 < late.sum() < len(late)
    assert (lengths[:-1][late[:-1]] == LENGTH).all() and lengths.max() == LENGTH


def test_an_action_leads_on_as_in_gymnasium(rows):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # v5 exists; the paper's is v4
        env = gymnasium.make("Ant-v4", exclude_current_positions_from_observation=False).unwrapped
    for i in range(0, 10_000, 200):
        before = rows["observations"][i].astype(np.float64)
        env.reset(seed=0)
        env.set_state(before[:15], before[15:])
        after, *_ = env.step(rows["actions"][i].astype(np.float64))
        # The constraint solver starts elsewhere, and arrives at the same: measured at worst 1e-6
        # over all rows. The next row's action is 0.2 off at best.
        np.testing.assert_allclose(rows["next_observations"][i], after, atol=1e-5)


@pytest.mark.slow
def test_policies_play_by_weight(run):
    weighted = dataclasses.replace(run, config=run.config.replace(method="h", eta=0.3))
    rows = weighted.dataset(20_000)
    played = np.bincount(rows["policy"][rows["terminals"] | rows["timeouts"]], minlength=3)
    expected = weighted.weights * played.sum()
    assert np.ptp(expected) > 80
    # Off by less than an episode in each 32, and in the last 32, cut in random order, by 4
    # standard deviations of sqrt(32) / 2 at most.
    bound = played.sum() / dataset.EPISODES_AT_ONCE + 12
    assert (np.abs(played - expected) < bound).all() and bound < 40


@pytest.mark.slow
def test_a_larger_dataset_goes_on_where_a_smaller_one_was_cut(run, rows):
    fewer = run.dataset(2_500)
    for name, values in fewer.items():
        np.testing.assert_array_equal(values[:-1], rows[name][:2_499])
    assert fewer["timeouts"][-1] != fewer["terminals"][-1]
    assert not np.array_equal(run.dataset(2_500, seed=1)["actions"], fewer["actions"])


def test_it_is_saved_as_an_archive_of_arrays(rows, tmp_path):
    np.savez_compressed(tmp_path / "rows", **rows)
    with np.load(tmp_path / "rows.npz") as loaded:
        assert {*loaded} == {*rows}
        np.testing.assert_array_equal(loaded["actions"], rows["actions"])


def test_a_dataset_has_a_row(run):
    with pytest.raises(ValueError, match="at least 1 transition, not 0"):
        run.dataset(0)


class Breaking(Env):
    """Leaves the finite numbers at the fourth step, or the first."""

    backend = "none"
    observation_size = 2
    action_size = 1

    def __init__(self, last):
        self._last = last

    def reset(self, rng):
        place = jnp.stack([jax.random.uniform(rng), jnp.zeros(())])
        return State(place, place, jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        place, age = state.pipeline_state + jnp.array([0.0, 1.0])
        after = jnp.stack([jnp.where(age > self._last, jnp.nan, place), age])
        return state.replace(pipeline_state=after, obs=after)


@pytest.mark.slow
@pytest.mark.parametrize("last", [3, 0])
def test_what_is_not_finite_is_no_transition(last):
    envs.register(f"breaking-{last}", lambda backend, physics: Breaking(last))
    run = make_run(env=f"user:breaking-{last}", num_iterations=1)
    if last == 0:
        with pytest.raises(ValueError, match="finite first step"):
            run.dataset(7)
        return
    rows = run.dataset(7)
    assert all(np.isfinite(values).all() for values in rows.values())
    np.testing.assert_array_equal(rows["next_observations"][:, 1], [1, 2, 3, 1, 2, 3, 1])
    np.testing.assert_array_equal(rows["timeouts"], [0, 0, 1, 0, 0, 1, 1])
    assert not rows["terminals"].any()


def test_a_dataset_is_paid_for_a_task(run):
    data = run.dataset(300, task="run:90")
    moved = data["next_observations"][:, 1] - data["observations"][:, 1]
    np.testing.assert_allclose(data["rewards"], moved / run.components.env.dt, atol=1e-4)
    plain = run.dataset(300)
    assert "rewards" not in plain
    np.testing.assert_array_equal(plain["actions"], data["actions"])
    with pytest.raises(ConfigError, match="task is flip, but ant has only"):
        run.dataset(300, task="flip")
