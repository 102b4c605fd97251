"""Strict settings for every test: ranks are not promoted silently, keys are typed."""

import os
import shutil
from pathlib import Path

import commands
import filelock
import jax
import pytest

from maxent_jax import runtime

# Most of the time goes into compiling toy programs that run for milliseconds: LLVM may spare its
# passes. Subprocesses inherit it. With another level in XLA_FLAGS, as in .ci/run, that one is used.
UNOPTIMISED = "--xla_backend_optimization_level"
if UNOPTIMISED not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {UNOPTIMISED}=1".strip()
os.environ.setdefault("MPLBACKEND", "Agg")
runtime.prepare(simulates_in_jax=True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_legacy_prng_key", "error")

# Files that take longest come first, so that no worker is left with one at the end.
LONGEST = ("test_train", "test_baselines", "test_algorithm", "test_devices", "test_physics")


def pytest_collection_modifyitems(items):
    def place(item):
        name = item.path.stem
        return LONGEST.index(name) if name in LONGEST else len(LONGEST)

    items.sort(key=place)


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Each program on a CPU holds memory maps, of which a process may have 65,530 (Linux)."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory):
    """A finished run of preset smoke on Ant: copy it to change it."""
    return _trained_once(tmp_path_factory, "smoke_run")


@pytest.fixture(scope="session")
def two_seeds(tmp_path_factory):
    """The same with two seeds side by side."""
    return _trained_once(tmp_path_factory, "two_seeds", "--num-seeds", "2")


def _trained_once(tmp_path_factory, name, *flags):
    """By the first worker that needs it, for all of them."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    directory, unfinished = shared / name, shared / f"unfinished_{name}"
    with filelock.FileLock(shared / f"{name}.lock"):
        if not directory.exists():
            commands.in_subprocess("train", "--preset", "smoke", "--out", unfinished, *flags)
            unfinished.rename(directory)
    return directory


@pytest.fixture
def copy_of_smoke_run(smoke_run, tmp_path):
    """A copy of that run, for this test alone."""
    return Path(shutil.copytree(smoke_run, tmp_path / "copy_of_smoke_run"))
