"""Which native build is loaded, on processors that this machine is and is not."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from maxent_jax import native
from maxent_jax.errors import ConfigError

QEMU = shutil.which("qemu-x86_64")
HAS_COMPILER = any(shutil.which(name) for name in ("c++", "g++", "clang++"))

# A search of every point, one by a tree, and steps of Ant, against what is known of them.
WORK = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from maxent_jax import envs, native
from maxent_jax.density.knn import knn_distances
assert native.variant() == sys.argv[1], native.variant()
rng = np.random.default_rng(0)
sizes = [(64, 500), (2048, 8192)]
for num_queries, num_points in sizes[: 1 if sys.argv[1] == native.NONE else 2]:  # XLA has no tree
    queries = rng.standard_normal((num_queries, 7), np.float32)
    points = rng.standard_normal((num_points, 7), np.float32)
    found = jax.jit(knn_distances, static_argnums=2)(queries, points, 3)
    known = cKDTree(points.astype(float)).query(queries.astype(float), 3)[0]
    np.testing.assert_allclose(found, known, rtol=1e-5)
import mujoco
env = envs.make("ant", backend="mujoco")
state = jax.jit(env.reset)(jax.random.key(0))
before = np.asarray(state.obs)
after = jax.jit(env.step)(state, jnp.ones(8)).obs
model = mujoco.MjModel.from_xml_path(str(envs.TASKS["ant"].xml))
data = mujoco.MjData(model)
data.qpos[:], data.qvel[:], data.ctrl[:] = before[:15], before[15:], 1
mujoco.mj_step(model, data, 5)
np.testing.assert_allclose(after, np.concatenate([data.qpos, data.qvel]), rtol=1e-4, atol=1e-5)
"""


@pytest.fixture
def all_builds(tmp_path, monkeypatch):
    """A machine of a given level that has every build; which of them does it use?"""
    for name in native.LEVELS:
        (tmp_path / f"_{name}.so").touch()
    monkeypatch.setattr(native, "path", lambda name: tmp_path / f"_{name}.so")
    monkeypatch.delenv(native.CHOICE, raising=False)

    def chosen(level, wanted=None):
        monkeypatch.setattr(native, "_level", lambda: level)
        if wanted is not None:
            monkeypatch.setenv(native.CHOICE, wanted)
        return native.variant.__wrapped__()

    return chosen


@pytest.mark.parametrize(("level", "build"), [(0, "none"), (3, "v3"), (4, "v4"), (8, "v8")])
def test_the_fastest_build_that_the_processor_runs_is_chosen(all_builds, level, build):
    assert all_builds(level) == build


def test_a_user_may_choose_a_build_that_runs_here_and_no_other(all_builds):
    assert all_builds(4, "v3") == "v3"
    assert all_builds(4, "none") == "none"
    assert all_builds(4, "") == "v4"
    with pytest.raises(ConfigError, match="'v4', but this machine can use: auto, v3, none"):
        all_builds(3, "v4")
    with pytest.raises(ConfigError, match="'avx', but"):
        all_builds(4, "avx")


def test_a_build_that_was_not_made_is_not_chosen(all_builds):
    native.path("v4").unlink()
    assert all_builds(4) == "v3"


def test_there_is_a_build_for_this_machine_where_there_is_a_compiler():
    assert native.variant() != native.NONE or not HAS_COMPILER
    assert (native.library() is None) == (native.variant() == native.NONE)


@pytest.mark.slow
@pytest.mark.skipif(QEMU is None, reason="needs qemu-x86_64 (Debian: qemu-user)")
@pytest.mark.skipif(not native.path("v3").exists(), reason="no build for x86-64")
@pytest.mark.parametrize(("processor", "build"), [("Haswell", "v3"), ("SandyBridge", "none")])
def test_an_emulated_processor_without_avx512_searches_and_simulates(processor, build):
    line = [QEMU, "-cpu", processor, sys.executable, "-c", WORK, build]
    root = Path(__file__).parent.parent
    done = subprocess.run(line, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
