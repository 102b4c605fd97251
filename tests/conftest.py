"""Strict settings for every test: ranks are not promoted silently, keys are typed."""

import os

import jax
import pytest

from maxent_jax import runtime

os.environ.setdefault("MPLBACKEND", "Agg")
runtime.prepare(simulates_in_jax=True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_legacy_prng_key", "error")


@pytest.fixture
def key():
    return jax.random.key(0)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Each program on a CPU holds memory maps, of which a process may have 65,530 (Linux)."""
    yield
    jax.clear_caches()
