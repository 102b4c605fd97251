"""Compiled programs, kept between runs in the user's own cache folder."""

import os
from pathlib import Path

import jax


def enable_compilation_cache() -> None:
    """Switches jax's persistent compilation cache on, unless the user has placed it already."""
    if not jax.config.values["jax_compilation_cache_dir"]:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "maxent_jax" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
