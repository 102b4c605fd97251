"""A run's policies in Gymnasium: the task that they know, and the gap to our simulator."""

import itertools
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from untrained import make_run

from maxent_jax import mixture
from maxent_jax.analysis import gymnasium_play
from maxent_jax.config import preset
from maxent_jax.errors import ConfigError

ROBOTS = {
    "ant": dict(torque_limit=0.4, end_flipped=True, policy_inputs="heading"),
    "walker2d": dict(torque_limit=0.7),
    "humanoid": {},
}
NUM_STATES, LENGTH = 60, 20


def make_pushing(env="ant", **changes):
    """Of policies that push with all they have, up and down, and of one that hardly moves."""
    run = make_run(env=env, backend="mujoco", **ROBOTS[env], **changes)
    output = run.mixture.parameters.actor["params"]["Dense_0"]
    bias = jnp.repeat(jnp.array([[20.0], [-20.0], [0.0]]), run.components.env.action_size, axis=1)
    output["bias"] = jnp.concatenate([bias, jnp.full_like(bias, -9.0)], axis=1)
    return run


def gymnasiums_own(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # v5 exists; the paper's is v4
        return gymnasium.make(name, exclude_current_positions_from_observation=False)


def visited_states(env, num_steps, key):
    """[NUM_STATES, ...] that random actions lead to."""
    key_starts, key_actions = jax.random.split(key)
    states = jax.vmap(env.reset)(jax.random.split(key_starts, NUM_STATES))
    shape = (num_steps, NUM_STATES, env.action_size)
    actions = jax.random.uniform(key_actions, shape, minval=-1, maxval=1)
    states, _ = jax.lax.scan(lambda s, a: (jax.vmap(env.step)(s, a), None), states, actions)
    return states


@pytest.mark.parametrize("name", ROBOTS)
def test_a_step_is_ours_from_equal_states(name):
    run = make_pushing(name)
    ours, theirs = run.components.env, gymnasium_play.make(run.config)
    states = jax.jit(lambda key: visited_states(ours, LENGTH, key))(jax.random.key(1))
    if name == "ant":  # on its back, for a third of them
        physics = states.pipeline_state
        turned = physics.qpos.at[::3, 3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0]))
        states = states.replace(pipeline_state=physics._replace(qpos=turned))
    # Beyond the range too: it is clipped.
    actions = jax.random.uniform(
        jax.random.key(2), (NUM_STATES, ours.action_size), minval=-2, maxval=2
    )
    after = jax.jit(jax.vmap(ours.step))(states, actions)
    theirs.reset(seed=0)
    found, ended = [], []
    for qpos, qvel, warmstart, action in zip(*states.pipeline_state, actions, strict=True):
        theirs.unwrapped.set_state(np.float64(qpos), np.float64(qvel))
        theirs.unwrapped.data.qacc_warmstart[:] = warmstart
        observation, _, terminated, _, _ = theirs.step(np.asarray(action))
        found.append(observation)
        ended.append(terminated)
    # As in test_gymnasium.py: the same C code, the control and the result rounded to float32.
    np.testing.assert_allclose(after.obs, found, rtol=1e-6, atol=3e-5)
    np.testing.assert_array_equal(after.done > 0, ended)
    assert 0 < sum(ended) < NUM_STATES
    if name == "ant":
        healthy = np.asarray(ours.task.healthy(after.obs))
        assert (healthy & np.array(ended)).any()  # flipped, and nothing else


def test_the_task_is_one_of_gymnasiums():
    env = gymnasium_play.make(make_pushing().config)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (8,))
    observation, _ = env.reset(seed=4)
    assert observation in env.observation_space and observation.dtype == np.float32
    expected, _ = gymnasiums_own("Ant-v4").reset(seed=4)
    np.testing.assert_array_equal(observation, np.float32(expected))


@pytest.fixture(scope="module")
def run():
    return make_pushing(episode_length=LENGTH, reference_size=64)


@pytest.mark.slow
def test_each_policy_plays_its_episodes(run):
    played = gymnasium_play.play(run, [0, 1, 1], seed=5)
    assert played.states.shape == (3, LENGTH, 29) and played.states.dtype == np.float32
    assert played.policy.tolist() == [0, 1, 1]
    raw = gymnasiums_own("Ant-v4")
    raw.reset(seed=5)
    for states, alive, push in zip(played.states, played.alive, (0.4, -0.4, -0.4), strict=True):
        raw.reset()
        expected = np.array([raw.step(np.full(8, push))[0] for _ in range(alive.sum())])
        # tanh(20 ± 0.03) is 1 to the last place.
        np.testing.assert_array_equal(states[alive], expected.astype(np.float32))


def test_the_mixture_plays_by_weight(run):
    policies = mixture.assign_episodes(run.weights, 6, 0.5)
    assert gymnasium_play.play(run, policies).policy.tolist() == [0, 0, 1, 1, 2, 2]


@pytest.mark.slow
def test_an_episode_ends_with_health_or_the_time_limit(run):
    played = gymnasium_play.rollout(run, episodes_per_policy=4, seed=6)
    assert played.policy.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    lived = played.alive.sum(1)
    np.testing.assert_array_equal(played.alive, np.arange(LENGTH) < lived[:, None])
    assert not played.states[~played.alive].any()
    last = played.states[np.arange(12), lived - 1]
    env = run.components.env
    ends = ~env.task.healthy(last) | env.task.torso.flipped(last)
    np.testing.assert_array_equal(ends | (lived == LENGTH), True)
    for states, number in zip(played.states, lived, strict=True):
        earlier = states[: number - 1]
        assert env.task.healthy(earlier).all() and not env.task.torso.flipped(earlier).any()
    again = gymnasium_play.rollout(run, episodes_per_policy=4, seed=6)
    np.testing.assert_array_equal(played.states, again.states)
    other = gymnasium_play.rollout(run, episodes_per_policy=4, seed=7)
    assert not np.array_equal(played.states, other.states)


def test_chance_is_what_two_of_our_own_sets_differ_by():
    ours = [3.0, 1.0, 4.0, 1.5, 9.0]
    found = gymnasium_play._gap(ours, 7.0)
    squares = [(a - b) ** 2 for a, b in itertools.combinations(ours, 2)]
    assert found == pytest.approx((3.7, 7.0, 3.3, np.sqrt(np.mean(squares))))


@pytest.mark.slow
def test_the_same_simulator_leaves_no_gap_and_another_does(run, monkeypatch):
    same = gymnasium_play.gap(run, episodes_per_policy=4)
    for name, gap in same.items():
        assert np.isfinite(gap).all(), name
    upright = gymnasium_play.make

    def tilted(config):
        env = upright(config)
        env.unwrapped.model.opt.gravity[0] = 20.0  # m/s², twice its weight
        return env

    monkeypatch.setattr(gymnasium_play, "make", tilted)
    other = gymnasium_play.gap(run, episodes_per_policy=4)
    name = "policy_2_end_distance"  # that of the policy which stands where it is
    # Of normal measures chance alone makes a difference 4 times itself once in a hundred times.
    assert abs(same[name].difference) < 4 * same[name].chance
    assert abs(other[name].difference) > 4 * other[name].chance
    assert other[name].ours == same[name].ours


def test_an_environment_that_gymnasium_lacks_is_one_sentence(monkeypatch):
    with pytest.raises(ConfigError, match="only ant, walker2d, humanoid are"):
        gymnasium_play.make(preset("smoke", env="mountain_car"))
    monkeypatch.setitem(gymnasium_play.IDS, "ant", "Ant-v99")
    with pytest.raises(ConfigError, match="cannot make Ant-v99"):
        gymnasium_play.make(preset("smoke"))
