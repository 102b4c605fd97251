"""Strict settings for every test: ranks are not promoted silently, keys are typed."""

import os
import shutil
from pathlib import Path

import commands
import filelock
import jax
import pytest

from maxent_jax.runs import runtime

os.environ.setdefault("MPLBACKEND", "Agg")
runtime.prepare(simulates_in_jax=True)
# Small programs too: each file of tests compiles hundreds, and others have compiled most of them.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_legacy_prng_key", "error")

# Files that take longest come first, so that no worker is left with one at the end.
LONGEST = ("test_protocol", "test_train", "test_knn", "test_physics", "test_intrinsic")
# Toy programs run for milliseconds and compile for seconds: they are spared most optimisations, and
# XLA's newer code generator, which takes twice as long. From jax 0.11 on there is no other.
FAST = "JAX_DISABLE_MOST_OPTIMIZATIONS"
OLDER_EMITTERS = "--xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""


def pytest_addoption(parser):
    parser.addoption("--optimised", action="store_true", help="compile as a user's programs are")


def pytest_configure(config):
    fast = not config.getoption("--optimised")
    jax.config.update(FAST.lower(), fast)
    os.environ[FAST] = str(int(fast))  # of subprocesses
    flags = os.environ.get("XLA_FLAGS", "")
    if fast and OLDER_EMITTERS not in flags:  # a worker has them from pytest's first process
        os.environ["XLA_FLAGS"] = f"{flags} {OLDER_EMITTERS}".strip()


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
