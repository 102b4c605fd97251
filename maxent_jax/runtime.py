"""What a process settles before jax computes anything: the compilation cache, and one XLA flag."""

import os
from pathlib import Path

import jax

IN_ORDER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"


def prepare(simulates_in_jax: bool) -> None:
    """Switches jax's persistent compilation cache on, in the user's own cache folder.

    Args:
      simulates_in_jax: physics in jax (MJX, brax) will run; on a CPU its threads then run in order.
        XLA of jaxlib 0.10 otherwise locks up in MJX's Humanoid (all threads idle, for ever), from
        64 environments on. It costs other programs 5 to 10 %, and must precede the first
        computation. A user's own XLA_FLAGS are kept.
    """
    if not jax.config.values["jax_compilation_cache_dir"]:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "maxent_jax" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    flags = os.environ.get("XLA_FLAGS", "")
    if simulates_in_jax and IN_ORDER.split("=")[0] not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {IN_ORDER}".strip()
