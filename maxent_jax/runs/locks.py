"""Admits one process at a time to a directory. The system frees the lock of a dead process."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import filelock

from maxent_jax.errors import UsageError
from maxent_jax.runs import atomic

LOCK = "lock"


class BusyError(UsageError):
    """Another process holds the directory's lock."""


@contextlib.contextmanager
def holding(directory: Path, wait: bool = True) -> Iterator[None]:
    """Context manager: makes a directory and locks it against other processes.

    Args:
      wait: wait for another process that holds the lock.
    Raises:
      BusyError: another process holds the lock, and `wait` is false.
      UsageError: the directory cannot be written.
    """
    lock = filelock.FileLock(directory / LOCK, timeout=-1 if wait else 0)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        raise BusyError(
            f"another process writes in {directory}: wait until it ends, or choose another --out."
        ) from None
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}.") from None
    try:
        yield
    finally:
        lock.release()


def is_free(directory: Path, first: str) -> bool:
    """Whether a directory holds only its lock and an unfinished `first`, the first file written."""
    names = [path.name for path in directory.iterdir()]
    return all(name == LOCK or atomic.final_of(name) == first for name in names)
