"""What all benchmarks share: flags, timing and printing."""

import argparse
import importlib
import importlib.metadata
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax

from maxent_jax import native

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy")
CORES = os.cpu_count() or 1
REPEATS = 5


class Peer(NamedTuple):
    """Another library that answers the same question; not a dependency of this package."""

    distribution: str
    module: str
    measure: Callable  # takes the imported module first


def parser(description: str | None) -> argparse.ArgumentParser:
    """Returns the parser with the flags that benchmarks share."""
    flags = argparse.ArgumentParser(description=description)
    flags.add_argument("--toy", action="store_true", help="check that it runs, with tiny sizes")
    flags.add_argument(
        "--repeats", type=positive, default=REPEATS, help="measurements, of which the median counts"
    )
    return flags


def positive(word: str) -> int:
    """Returns the value of a flag that must be a whole number of at least 1."""
    if not word.isdecimal() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"is {word}, but must be a whole number of at least 1")
    return int(word)


def print_versions(peers: Iterable[Peer] = ()) -> None:
    """Prints the first line of every benchmark: the versions and the machine."""
    versions = " ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    for peer in peers:
        try:
            versions += f" {peer.distribution} {importlib.metadata.version(peer.distribution)}"
        except importlib.metadata.PackageNotFoundError:
            continue
    device = jax.devices()[0]
    print(
        f"# python {platform.python_version()} {versions} | {device.platform} "
        f"{device.device_kind}, {CORES} CPU cores ({_processor()}), native build "
        f"{native.variant()}",
        flush=True,
    )


def _processor() -> str:
    """The processor's name, if Linux gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def importable(peers: Iterable[Peer]) -> list[tuple[Peer, ModuleType]]:
    """Returns the peers that can be imported; names the others in one line on standard error."""
    found, absent = [], []
    for peer in peers:
        try:
            found.append((peer, importlib.import_module(peer.module)))
        except Exception as error:  # a broken installation may raise anything
            absent.append(f"{peer.distribution} ({sentence(error)})")
    if absent:
        print("not measured: " + "; ".join(absent), file=sys.stderr)
    return found


def measured(peer: Peer, measure: Callable, *args: Any) -> Any:
    """Returns the peer's measurement; if it fails, None, and one line on standard error."""
    try:
        return measure(*args)
    except Exception as error:  # a peer that fails loses its own row and no other
        print(f"not measured: {peer.distribution} ({sentence(error)})", file=sys.stderr)
        return None


def sentence(error: Exception) -> str:
    """Returns the class and the first line of an exception."""
    return f"{type(error).__name__}: {error}".splitlines()[0]


def compiled(function: Callable, *args: Any) -> tuple[Callable, float]:
    """Compiles the function for arguments like these; returns it and the seconds that this took."""
    started = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    return program, time.perf_counter() - started


def median_seconds(call: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Returns the median time of a call that returns arrays, after one call to warm up."""
    jax.block_until_ready(call())
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def continued_seconds(
    program: Callable[[Any], tuple[Any, Any]], state: Any, repeats: int = REPEATS
) -> tuple[float, Any]:
    """Returns the median time of a program, each call of which continues the last; and its state.

    For programs that donate their state: nothing is copied.
    """
    held = [state]

    def call():
        held[0], more = program(held[0])
        return held[0], more

    return median_seconds(call, repeats), held[0]


def progress(row: dict[str, Any]) -> None:
    """Prints the row's values on standard error."""
    print(
        " ".join(f"{name}={value}" for name, value in rounded(row).items()),
        file=sys.stderr,
        flush=True,
    )


def emit(row: dict[str, Any]) -> None:
    """Prints a row as a JSON line; if standard output is no terminal, on standard error too."""
    print(json.dumps(rounded(row)), flush=True)
    if not sys.stdout.isatty():
        progress(row)


def rounded(row: dict[str, Any]) -> dict[str, Any]:
    """Returns the row with numbers rounded to four significant digits."""
    return {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in row.items()}
