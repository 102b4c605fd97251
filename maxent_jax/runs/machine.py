"""What the machine, the container and the shell allow this process. Loads no jax."""

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from maxent_jax.errors import UsageError

CGROUPS = Path("/sys/fs/cgroup")
# Without enough threads or memory, XLA ends the process without a helpful message.
LEAST_ADDRESS_SPACE = 3 * 2**30  # bytes; 2.1 GiB was too little for preset smoke on two cores
LEAST_FILES = 128  # open at once; with 24, Orbax fails to save, with a traceback
THREADS_PER_CORE, MORE_THREADS = 4, 16


class Room(NamedTuple):
    """An amount of memory, and what it belongs to."""

    size: int  # bytes
    of: str  # what it belongs to, in words


def memory() -> Room:
    """Returns the memory that this process may use."""
    return min(_limits(), key=lambda room: room.size)


def readable(size: float) -> str:
    """Formats a number of bytes in the largest unit that fits."""
    units = ["bytes", "KiB", "MiB", "GiB", "TiB", "PiB"]
    while size >= 1024 and len(units) > 1:
        size /= 1024
        units.pop(0)
    return f"{size:,.0f} {units[0]}" if size >= 100 else f"{size:.3g} {units[0]}"


def check_limits() -> None:
    """Checks that jax can start.

    Raises:
      UsageError: a limit of the shell or the container is too low.
    """
    limit = address_space()
    if limit and limit < LEAST_ADDRESS_SPACE:
        raise UsageError(
            f"this process may have {readable(limit)} of address space (ulimit -v), but jax needs "
            f"{readable(LEAST_ADDRESS_SPACE)}: raise the limit."
        )
    files = _limit("RLIMIT_NOFILE")
    if files and files < LEAST_FILES:
        raise UsageError(
            f"this process may open {files} files (ulimit -n), but saving and loading runs needs "
            f"{LEAST_FILES}: raise the limit."
        )
    num_threads = THREADS_PER_CORE * (os.cpu_count() or 1) + MORE_THREADS
    if not _can_start(num_threads):
        raise UsageError(
            f"this process cannot start {num_threads} threads, which jax needs: raise the limit "
            f"(ulimit -u, or the container's)."
        )


def address_space() -> int | None:
    """Returns `ulimit -v` in bytes; None if there is no limit."""
    return _limit("RLIMIT_AS")


def _limit(name: str) -> int | None:
    try:
        import resource

        limit, _ = resource.getrlimit(getattr(resource, name))
    except (ImportError, AttributeError, OSError):
        return None
    return None if limit == resource.RLIM_INFINITY else limit


def _can_start(num_threads: int) -> bool:
    end = threading.Event()
    started = []
    try:
        for _ in range(num_threads):
            thread = threading.Thread(target=end.wait, daemon=True)
            thread.start()
            started.append(thread)
    except RuntimeError:
        return False
    finally:
        end.set()
        for thread in started:
            thread.join()
    return True


def _limits() -> Iterator[Room]:
    try:
        yield Room(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), "this machine")
    except (AttributeError, ValueError, OSError):  # unknown to this system
        yield Room(2**63, "this machine")
    for path in _cgroup_files():
        try:
            yield Room(int(path.read_text(encoding="ascii")), "this container")
        except (OSError, ValueError):  # no such file; or "max", no limit
            continue
    yield from _process_limits()


def _cgroup_files() -> Iterator[Path]:
    """Where Linux keeps the limits of this process's control groups, of versions 2 and 1."""
    try:
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = CGROUPS / "memory" if controllers else CGROUPS
        group = root / name.lstrip("/")
        for folder in (group, *group.parents):
            yield folder / ("memory.limit_in_bytes" if controllers else "memory.max")
            if folder == root:
                break


def _process_limits() -> Iterator[Room]:
    """`ulimit -v` minus what the process already uses."""
    try:
        if limit := address_space():
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            used = pages * os.sysconf("SC_PAGE_SIZE")
            yield Room(max(limit - used, 0), "this process (ulimit -v)")
    except (OSError, ValueError):
        return
