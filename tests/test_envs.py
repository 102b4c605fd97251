"""What `make` accepts and refuses, deviations, brax's environments, and the user's own."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs as brax_envs
from brax.envs.wrappers import training

from maxent_jax import envs, features
from maxent_jax.config.registry import BACKENDS, BRAX_ENVS, PHYSICS
from maxent_jax.density.histogram import Grid
from maxent_jax.envs import task
from maxent_jax.envs.physics import Options
from maxent_jax.errors import ConfigError


@pytest.fixture(scope="module")
def env():
    return envs.make("ant", backend="mujoco")


def step_all(env, states, actions):
    return jax.jit(jax.vmap(env.step))(states, actions)


def test_torque_limit_scales_the_control(env):
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 50))
    actions = jax.random.uniform(jax.random.key(2), (50, 8), minval=-1.5, maxval=1.5)
    weak = step_all(envs.make("ant", backend="mujoco", torque_limit=0.4), states, actions)
    scaled = step_all(env, states, 0.4 * jnp.clip(actions, -1, 1))
    # 0.4 a is rounded once on either way: equal up to the last places of a float32.
    np.testing.assert_allclose(weak.obs, scaled.obs, rtol=1e-5, atol=1e-5)
    assert np.abs(weak.obs - step_all(env, states, actions).obs).max() > 1


def test_braxs_own_wrappers_run_on_it(env):
    # brax's time limit wants the old untyped keys; what wraps one env into many does not.
    wrapped = training.AutoResetWrapper(training.VmapWrapper(env))
    start = jax.jit(wrapped.reset)(jax.random.split(jax.random.key(8), 3))
    falling = start.replace(
        pipeline_state=start.pipeline_state._replace(
            qpos=start.pipeline_state.qpos.at[1, 2].set(3.0)
        )
    )
    after = jax.jit(wrapped.step)(falling, jnp.zeros((3, 8)))
    np.testing.assert_array_equal(after.done, [0, 1, 0])
    np.testing.assert_array_equal(after.obs[1], start.obs[1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (dict(name="atn"), "unknown env 'atn': did you mean 'ant'?"),
        (dict(name="walker"), "did you mean 'walker2d'?"),
        (dict(name="brax:halfchetah"), "did you mean 'brax:halfcheetah'?"),
        (dict(name="user:mine"), "'user:mine' is not registered"),
        (dict(name="ant", backend="mujco"), "did you mean 'mujoco'?"),
        (dict(name="ant", backend="cuda"), "auto, mjx, mujoco, warp"),
        (dict(name="ant", physics="fats"), "did you mean 'fast'?"),
        (dict(name="walker2d", backend="mujoco", end_flipped=True), "no floating torso"),
        (dict(name="pendulum", backend="mujoco"), "pendulum has only: auto"),
        (dict(name="brax:ant", backend="mujoco"), "brax:ant has only: auto, mjx"),
        (dict(name="brax:ant", physics="fast"), "brax:ant has only: reference"),
    ],
)
def test_what_cannot_be_made_is_refused_in_a_sentence(arguments, words):
    with pytest.raises(ConfigError) as refused:
        envs.make(**arguments)
    message = str(refused.value)
    assert words in message
    assert not re.search(r"[.!?] |\n", message)


def test_warp_that_is_not_installed_is_refused_in_a_sentence(monkeypatch):
    find_spec = envs.mjx_backend.importlib.util.find_spec
    without = lambda name: None if name == "warp" else find_spec(name)
    monkeypatch.setattr("importlib.util.find_spec", without)
    with pytest.raises(ConfigError, match="backend 'warp' needs the package warp-lang"):
        envs.make("ant", backend="warp")


@pytest.mark.parametrize("shape", [(7,), (9,), ()])
def test_an_action_of_the_wrong_size_is_refused(env, shape):
    state = env.reset(jax.random.key(9))
    with pytest.raises(ValueError, match=re.escape("expected [8]")):
        env.step(state, jnp.zeros(shape))


@pytest.mark.parametrize(
    ("platform", "backend"), [("cpu", "mujoco"), ("gpu", "mjx"), ("tpu", "mjx")]
)
def test_auto_is_c_on_a_cpu_and_mjx_elsewhere(monkeypatch, platform, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    assert task.resolve_backend("auto") == backend


def test_the_names_are_those_of_the_config():
    assert set(brax_envs._envs) - {"fast"} == set(BRAX_ENVS)  # fast is brax's own test
    assert set(BACKENDS) == {"auto", "mjx", "mujoco", "warp"}
    assert set(PHYSICS) == {"reference", "fast"}


@pytest.fixture
def lenient():
    """brax promotes ranks, and uses old keys."""
    with jax.numpy_rank_promotion("allow"), jax.legacy_prng_key("allow"):
        yield


@pytest.mark.slow
@pytest.mark.parametrize("name", ["halfcheetah", "reacher"])
def test_a_brax_environment_by_name(name, lenient):
    env = envs.make(f"brax:{name}")
    theirs = brax_envs.get_environment(name)
    assert env.action_size == theirs.action_size
    phi = features.make_feature_map(f"brax:{name}")
    observation = np.arange(task.observation_size(env), dtype=np.float32)
    found = phi(observation)
    assert found.shape == (7,)
    np.testing.assert_array_equal(found[:2], observation[:2])


def test_a_brax_environment_observes_its_position(lenient):
    env = envs.make("brax:halfcheetah")
    theirs = brax_envs.get_environment("halfcheetah")
    assert task.observation_size(env) == task.observation_size(theirs) + 1


CART = """<mujoco model="cart"><option timestep="0.01"/><worldbody>
    <body><joint name="rail" type="slide" axis="1 0 0"/>
    <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
    <actuator>{actuator}</actuator></mujoco>"""
MOTOR = '<motor joint="rail" gear="2" ctrlrange="-3 3" ctrllimited="true"/>'


def cart(tmp_path, actuator=MOTOR):
    path = tmp_path / "cart.xml"
    path.write_text(CART.format(actuator=actuator))
    return path


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_any_xml_can_be_an_environment(tmp_path, backend):
    path = cart(tmp_path)
    env = envs.from_xml(path, frame_skip=2, backend=backend, reset_noise=0.0)
    assert (env.observation_size, env.action_size) == (2, 1)
    assert env.dt == pytest.approx(0.02)
    after = jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.array([0.5]))
    # A mass of 1 kg under 0.5 * 3 * 2 N, semi-implicit Euler: v = 3 * 0.02, x = 3 * (1 + 2) * 1e-4.
    np.testing.assert_allclose(after.obs, [9e-4, 0.06], rtol=1e-5)


def test_an_xml_has_fast_physics_only_if_it_was_given_them(tmp_path):
    path = cart(tmp_path)
    with pytest.raises(ConfigError, match="physics is fast, but cart has no simplified physics"):
        envs.from_xml(path, 2, "mujoco", "fast")
    own = Options("implicitfast", substeps=2)
    reference, fast = (
        envs.from_xml(path, 2, "mujoco", name, fast=own) for name in ("reference", "fast")
    )
    assert (reference.model.opt.timestep, fast.model.opt.timestep) == (0.01, 0.005)
    assert reference.dt == fast.dt == 0.02


def test_an_xml_that_does_not_exist_or_is_none_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"no_such\.xml"):
        envs.from_xml(tmp_path / "no_such.xml", frame_skip=1)
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody></mujoco>")
    with pytest.raises(ConfigError, match=r"broken\.xml"):
        envs.from_xml(broken, frame_skip=1)


def test_what_mjx_cannot_load_is_named(tmp_path):
    path = tmp_path / "stiff.xml"
    option = '<option integrator="implicit"/>'
    path.write_text(CART.format(actuator=MOTOR).replace('"cart">', f'"stiff">{option}'))
    with pytest.raises(ConfigError, match=r"'stiff' .*mjINT_IMPLICIT.*: use backend mujoco"):
        envs.from_xml(path, frame_skip=1, backend="mjx")


def test_actuators_with_a_state_are_refused(tmp_path):
    integrator = '<general joint="rail" dyntype="integrator" ctrlrange="-1 1"/>'
    with pytest.raises(ConfigError, match="activations"):
        envs.from_xml(cart(tmp_path, integrator), frame_skip=1, backend="mujoco")


@pytest.mark.parametrize("limits", ["", 'ctrlrange="2 2" ctrllimited="false"'])
def test_an_actuator_without_a_control_range_is_refused(tmp_path, limits):
    path = cart(tmp_path, f'{MOTOR}<motor name="weak" joint="rail" {limits}/>')
    with pytest.raises(ConfigError, match=r"actuator 'weak' of cart\.xml has no control range"):
        envs.from_xml(path, frame_skip=1)


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_a_model_that_cannot_move_is_refused(tmp_path, backend):
    path = tmp_path / "stone.xml"
    path.write_text('<mujoco><worldbody><geom size="0.1"/></worldbody></mujoco>')
    with pytest.raises(ConfigError, match=r"stone\.xml has no joints"):
        envs.from_xml(path, frame_skip=1, backend=backend)


@pytest.mark.parametrize(
    ("arguments", "kind", "says"),
    [
        (dict(physics=Options("rk4")), ConfigError, "unknown integrator 'rk4': choose one of Eul"),
        (dict(physics=Options(solver="newton")), ConfigError, "did you mean 'Newton'"),
        (dict(physics=Options(substeps=0)), ConfigError, "substeps is 0, but must be at least 1"),
        (dict(physics=Options(iterations=-1)), ConfigError, "iterations is -1, but must be at lea"),
        (dict(physics=Options(substeps=1.5)), TypeError, "substeps is 1.5, but must be a whole"),
        (dict(healthy=3), TypeError, "healthy is 3, but must be a function"),
        (dict(fast="fast"), TypeError, r"fast is 'fast', but must be an envs\.Options"),
    ],
)
def test_a_wrong_option_of_an_xml_is_refused(tmp_path, arguments, kind, says):
    with pytest.raises(kind, match=says):
        envs.from_xml(cart(tmp_path), frame_skip=1, **arguments)


def test_an_environment_of_the_users_is_known_by_name(tmp_path):
    path = cart(tmp_path)
    grid = Grid(names=("x (m)", "v (m/s)"), low=(-1, -1), high=(1, 1), bins=(5, 5))
    make = functools.partial(envs.from_xml, path, 2)
    envs.register("cart", lambda backend, physics: make(backend, physics), grid)
    assert envs.make("user:cart", backend="mujoco").backend == "mujoco"
    assert envs.entry("user:cart").grid == grid
    phi = features.make_feature_map("user:cart")
    np.testing.assert_array_equal(phi(jnp.array([[3.0, 4.0]])), [[3, 4]])
    assert phi.names == ("state_0", "state_1")
