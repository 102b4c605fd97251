"""Skills: a unit vector for each episode, which networks see and nothing else does."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from untrained import make_run

from maxent_jax import algorithm, components, envs
from maxent_jax.algorithm import experience
from maxent_jax.analysis import gymnasium_play
from maxent_jax.config import preset
from maxent_jax.density import histogram
from maxent_jax.envs import base
from maxent_jax.envs.skills import WithSkill
from maxent_jax.errors import ConfigError

Z = 2
METRA = dict(method="metra", hidden_size=16)


def test_an_episode_keeps_its_skill_and_the_next_has_another(key):
    env = WithSkill(envs.make("pendulum"), Z)
    episodes = base.init(env, 3, 64, key)
    skills = np.asarray(episodes.starts.obs[:, -Z:])
    np.testing.assert_allclose(np.linalg.norm(skills, axis=1), 1, rtol=1e-6)
    assert len(np.unique(skills, axis=0)) == 64
    assert np.abs(skills.mean(0)).max() < 0.4  # in all directions: the deviation is 0.09
    first = episodes.env.obs[:, -Z:]
    step = jax.jit(base.step, static_argnums=(0, 3))
    for age in range(1, 5):
        episodes, transition = step(env, episodes, jnp.zeros((3, 1)), 4, key)
        np.testing.assert_array_equal(transition.observation[:, -Z:], first)
        np.testing.assert_array_equal(transition.next_observation[:, -Z:], first)
        assert transition.truncated.all() == (age == 4)
    assert (episodes.env.obs[:, -Z:] != first).any()


def test_physics_does_not_see_the_skill(key):
    bare = envs.make("ant", backend="mujoco")
    env = WithSkill(bare, Z)
    assert env.observation_size == bare.observation_size + Z
    states = jax.vmap(env.reset)(jax.random.split(key, 4))
    without = states.replace(obs=states.obs[:, :-Z])
    action = jax.random.uniform(key, (4, env.action_size))
    after, expected = jax.vmap(env.step)(states, action), jax.vmap(bare.step)(without, action)
    np.testing.assert_array_equal(after.obs[:, :-Z], expected.obs)
    np.testing.assert_array_equal(after.obs[:, -Z:], states.obs[:, -Z:])

    def work(key):
        return jnp.ones(()), jnp.zeros(())

    beside, result = jax.jit(lambda s, a: env.step_beside(s, a, work, key))(states, action)
    np.testing.assert_allclose(beside.obs, after.obs, rtol=1e-6)
    assert result == 1


def test_the_networks_and_metra_see_the_skill_and_features_do_not(key):
    config = preset("smoke", env="pendulum", random_baseline=False, **METRA)
    p = components.make(config)
    size = envs.make("pendulum").observation_size
    assert (p.sac.observation_size, p.num_seen) == (size + Z, size + Z)
    state = jnp.arange(size + Z, dtype=jnp.float32)
    bare = components.make(preset("smoke", env="pendulum"))
    np.testing.assert_array_equal(p.phi(state), bare.phi(state[:size]))
    assert p.phi.names == bare.phi.names

    learner = algorithm.start(config).learner
    starts = learner.episodes.starts.obs
    _, transition = base.step(p.env, learner.episodes, jnp.zeros((4, 1)), 9, key)
    add = jax.jit(functools.partial(experience.add, p))
    items = (learner.replay, transition, learner.place, jnp.zeros(4))
    ring, _ = add(learner.reference, *items, key)
    drawn = experience.sample(p, ring, starts, (32,), key)
    np.testing.assert_array_equal(drawn.observation[:, -Z:], drawn.next_observation[:, -Z:])
    np.testing.assert_allclose(jnp.linalg.norm(drawn.observation[:, -Z:], axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize("env", ["pendulum", "mountain_car", "ant"])
def test_cells_and_tasks_do_not_see_the_skill(env, key):
    bare, own = (preset("smoke", env=env, task="gymnasium", **x) for x in ({}, METRA))
    of_bare, p = components.make(bare), components.make(own)
    states = jax.vmap(p.env.reset)(jax.random.split(key, 9)).obs
    cells = lambda p, states: histogram.cells(states, p.grid)
    np.testing.assert_array_equal(cells(p, states), cells(of_bare, states[:, :-Z]))
    action, unpaid = jnp.zeros((9, p.env.action_size)), jnp.zeros(9)
    paid = p.task.pay(states, action, states, unpaid)
    expected = of_bare.task.pay(states[:, :-Z], action, states[:, :-Z], unpaid)
    np.testing.assert_array_equal(paid, expected)


def test_gymnasium_gives_each_episode_a_skill_of_its_own():
    run = make_run(env="ant", backend="mujoco", **METRA)
    env = gymnasium_play.make(run.config)
    states = [env.reset(seed=0)[0], env.step(np.zeros(8))[0], env.reset()[0]]
    skills = np.array(states)[:, -Z:]
    assert states[0].shape == env.observation_space.shape == (29 + Z,)
    np.testing.assert_array_equal(skills[0], skills[1])
    assert (skills[1] != skills[2]).all()
    np.testing.assert_allclose(np.linalg.norm(skills, axis=1), 1, rtol=1e-6)
    played = gymnasium_play.play(run, [0])
    assert played.states.shape[-1] == 29 + Z


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (dict(skill_size=2, policy_inputs="heading"), "skill-size is 2, but needs policy-inputs"),
        (dict(skill_size=2, yaw_copies=1), "skill-size is 2, but needs policy-inputs state"),
        (dict(method="metra", skill_size=0), "bonus is metra, which rewards skills"),
        (dict(env="pendulum", protocol="metra"), "protocol is metra, but pendulum has none"),
        (dict(protocol="tldr"), "unknown protocol 'tldr'"),
    ],
)
def test_what_skills_and_protocols_cannot_do_is_refused(changes, sentence):
    with pytest.raises(ConfigError, match=sentence):
        preset("smoke", **changes)


@pytest.mark.parametrize("name", ["smoke", "quick", "gpu", "paper"])
@pytest.mark.parametrize("env", ["ant", "walker2d", "humanoid"])
def test_a_protocol_fits_every_preset_and_a_given_setting_wins(name, env):
    for method in ("v", "metra"):
        config = preset(name, env=env, method=method, protocol="metra")
        own = config.environment
        assert (own.episode_length, own.end_unhealthy, own.end_flipped) == (200, False, False)
        assert config.mixture.mixture_episodes == 48 and config.evaluation.deterministic
    assert preset(name, env=env, protocol="metra", episode_length=300)["episode_length"] == 300
