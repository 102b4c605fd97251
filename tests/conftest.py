"""Strict settings for every test: ranks are not promoted silently, keys are typed."""

import os

import jax
import pytest

from maxent_jax.cache import enable_compilation_cache

os.environ.setdefault("MPLBACKEND", "Agg")
enable_compilation_cache()
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_legacy_prng_key", "error")


@pytest.fixture
def key():
    return jax.random.key(0)
