"""TD3+BC: it imitates without returns, and improves on its data with them."""

import jax
import numpy as np
import pytest
import user_module  # noqa: F401  registers user:point and user:right

from maxent_jax import components
from maxent_jax.baselines import td3_bc
from maxent_jax.config import preset

SETTINGS = td3_bc.Settings(num_updates=3_000, batch_size=64, hidden_size=32, discount=0.9)


@pytest.fixture(scope="module")
def p():
    config = preset("smoke", env="user:point", episode_length=40)
    return components.with_task(components.make(config), "user:right")


def data_of(act, num=2_000):
    """Transitions of the point from everywhere, rewarded by their first coordinate."""
    rng = np.random.default_rng(0)
    observation = rng.uniform(-1.5, 1.5, (num, 2)).astype(np.float32)
    action = act(rng, observation).astype(np.float32)
    reached = observation + 0.2 * action
    return {
        "observations": observation,
        "actions": action,
        "next_observations": reached,
        "rewards": reached[:, 0],
        "terminals": (reached**2).sum(-1) > 4,
    }


def at_random(rng, observation):
    return rng.uniform(-1, 1, observation.shape)


def test_it_improves_on_random_data(p):
    policy = td3_bc.train(p, SETTINGS, data_of(at_random), jax.random.key(0))
    near = np.array([[0.0, 0.0], [-1.0, 0.5], [0.3, -0.8]], np.float32)
    action = np.stack([td3_bc.act(p, SETTINGS, policy, s) for s in near])
    assert action[:, 0].min() > 0.3  # to the right, where the data has 0 on average
    returns = td3_bc.evaluate(p, SETTINGS, policy, 5, jax.random.key(1))
    assert returns.shape == (5,) and returns.min() > 5  # a random policy's are near 0


def test_without_returns_it_imitates(p):
    settings = td3_bc.Settings(**(vars(SETTINGS) | {"return_scale": 0.0}))
    towards = lambda _, observation: np.clip(-observation, -0.9, 0.9)
    policy = td3_bc.train(p, settings, data_of(towards), jax.random.key(0))
    near = np.array([[0.5, -0.3], [-0.8, 0.1]], np.float32)
    action = np.stack([td3_bc.act(p, settings, policy, s) for s in near])
    np.testing.assert_allclose(action, -near, atol=0.15)


def test_a_seed_gives_the_same_policy_again(p):
    settings = td3_bc.Settings(**(vars(SETTINGS) | {"num_updates": 1_500}))
    one, two = (td3_bc.train(p, settings, data_of(at_random), jax.random.key(3)) for _ in range(2))
    assert all(
        np.array_equal(x, y)
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True)
    )
