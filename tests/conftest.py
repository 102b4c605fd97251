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
