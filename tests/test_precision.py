"""The package under jax_enable_x64, which a user's other code may need."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax import algorithm, components, envs, features
from maxent_jax.config import preset
from maxent_jax.density import entropy, knn
from maxent_jax.envs.skills import WithSkill

ROOT = Path(__file__).parent.parent
RUN = """
import jax, numpy as np
from maxent_jax import algorithm
from maxent_jax.config import preset
config = preset("smoke", env="pendulum")
state = algorithm.init(config, jax.random.key(0))
state, metrics = jax.jit(algorithm.run, static_argnums=(0, 2), donate_argnums=1)(config, state, 2)
print({str(x.dtype) for x in jax.tree.leaves((state, metrics))} & {"float64", "int64"})
print({name: x.tolist() for name, x in sorted(metrics.items())})
"""


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def test_neighbours_are_found(x64):
    points = np.random.default_rng(0).standard_normal((50, 3))
    expected = np.sort(np.linalg.norm(points[:, None] - points, axis=-1), axis=1)[:, 1:3]
    alone = jnp.arange(50)  # of 64 bits here
    assert alone.dtype == np.int64
    for given in (jnp.asarray(points), jnp.asarray(points, jnp.float32), points.tolist()):
        found = knn.knn_distances(given, given, 2, exclude=alone, labels=alone, count=50)
        np.testing.assert_allclose(found, expected, rtol=1e-5)  # float32 rounds to 1e-7
    assert np.isfinite(entropy.knn_entropy(points.astype(np.float32), 3))


@pytest.mark.parametrize("name", ["ant", "pendulum", "mountain_car"])
def test_environments_step_in_32_bits(x64, name):
    env = envs.make(name)
    state = env.step(env.reset(jax.random.key(0)), np.zeros(env.action_size))
    assert {str(x.dtype) for x in jax.tree.leaves(state)} == {"float32"}
    assert features.make_feature_map(name)(np.asarray(state.obs, np.float64)).dtype == np.float32


def test_a_state_has_32_bits(x64):
    state = algorithm.init(preset("smoke", env="pendulum"), jax.random.key(0))
    assert not {str(x.dtype) for x in jax.tree.leaves(state)} & {"float64", "int64"}


def test_a_state_has_32_bits_if_its_components_came_first(x64):
    config = preset("smoke", env="brax:inverted_pendulum", hidden_size=7)  # in no other test
    components.make(config)
    state = algorithm.init(config, jax.random.key(0))
    assert not {str(x.dtype) for x in jax.tree.leaves(state)} & {"float64", "int64"}


def test_a_skill_has_32_bits(x64):
    start = WithSkill(envs.make("pendulum"), 2).reset(jax.random.key(0))
    assert start.obs.dtype == np.float32


@pytest.mark.slow
def test_a_run_is_the_one_without_64_bits():
    said = [
        subprocess.run(
            [sys.executable, "-c", RUN],
            env=os.environ | {"JAX_ENABLE_X64": bits, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for bits in ("0", "1")
    ]
    assert said[0] == said[1] and said[0].startswith("set()")
