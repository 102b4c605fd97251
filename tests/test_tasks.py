"""Task rewards, held against Gymnasium's and against hand-computed values."""

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from maxent_jax import components, envs, tasks
from maxent_jax.analysis.gymnasium_play import IDS
from maxent_jax.config import preset, registry
from maxent_jax.config import tasks as names
from maxent_jax.errors import ConfigError, ConfigTypeError

NUM_STEPS = 1000
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")


def make(name, env):
    return tasks.make(name, env, envs.make(env))


def random_steps(env, num=NUM_STEPS):
    """Observations [num, D], actions, next observations and rewards of a random policy."""
    rng, rows = np.random.default_rng(0), []
    observation, _ = env.reset(seed=0)
    for _ in range(num):
        action = rng.uniform(env.action_space.low, env.action_space.high)
        after, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, after, reward))
        observation = env.reset()[0] if terminated or truncated else after
    return map(np.asarray, zip(*rows, strict=True))


def robot(name):
    return gymnasium.make(IDS[name], exclude_current_positions_from_observation=False)


def rewards(name, observation, action, next_observation, span=1.0):
    reward = jax.jit(make("gymnasium", name).reward)
    return np.asarray(reward(*map(jnp.float32, (observation, action / span, next_observation))))


def test_walker2d_equals_gymnasium():
    observation, action, after, expected = random_steps(robot("walker2d"))
    # Positions up to 1 m are rounded by 6e-8 m, and divided by 0.008 s.
    np.testing.assert_allclose(rewards("walker2d", observation, action, after), expected, atol=3e-5)


@pytest.mark.parametrize(("name", "span", "gap"), [("ant", 1.0, 0.1), ("humanoid", 0.4, 0.1)])
def test_ant_and_humanoid_equal_gymnasium(name, span, gap):
    observation, action, after, expected = random_steps(robot(name))
    found = rewards(name, observation, action, after, span)
    # Gymnasium reads positions from the integrator's last evaluation, within the last step.
    assert np.abs(found - expected).max() < gap
    np.testing.assert_allclose(found.mean(), expected.mean(), atol=0.01)


@pytest.mark.parametrize("name", ["ant", "humanoid"])
def test_rewards_equal_gymnasiums_formula_at_the_states_themselves(name):
    env = robot(name)
    raw = env.unwrapped
    place = raw.get_body_com if name == "ant" else None
    rng = np.random.default_rng(0)
    from gymnasium.envs.mujoco.humanoid_v4 import mass_center

    def at():
        mujoco.mj_kinematics(raw.model, raw.data)
        return place("torso")[0] if place else mass_center(raw.model, raw.data)[0]

    observation, _ = env.reset(seed=0)
    rows = []
    for _ in range(NUM_STEPS):
        before = at()
        action = rng.uniform(env.action_space.low, env.action_space.high)
        after, _, terminated, truncated, _ = env.step(action)
        weight = 1.0 if name == "ant" else 1.25
        expected = weight * (at() - before) / raw.dt
        cost = raw.control_cost(action)
        rows.append((observation, action, after, expected + raw.healthy_reward - cost))
        observation = env.reset()[0] if terminated or truncated else after
    observation, action, after, expected = map(np.asarray, zip(*rows, strict=True))
    span = env.action_space.high[0]
    # Positions up to a few metres are rounded by 2e-7 m, and divided by 0.015 s or 0.05 s.
    np.testing.assert_allclose(rewards(name, observation, action, after, span), expected, atol=1e-4)


@pytest.mark.parametrize("name", ["ant", "walker2d", "humanoid"])
@pytest.mark.parametrize("above", [0.0, 3.0])  # metres, where no height is healthy
def test_where_health_ends_no_episode_the_unhealthy_are_not_paid_for_it(name, above):
    theirs = gymnasium.make(
        IDS[name],
        exclude_current_positions_from_observation=False,
        terminate_when_unhealthy=False,
    )
    before, _ = theirs.reset(seed=0)
    raw = theirs.unwrapped
    qpos = raw.data.qpos.copy()
    qpos[tasks._ROBOTS[name].height] += above
    raw.set_state(qpos, np.zeros(raw.model.nv))
    before[: len(qpos)] = qpos
    action = np.zeros(raw.model.nu)
    after, expected, terminated, *_ = theirs.step(action)
    assert not terminated and raw.is_healthy == (above == 0)
    found = {}
    for ends in (True, False):
        env = envs.make(name, backend="mujoco", end_unhealthy=ends)
        reward = tasks.make("gymnasium", name, env).reward
        found[ends] = float(reward(*map(jnp.float32, (before, action, after))))
    # Gymnasium reads positions from the integrator's last evaluation, within the last step.
    np.testing.assert_allclose(found[False], expected, atol=0.1)
    lost = 0.0 if raw.is_healthy else tasks._ROBOTS[name].survival
    np.testing.assert_allclose(found[True] - found[False], lost, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "identifier"),
    [("pendulum", "Pendulum-v1"), ("mountain_car", "MountainCarContinuous-v0")],
)
def test_classic_rewards_equal_gymnasiums(name, identifier):
    env = gymnasium.make(identifier)
    observation, action, after, expected = random_steps(env)
    found = rewards(name, observation, action, after, env.action_space.high[0])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def state(name, **entries):
    """An observation at rest with some entries changed, by index."""
    size = {"ant": 29, "walker2d": 18}[name]
    observation = np.zeros(size, np.float32)
    if name == "ant":
        observation[3] = 1.0  # upright
    for index, value in entries.items():
        observation[int(index[1:])] = value
    return jnp.asarray(observation)


def paid(name, env, before, after):
    task = make(name, env)
    return float(task.reward(before, jnp.zeros(envs.make(env).action_size), after))


@pytest.mark.parametrize(
    ("name", "env", "before", "after", "expected"),
    [
        # A control step of Ant takes 0.05 s, of Walker2d 0.008 s.
        ("forward", "ant", {}, {"_0": 0.1}, 2.0),
        ("backward", "ant", {}, {"_0": 0.1}, -2.0),
        ("run:90", "ant", {"_1": 1.0}, {"_1": 1.2}, 4.0),
        ("run:45", "ant", {}, {"_0": 0.1, "_1": 0.1}, 2.0 * 2**0.5),
        ("backward", "walker2d", {}, {"_0": -0.008}, 1.0),
        ("reach:3,4", "ant", {}, {}, np.exp(-1.0)),
        ("reach:-5", "walker2d", {}, {}, np.exp(-1.0)),
        ("goal:15,0", "ant", {}, {"_0": 13.1}, 1.0),
        ("goal:15,0", "ant", {}, {"_0": 12.9}, 0.0),
        ("goal:15,0,3", "ant", {}, {"_0": 12.9}, 1.0),
        ("goal:-8,1", "walker2d", {}, {"_0": -7.5}, 1.0),
        ("stand", "ant", {}, {}, 1.0),
        ("stand", "ant", {}, {"_15": 3.0}, 0.25),
        ("stand", "ant", {}, {"_3": 0.0, "_4": 1.0}, 0.0),  # upside down
        ("jump", "ant", {}, {"_2": 0.95}, 0.2),
        ("jump", "walker2d", {}, {"_1": 1.0}, 0.0),
        ("flip", "walker2d", {"_2": 3.0}, {"_2": 3.016}, 2.0),
    ],
)
def test_families_pay_what_they_say(name, env, before, after, expected):
    found = paid(name, env, state(env, **before), state(env, **after))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("env", registry.ENVS)
def test_every_task_takes_any_leading_axes(env):
    made = envs.make(env)
    size = jax.eval_shape(made.reset, jax.random.key(0)).obs.shape[-1]
    observation, action = jnp.ones((2, 3, size)), jnp.zeros((2, 3, made.action_size))
    examples = {"run": "run:30", "reach": "reach:1,2", "goal": "goal:1,2"}
    if env == "walker2d":
        examples |= {"reach": "reach:1", "goal": "goal:1"}
    for family, row in names.FAMILIES.items():
        if env in row.envs:
            reward = tasks.make(examples.get(family, family), env, made).reward
            assert reward(observation, action, observation).shape == (2, 3)


@pytest.mark.parametrize(
    ("name", "env", "sentence"),
    [
        ("flap", "walker2d", "unknown task 'flap': did you mean 'flip'?"),
        ("flip", "ant", "task is flip, but ant has only: gymnasium, forward, backward, "),
        ("run:90", "walker2d", "task is run:90, but walker2d has only: "),
        ("goal:15", "ant", "task is goal:15, but must be goal:X,Y,RADIUS, with numbers."),
        ("goal:1,2,3,4", "ant", "but must be goal:X,Y,RADIUS, with numbers."),
        ("goal:a,b", "ant", "but must be goal:X,Y,RADIUS, with numbers."),
        ("run:inf", "ant", "task is run:inf, but must be run:DEGREES, with numbers."),
        ("run", "ant", "task is run, but must be run:DEGREES, with numbers."),
        ("stand:1", "ant", "task is stand:1, but must be stand, without numbers."),
        ("goal:1,2,0", "ant", "task is goal:1,2,0, but its radius must be a positive number."),
    ],
)
def test_a_wrong_name_gives_one_sentence(name, env, sentence):
    with pytest.raises(ConfigError) as wrong:
        names.parse(name, env)
    assert sentence in str(wrong.value)


@pytest.mark.parametrize(
    ("reward", "says"),
    [
        (lambda observation, action, after: after[..., :1], r"is an array \[3, 2, 1\] for trans"),
        (lambda observation, action, after: after[0], r"is an array \[2, 3\] for transitions \[3,"),
        (lambda observation, action, after: 1.0, r"is an array \[\] for transitions \[3, 2\]"),
        (lambda observation, action, after: (after[..., 0],), "is no array for transitions"),
    ],
)
@pytest.mark.parametrize("skill_size", [0, 2])
def test_a_users_task_gives_each_transition_one_reward(reward, says, skill_size):
    tasks.register("wrong", reward)
    config = preset("smoke", env="pendulum", task="user:wrong", skill_size=skill_size)
    with pytest.raises(ConfigError, match=f"the reward of task user:wrong {says}"):
        components.make(config)
    names.USERS.pop("user:wrong")


def test_a_users_task_is_registered_once_it_is_used():
    tasks.register("half", lambda observation, action, after: 0.5 * after[..., 0], sparse=True)
    task = make("user:half", "pendulum")
    assert task.sparse
    assert float(task.reward(jnp.zeros(3), jnp.zeros(1), jnp.ones(3))) == 0.5
    with pytest.raises(ConfigTypeError, match="reward is 3, but must be a function"):
        tasks.register("three", 3)
    with pytest.raises(ConfigError, match="task 'user:nobody' is not registered"):
        make("user:nobody", "pendulum")
    names.USERS.pop("user:half")
