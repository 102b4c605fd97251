"""phi is two coordinates as they are, and five fixed projections of the rest."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import features
from maxent_jax.config.registry import CLASSIC_ENVS, MUJOCO_ENVS
from maxent_jax.errors import ConfigError
from maxent_jax.features import make_feature_map

COORDINATES = {"ant": (("x", 0), ("y", 1)), "walker2d": (("x", 0), ("z", 1))}
COORDINATES["humanoid"] = COORDINATES["ant"]
every_env = pytest.mark.parametrize("env_name", MUJOCO_ENVS)


def states(phi, *shape):
    size = len(phi.projection) + 2
    return np.random.default_rng(0).normal(0, 2, (*shape, size)).astype(np.float32)


def in_float64(phi, s):
    rest = np.delete(np.float64(s), phi.coordinates, axis=-1)
    return rest @ np.float64(phi.projection)


def rounding(phi, s):
    # Derived: a float32 dot product of n terms, summed in any order, and its factors rounded.
    rest = np.abs(np.delete(np.float64(s), phi.coordinates, axis=-1))
    return (rest.shape[-1] + 1) * 2**-24 * (rest @ np.abs(phi.projection))


@every_env
def test_the_first_two_features_are_named_coordinates_of_the_state(env_name):
    phi = make_feature_map(env_name)
    s = states(phi, 50)
    assert phi.names[:2] == tuple(name for name, _ in COORDINATES[env_name])
    assert len(set(phi.names)) == 7
    for feature, (_, coordinate) in enumerate(COORDINATES[env_name]):
        np.testing.assert_array_equal(phi(s)[:, feature], s[:, coordinate])


@every_env
@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_phi_keeps_the_leading_axes_and_has_seven_features(env_name, shape):
    phi = make_feature_map(env_name)
    found = phi(jnp.asarray(states(phi, *shape)))
    assert found.shape == (*shape, 7)
    assert found.dtype == jnp.float32


@every_env
def test_the_projections_are_those_of_float64(env_name):
    phi = make_feature_map(env_name)
    s = states(phi, 200)
    off = np.abs(jax.jit(phi.__call__)(s)[:, 2:] - in_float64(phi, s))
    assert (off <= rounding(phi, s)).all()


@every_env
def test_the_projections_are_linear(env_name):
    phi = make_feature_map(env_name)
    a, b = states(phi, 2, 50)
    found = phi(3 * a - 2 * b)[:, 2:]
    expected = 3 * np.float64(phi(a)[:, 2:]) - 2 * np.float64(phi(b)[:, 2:])
    # The combined state is itself rounded, once for each product and once for the difference.
    bound = 3 * (3 * rounding(phi, a) + 2 * rounding(phi, b))
    assert (np.abs(found - expected) <= bound).all()
    np.testing.assert_array_equal(phi(0 * a), 0)


@every_env
def test_a_batch_has_the_features_of_its_single_states(env_name):
    phi = make_feature_map(env_name)
    s = states(phi, 4, 5)
    batch = jax.jit(phi.__call__)(s)
    single = jax.jit(phi.__call__)
    for place in np.ndindex(4, 5):
        off = np.abs(batch[place] - single(s[place]))
        assert (off[:2] == 0).all()
        assert (off[2:] <= 2 * rounding(phi, s[place])).all()


@every_env
def test_each_projection_is_the_shared_gaussian_one_over_a_positive_scale(env_name):
    projection = np.array(make_feature_map(env_name).projection)
    raw = np.random.default_rng(features.PROJECTION_SEED).standard_normal(projection.shape)
    scale = (raw * raw).sum(0) / (projection * raw).sum(0)
    assert projection.shape[1] == 5
    assert (scale > 0).all()
    # The table has eight decimals.
    np.testing.assert_allclose(projection, raw / scale, rtol=0, atol=0.6e-8)


def test_random_steps_of_ant_in_gymnasium_fill_the_unit_interval():
    phi = make_feature_map("ant")
    env = gymnasium.make(
        "Ant-v5",
        exclude_current_positions_from_observation=False,
        include_cfrc_ext_in_observation=False,
    )
    env.action_space.seed(0)
    visited = []
    env.reset(seed=0)
    for _ in range(1000):
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        visited.append(observation)
        if terminated or truncated:
            env.reset()
    size = np.abs(in_float64(phi, visited))
    # Derived: 1 is the largest of 10,000 steps, so that a fresh step exceeds it about once in
    # 10,000; a few may do so together, since steps follow each other.
    assert np.mean(size > 1) < 0.002
    # Measured: the smallest of the five is 0.70 to 0.79 with the seeds 0 to 3.
    assert size.max(0).min() > 0.5


@pytest.mark.parametrize("env_name", CLASSIC_ENVS)
def test_a_classic_state_is_kept_whole_in_units_of_its_range(env_name):
    phi = make_feature_map(env_name)
    s = np.random.default_rng(0).normal(size=(4, 5, len(phi.names))).astype(np.float32)
    np.testing.assert_allclose(phi(s), s / np.float32(phi.units), rtol=1e-6)


@pytest.mark.parametrize("env_name", ["ant", *CLASSIC_ENVS])
@pytest.mark.parametrize("extra", [-1, 1])
def test_states_of_another_size_are_refused(env_name, extra):
    phi = make_feature_map(env_name)
    size = len(phi.coordinates) + len(phi.projection)
    with pytest.raises(ValueError, match=rf"but must be \[\.\.\., {size}\]"):
        phi(np.zeros((3, size + extra), np.float32))


def test_the_default_map_gives_unit_variance_to_unit_variance():
    phi = features._default(observation_size=60)
    s = np.random.default_rng(0).normal(size=(20_000, 60)).astype(np.float32)
    found = np.asarray(phi(s))
    np.testing.assert_array_equal(found[:, :2], s[:, :2])
    assert phi.names == ("state_0", "state_1", *(f"projection_{i}" for i in range(5)))
    # The norm of 58 standard normal factors over sqrt(58): 1 within 9 % = 1/sqrt(2 * 58), thrice.
    assert np.abs(found[:, 2:].std(0) - 1).max() < 0.28


def test_an_unknown_environment_is_refused():
    with pytest.raises(ConfigError, match="unknown env 'nowhere'"):
        make_feature_map("nowhere")
