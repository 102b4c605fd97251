"""Pendulum and mountain car: Gymnasium's dynamics, the official MaxEnt-H experiments' cells."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import envs
from maxent_jax.density import histogram
from maxent_jax.envs import mountain_car, pendulum
from maxent_jax.errors import ConfigError

NUM_STATES, NUM_STEPS = 100, 1000
IDS = {"pendulum": "Pendulum-v1", "mountain_car": "MountainCarContinuous-v0"}
LIMITS = {"pendulum": (np.pi, 8), "mountain_car": (0.9, 0.07)}  # of what the starts are drawn from
MIDDLE = {"pendulum": (0, 0), "mountain_car": (-0.3, 0)}
every_env = pytest.mark.parametrize("name", IDS)


def trajectories(name):
    """Gymnasium's: states [T + 1, B, 2], actions [T, B, 1], observations [T, B, D], and ends."""
    env = gymnasium.make(IDS[name]).unwrapped
    random = np.random.default_rng(0)
    starts = MIDDLE[name] + random.uniform(-1, 1, (NUM_STATES, 2)) * LIMITS[name]
    actions = random.uniform(-1.5, 1.5, (NUM_STEPS, NUM_STATES, 1)).astype(np.float32)
    states, observations, ends = [], [], []
    env.reset(seed=0)
    for start, mine in zip(starts, actions.swapaxes(0, 1), strict=True):
        env.state = start.astype(np.float32)
        if name == "pendulum":
            env.state = env.state.astype(np.float64)
        visited = [env.state]
        for action in mine * env.action_space.high[0]:
            observation, _, ended, _, _ = env.step(action)
            visited.append(env.state)
            observations.append(observation)
            ends.append(ended)
        states.append(visited)
    shape = NUM_STATES, NUM_STEPS
    by_time = lambda x: np.asarray(x).reshape(*shape, -1).swapaxes(0, 1)
    return np.swapaxes(states, 0, 1), actions, by_time(observations), by_time(ends)[..., 0]


@every_env
def test_each_of_a_hundred_thousand_steps_is_gymnasiums(name):
    states, actions, observations, ends = trajectories(name)
    env = envs.make(name)
    before = states[:-1]
    if name == "pendulum":  # which does not wrap its angle
        before = np.stack([np.angle(np.exp(1j * before[..., 0])), before[..., 1]], -1)
    blank = env.reset(jax.random.key(0))
    step = lambda state, action: env.step(blank.replace(pipeline_state=state), action)
    after = jax.jit(jax.vmap(jax.vmap(step)))(jnp.asarray(before, jnp.float32), actions)
    # Measured 5e-7 for the pendulum and 1.5e-8 for the car: float32. Their errors grow in the
    # pendulum by a factor of about 8 a second, so that no two trajectories stay together.
    np.testing.assert_allclose(after.obs, observations, atol=2e-6)
    np.testing.assert_array_equal(after.done > 0, ends)


def test_a_mountain_car_keeps_to_its_track():
    states, actions, observations, _ = trajectories("mountain_car")
    env = envs.make("mountain_car")
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), NUM_STATES))
    state = state.replace(pipeline_state=jnp.asarray(states[0], jnp.float32))
    step = lambda state, action: (lambda s: (s, s.obs))(jax.vmap(env.step)(state, action))
    _, ours = jax.jit(lambda s: jax.lax.scan(step, s, actions))(state)
    # Measured: at worst 1.2e-4 in 1,000 steps, 3e-6 in the first 200.
    np.testing.assert_allclose(ours[:200], observations[:200], atol=1e-4)


def test_the_pendulum_starts_hanging_at_rest():
    np.testing.assert_allclose(
        envs.make("pendulum").reset(jax.random.key(1)).obs, [-1, 0, 0], atol=1e-6
    )


def test_the_car_starts_at_rest_in_the_valley():
    env = envs.make("mountain_car")
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 1000)).obs
    assert (starts[:, 1] == 0).all()
    assert -0.6 <= starts[:, 0].min() < -0.59 and -0.41 < starts[:, 0].max() <= -0.4


def test_the_cells_are_those_of_the_official_experiments():
    # Eight cells of |θ| in [0, π] and of the speed in [-8, 8]; twelve of the position by eleven
    # of the velocity: numpy's digitize over the inner edges, as the official code has it.
    random = np.random.default_rng(1)
    angle, speed = random.uniform(-np.pi, np.pi, 500), random.uniform(-8, 8, 500)
    place, velocity = random.uniform(-1.2, 0.6, 500), random.uniform(-0.07, 0.07, 500)
    for grid, states, axes in (
        (
            pendulum.GRID,
            np.stack([np.cos(angle), np.sin(angle), speed], 1),
            ((np.abs(angle), 0, np.pi, 8), (speed, -8, 8, 8)),
        ),
        (
            mountain_car.GRID,
            np.stack([place, velocity], 1),
            ((place, -1.2, 0.6, 12), (velocity, -0.07, 0.07, 11)),
        ),
    ):
        cells = [np.digitize(x, np.linspace(low, high, n + 1)[1:-1]) for x, low, high, n in axes]
        expected = np.zeros(grid.bins, int)
        np.add.at(expected, tuple(cells), 1)
        found = histogram.count(jnp.asarray(states, jnp.float32), grid)
        np.testing.assert_array_equal(found, expected)


@every_env
@pytest.mark.parametrize(("option", "value"), [("backend", "mjx"), ("physics", "fast")])
def test_no_other_physics_is_offered(name, option, value):
    with pytest.raises(ConfigError, match=f"{option} is {value}"):
        envs.make(name, **{option: value})


@every_env
def test_an_action_of_the_wrong_size_is_refused(name):
    env = envs.make(name)
    with pytest.raises(ValueError, match=r"expected \[1\]"):
        env.step(env.reset(jax.random.key(0)), jnp.zeros(2))
