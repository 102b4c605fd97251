"""MuJoCo Playground's environments by name, and the rewards that environments have themselves."""

import commands
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import user_module  # noqa: F401  registers user:point

import maxent_jax
from maxent_jax import envs
from maxent_jax.config import registry, tasks
from maxent_jax.errors import ConfigError

needs_playground = pytest.mark.playground


def test_a_package_that_is_not_installed_is_named_in_a_sentence(monkeypatch, tmp_path):
    find_spec = registry.importlib.util.find_spec
    without = lambda name: None if name == "mujoco_playground" else find_spec(name)
    monkeypatch.setattr(registry.importlib.util, "find_spec", without)
    argv = ("--env", "playground:WalkerRun", "--out", tmp_path / "run")
    done = commands.call("train", *argv, expect=2)
    assert "playground:WalkerRun' needs the package playground" in done.stderr
    assert done.stderr.count("\n") == 1 and not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="did you mean 'playground:WalkerRun'"):
        envs.make("playground:WalkerRnu")


def test_the_reward_of_an_environment_is_a_task_of_those_that_have_one():
    assert tasks.parse("environment", "brax:ant").family == tasks.OWN
    assert "environment" in tasks.of_environment("playground:WalkerRun")
    assert "environment" not in tasks.of_environment("ant")
    with pytest.raises(ConfigError, match="task is environment, but ant has only: gymnasium"):
        tasks.parse("environment", "ant")


@needs_playground
def test_every_environment_of_the_suite_has_a_name():
    import mujoco_playground

    for name in mujoco_playground.dm_control_suite.ALL_ENVS:
        try:
            mujoco_playground.dm_control_suite.load(name, config_overrides={"impl": "jax"})
        except AttributeError:  # of MjSpec: Playground compares versions as text
            assert name not in registry.PLAYGROUND_ENVS
        else:
            assert name in registry.PLAYGROUND_ENVS


@needs_playground
@pytest.mark.parametrize(
    ("name", "places"),
    [("WalkerRun", 2), ("FishSwim", 2)],  # the second has a target, drawn at the start
)
def test_an_environment_steps_as_playgrounds_own(name, places):
    import mujoco_playground

    ours = envs.make(f"playground:{name}")
    theirs = mujoco_playground.dm_control_suite.load(name, config_overrides={"impl": "jax"})
    with jax.numpy_rank_promotion("allow"):
        state, expected = (jax.jit(env.reset)(jax.random.key(3)) for env in (ours, theirs))
        step, step_theirs = jax.jit(ours.step), jax.jit(theirs.step)
        rng = np.random.default_rng(0)
        for _ in range(20):
            action = jnp.asarray(rng.uniform(-1, 1, ours.action_size), jnp.float32)
            state, expected = step(state, action), step_theirs(expected, action)
            assert state.obs.shape == (ours.observation_size,)
            np.testing.assert_allclose(state.obs[places:], expected.obs, rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(state.reward, expected.reward, rtol=1e-4, atol=1e-5)
    if name == "WalkerRun":  # rootx, rootz
        np.testing.assert_array_equal(state.obs[:2], np.asarray(state.pipeline_state.qpos)[[1, 0]])


@needs_playground
def test_a_run_explores_and_then_earns_the_environments_reward(tmp_path):
    explored, solved = tmp_path / "explored", tmp_path / "solved"
    flags = ("--preset", "smoke", "--env", "playground:CartpoleBalance", "--out", explored)
    commands.call("train", *flags, "--episode-length", "40")
    commands.call("finetune", explored, "--task", "environment", "--out", solved)
    run = maxent_jax.load_run(solved)
    assert (run.metrics["task_return"] > 0).all() and (run.metrics["task_return"] < 40).all()
    data = maxent_jax.load_run(explored).dataset(100, task="environment")
    assert ((data["rewards"] > 0) & (data["rewards"] <= 1)).all()
