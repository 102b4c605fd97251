"""One process at a time in a directory. The system frees the lock of a process that died."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import filelock

from maxent_jax.errors import UsageError
from maxent_jax.runs import files

LOCK = "lock"


class BusyError(UsageError):
    """Another process is in the directory."""


@contextlib.contextmanager
def holding(directory: Path, wait: bool = True) -> Iterator[None]:
    """Makes a directory, and keeps other processes out of it while inside.

    Args:
      wait: for a process that is inside.
    Raises:
      BusyError: another is inside, and is not waited for.
      UsageError: it cannot be written.
    """
    lock = filelock.FileLock(directory / LOCK, timeout=-1 if wait else 0)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        raise BusyError(f"another process is training in {directory}.") from None
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}.") from None
    try:
        yield
    finally:
        lock.release()


def is_free(directory: Path, first: str) -> bool:
    """Whether a directory holds nothing but its lock and what a killed process left of the file of
    that name, the first that is written.
    """
    begun = (LOCK, files.temporary_of(directory / first).name)
    return all(path.name in begun for path in directory.iterdir())
