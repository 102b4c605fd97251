"""Sets up jax before it computes anything. Imports jax only when called.

Overrides environment variables of jax that would change our programs, and rejects those with which
jax cannot start.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from maxent_jax.errors import UsageError
from maxent_jax.runs import machine

IN_ORDER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
# Options that users set for other programs. Ours need 32 bits and jit, and use infinities and NaN
# on purpose, so their results are those without these variables.
SETTLED = {
    "jax_enable_x64": False,
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_disable_jit": False,
    "jax_debug_key_reuse": False,
    "jax_check_tracer_leaks": False,
    "jax_raise_persistent_cache_errors": False,
    "jax_numpy_rank_promotion": "allow",
    "jax_numpy_dtype_promotion": "standard",
    "jax_transfer_guard": "allow",
    "jax_transfer_guard_host_to_device": "allow",
    "jax_transfer_guard_device_to_host": "allow",
    "jax_transfer_guard_device_to_device": "allow",
}
PROBE = "import jax; jax.devices('cpu')"
PROBE_SECONDS = 60


def prepare(simulates_in_jax: bool) -> None:
    """Loads jax with the options that our programs expect and its persistent compilation cache.

    Args:
      simulates_in_jax: physics in jax (MJX, brax) will run; on a CPU its threads then run in order.
        Otherwise XLA of jaxlib 0.10 locks up in MJX's Humanoid (all threads idle, for ever), from
        64 environments on. This costs other programs 5 to 10 %, and must precede the first
        computation. A user's own XLA_FLAGS are kept.
    Raises:
      UsageError: jax cannot start with an environment variable or a limit of the shell.
    """
    if "jax" not in sys.modules:
        machine.check_limits()
        _check_flags()
    jax = _load()
    for name, value in SETTLED.items():
        if name.upper() in os.environ and name in jax.config.values:
            jax.config.update(name, value)
    _settle_cache(jax)
    flags = os.environ.get("XLA_FLAGS", "")
    if simulates_in_jax and IN_ORDER.split("=")[0] not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {IN_ORDER}".strip()


def start(simulates_in_jax: bool) -> None:
    """Calls `prepare` and `check_devices`, for a process that computes alone."""
    prepare(simulates_in_jax)
    check_devices()


def check_devices() -> None:
    """Starts jax's backend; several processes must call `hosts.join` before.

    Raises:
      UsageError: there is no device, or none of the kind that an environment variable names.
    """
    import jax
    import jax.numpy as jnp

    try:
        jax.devices()
        jnp.zeros(()).block_until_ready()
    except Exception as error:  # its class depends on what is missing
        said = _first_line(error).split(" (set JAX_PLATFORMS")[0]
        reason = f" ({said})" if str(error) else ""
        for variable in ("JAX_PLATFORMS", "JAX_DEFAULT_DEVICE"):
            wanted = os.environ.get(variable)
            if wanted:
                raise UsageError(
                    f"{variable} is '{wanted}', but jax finds no such device here{reason}: "
                    f"unset it, or set it to cpu."
                ) from None
        raise UsageError(f"jax finds no device here{reason}.") from None


def _load() -> ModuleType:
    try:
        import jax
    except (ValueError, RuntimeError) as error:  # from a variable that jax reads when it is loaded
        raise UsageError(f"jax cannot be loaded: {_first_line(error)}") from None
    return jax


def _check_flags() -> None:
    """Tries the user's XLA_FLAGS in another process, which XLA ends for an unknown flag."""
    flags = os.environ.get("XLA_FLAGS", "").replace(IN_ORDER, "").strip()
    if not flags:
        return
    others = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE],
            env=others | {"JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PROBE_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:  # a busy machine: XLA reads the flags again in this process
        return
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "XLA_FLAGS" in line or "lag" in line]
        reason = f" ({lines[0].split('] ')[-1].strip()})" if lines else ""
        raise UsageError(
            f"XLA_FLAGS is '{flags}', but XLA cannot start with it{reason}: correct or unset it."
        )


def _settle_cache(jax: ModuleType) -> None:
    """Puts the cache in the user's cache folder unless jax has one; off if it is read-only."""
    if not jax.config.values["jax_enable_compilation_cache"]:  # off, by the user or by us
        return
    folder = jax.config.values["jax_compilation_cache_dir"]
    try:
        if not folder:
            cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            folder = str(cache / "maxent_jax" / "jax")
        if "://" not in folder:
            Path(folder).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: no home directory
        jax.config.update("jax_enable_compilation_cache", False)
        reason = getattr(error, "strerror", None) or error
        print(
            f"note: programs are compiled again at each start, because "
            f"{folder or 'the cache folder'} cannot be written: {reason}.",
            file=sys.stderr,
        )
        return
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
