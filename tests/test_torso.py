"""A floating torso: its attitude, its symmetry, and what a policy sees from its heading."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from scipy.spatial.transform import Rotation

from maxent_jax import envs
from maxent_jax.envs import humanoid, torso
from maxent_jax.envs.physics import PhysicsState

NUM_EPISODES, LENGTH, NUM_STATES = 40, 30, 200
WORLD_FIXED = [0, 1, 6, 7]  # of heading_inputs: x, y, sin and cos of the yaw
ANT = envs.TASKS["ant"].torso


@pytest.fixture(scope="module")
def env():
    return envs.make("ant", backend="mujoco")


@pytest.fixture(scope="module")
def visited(env):
    """States [B] that a random policy reaches within 30 steps, some of them unhealthy."""
    key_reset, key_steps, key_rows = jax.random.split(jax.random.key(1), 3)

    def step(state, key):
        action = jax.random.uniform(key, (NUM_EPISODES, 8), minval=-1, maxval=1)
        return jax.vmap(env.step)(state, action), state

    start = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_EPISODES))
    _, states = jax.jit(lambda s: jax.lax.scan(step, s, jax.random.split(key_steps, LENGTH)))(start)
    states = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), states)
    rows = jax.random.choice(key_rows, NUM_EPISODES * LENGTH, (NUM_STATES,), replace=False)
    return jax.tree.map(lambda x: x[rows], states)


@pytest.fixture(scope="module")
def actions():
    return jax.random.uniform(jax.random.key(2), (NUM_STATES, 8), minval=-1.5, maxval=1.5)


def step_all(env, states, actions):
    return jax.jit(jax.vmap(env.step))(states, actions)


def state_of(observation):
    """A physics state [...] at rest in the solver, from an observation [..., 29]."""
    start = PhysicsState(
        observation[..., :15], observation[..., 15:], jnp.zeros_like(observation[..., 15:])
    )
    zero = jnp.zeros(observation.shape[:-1])
    return State(start, observation, zero, zero)


def turn_world(state, angle):
    """The state with the world turned, through ANT.rotate; accelerations turn as velocities do."""
    turned = ANT.rotate(state.obs, angle)
    _, _, warmstart = state.pipeline_state
    as_velocity = jnp.concatenate([state.obs[..., :15], warmstart], axis=-1)
    warmstart = ANT.rotate(as_velocity, angle)[..., 15:]
    return state.replace(
        pipeline_state=PhysicsState(turned[..., :15], turned[..., 15:], warmstart), obs=turned
    )


@pytest.mark.parametrize("end_flipped", [False, True])
@pytest.mark.parametrize(("quaternion", "inverted"), [((1, 0, 0, 0), False), ((0, 1, 0, 0), True)])
def test_an_inverted_ant_ends_its_episode_if_told_to(end_flipped, quaternion, inverted):
    env = envs.make("ant", backend="mujoco", end_flipped=end_flipped)
    observation = jnp.zeros(29).at[2].set(0.6).at[3:7].set(jnp.array(quaternion, jnp.float32))
    after = jax.jit(env.step)(state_of(observation), jnp.zeros(8))
    assert bool(after.done) == (end_flipped and inverted)


@pytest.fixture(scope="module")
def attitudes():
    """Observations [256, 29] in every attitude; quaternions of length 0.5 to 2."""
    generator = np.random.default_rng(4)
    observation = generator.normal(size=(256, 29))
    observation[:, 3:7] /= np.linalg.norm(observation[:, 3:7], axis=1, keepdims=True)
    observation[:, 3:7] *= generator.uniform(0.5, 2, size=(256, 1))
    return observation


def rotation(observation):
    return Rotation.from_quat(observation[:, 3:7], scalar_first=True)


def test_up_axis_is_the_rotated_vertical(attitudes):
    up = rotation(attitudes).apply([0, 0, 1])
    observation = jnp.asarray(attitudes, jnp.float32)
    # Sums of a few products of order 1 in float32: a few times 2^-24.
    np.testing.assert_allclose(torso.up_axis(observation), up, atol=1e-6)
    np.testing.assert_array_equal(ANT.flipped(observation), up[:, 2] < 0)


def test_rotate_turns_positions_attitudes_and_velocities(attitudes):
    angle = np.random.default_rng(5).uniform(-2 * np.pi, 2 * np.pi, 256)
    turn = Rotation.from_euler("z", angle[:, None])
    turned = np.asarray(
        ANT.rotate(jnp.asarray(attitudes, jnp.float32), jnp.asarray(angle, jnp.float32))
    )
    atol = 5e-6  # numbers up to 4, angles up to 6.3 rounded to 2^-22
    np.testing.assert_allclose(turned[:, :3], turn.apply(attitudes[:, :3]), atol=atol)
    np.testing.assert_allclose(turned[:, 15:18], turn.apply(attitudes[:, 15:18]), atol=atol)
    difference = rotation(turned).inv() * turn * rotation(attitudes)
    np.testing.assert_allclose(difference.magnitude(), 0, atol=atol)
    # Joints, and the angular velocity in the torso's own axes, know nothing of the world's.
    own = [*range(7, 15), *range(18, 29)]
    np.testing.assert_array_equal(turned[:, own], attitudes[:, own].astype(np.float32))


def symmetry_error(env, states, actions, angle):
    """[B]: how far stepping turned states is from turning what the step leads to."""
    turned_first = step_all(env, turn_world(states, angle), actions).obs
    turned_last = ANT.rotate(step_all(env, states, actions).obs, angle)
    return np.abs(turned_first - turned_last).max(1)


@pytest.mark.slow
def test_stepping_a_turned_state_turns_the_step(env, visited, actions):
    angle = jax.random.uniform(jax.random.key(6), (NUM_STATES,), minval=-np.pi, maxval=np.pi)
    # Measured 1e-6: rounding. A contact at its limit may make a hundred times as much of it.
    assert symmetry_error(env, visited, actions, angle).max() < 1e-4


@pytest.mark.parametrize(("angle", "symmetric"), [(np.pi / 2, True), (-np.pi, True), (0.5, False)])
def test_a_torso_on_the_ground_turns_by_quarters_only(env, actions, angle, symmetric):
    observation = jax.vmap(env.reset)(jax.random.split(jax.random.key(10), NUM_STATES)).obs
    observation = observation.at[:, 2].set(0.24).at[:, 15].set(1.0)  # radius 0.25 m, and sliding
    error = symmetry_error(env, state_of(observation), actions, jnp.full(NUM_STATES, angle))
    # Measured: 1e-6 at most for quarter turns, a median of 0.4 for others.
    assert (error.max() < 1e-4) == symmetric
    assert (np.median(error) > 0.1) != symmetric


@pytest.fixture(scope="module")
def humanoids():
    """An environment, states [B] of falling robots, most in contact, and an action for each."""
    env = envs.make("humanoid", backend="mujoco")
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), NUM_STATES))
    step = jax.jit(jax.vmap(env.step))
    for key in jax.random.split(jax.random.key(1), 12):
        states = step(states, jax.random.uniform(key, (NUM_STATES, 17), minval=-1, maxval=1))
    assert (np.abs(states.obs[:, 294:]).max(1) > 0).mean() > 0.5
    return env, states, jax.random.uniform(key, (NUM_STATES, 17), minval=-1, maxval=1)


@pytest.mark.parametrize(("angle", "share"), [(np.pi / 2, 1.0), (-np.pi, 1.0), (0.5, 0.5)])
def test_a_humanoid_turns_with_all_that_is_observed_of_it(humanoids, angle, share):
    env, states, actions = humanoids
    rotate = envs.TASKS["humanoid"].torso.rotate
    turn = lambda obs: rotate(obs, jnp.full(NUM_STATES, angle))
    turned, after = turn(states.obs), turn(step_all(env, states, actions).obs)
    warmstart = states.pipeline_state.warmstart
    accelerations = jnp.concatenate([states.obs[:, :24], warmstart, states.obs[:, 47:]], axis=-1)
    physics = PhysicsState(turned[:, :24], turned[:, 24:47], turn(accelerations)[:, 24:47])
    result = step_all(env, states.replace(pipeline_state=physics, obs=turned), actions).obs
    size = np.abs(after).max(0) + 1
    # Relative to the largest of each entry. Measured: all in quarter turns, 0.61 at the other
    # angle, where feet that slide turn only nearly: the pyramid of friction again.
    same = (np.abs(result - after) / size).max(1) < 1e-4
    assert same.mean() >= share


def test_a_humanoids_inertia_turns_as_a_tensor():
    generator = np.random.default_rng(8)
    halves = generator.normal(size=(14, 3, 3))
    tensors = halves + halves.transpose(0, 2, 1)
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # MuJoCo's order
    derived = np.zeros((14, 10))
    derived[:, :6] = tensors[:, rows, columns]
    derived = np.concatenate([derived.ravel(), np.zeros(378 - 47 - 140)])
    turned = humanoid.rotate_derived(jnp.asarray(derived, jnp.float32), jnp.float32(0.7))
    matrix = Rotation.from_euler("z", 0.7).as_matrix()
    expected = (matrix @ tensors @ matrix.T)[:, rows, columns]
    turned = np.asarray(turned[:140]).reshape(14, 10)[:, :6]
    np.testing.assert_allclose(turned, expected, atol=5e-6)  # numbers up to 6 in float32


def test_heading_inputs_do_not_change_with_the_worlds_axes(visited):
    angle = jax.random.uniform(jax.random.key(7), (NUM_STATES,), minval=-np.pi, maxval=np.pi)
    inputs = np.asarray(ANT.heading_inputs(visited.obs))
    turned = np.asarray(ANT.heading_inputs(ANT.rotate(visited.obs, angle)))
    assert inputs.shape == (NUM_STATES, 34)
    difference = np.abs(inputs - turned).max(0)
    assert (difference[WORLD_FIXED] > 0.1).all()
    # Measured 7e-7: speeds of a few m/s through sine and cosine in float32.
    assert np.delete(difference, WORLD_FIXED).max() < 1e-5


def test_heading_inputs_but_for_position_do_not_change_with_the_place(visited):
    inputs = ANT.heading_inputs(visited.obs)
    elsewhere = ANT.heading_inputs(visited.obs.at[:, :2].add(jnp.array([[7.0, -30.0]])))
    np.testing.assert_array_equal(inputs[:, 6:], elsewhere[:, 6:])
    assert (np.abs(inputs - elsewhere)[:, :6].max(0) > 0.1).all()


def test_heading_inputs_see_the_world_from_the_ant():
    yaw, distance, speed = 0.7, 20.0, 3.0
    east, north = np.cos(yaw), np.sin(yaw)
    observation = np.arange(29, dtype=np.float32)
    observation[:7] = distance * east, distance * north, 0.6, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
    observation[15:18] = speed * east, speed * north, 0.5
    far = np.log(1 + distance / 10)
    expected = np.concatenate(
        [
            *([far * east, far * north], [far, 0], [distance / (distance + 0.1), 0], [north, east]),
            *([0.6], [0, 0, 1], [speed, 0, 0.5], range(7, 15), range(18, 29)),
        ]
    )
    # Order 1 to 28 in float32.
    np.testing.assert_allclose(
        ANT.heading_inputs(jnp.asarray(observation)), expected, rtol=1e-6, atol=2e-6
    )


def test_a_humanoid_is_seen_by_its_positions_and_velocities_alone():
    humanoid = envs.TASKS["humanoid"].torso
    observation = jnp.asarray(np.random.default_rng(6).normal(size=(5, 378)), jnp.float32)
    inputs = humanoid.heading_inputs(observation)
    assert inputs.shape == (5, 5 + 24 + 23)
    np.testing.assert_array_equal(inputs, humanoid.heading_inputs(observation.at[:, 47:].set(0)))
    np.testing.assert_array_equal(inputs[:, -17:], observation[:, 30:47])
    np.testing.assert_array_equal(inputs[:, 15:32], observation[:, 7:24])
