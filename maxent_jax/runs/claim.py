"""A run's claim to its directory: may it begin or continue there? Loads no array library."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from maxent_jax.config import Config
from maxent_jax.errors import UsageError
from maxent_jax.runs import atomic, files, integrity, locks
from maxent_jax.runs.loggers import FOLDERS as LOGGERS


class Claim(NamedTuple):
    """What a run asks of its directory."""

    directory: Path
    config: Config
    resume: bool = False  # the directory may hold this very run
    overwrite: bool = False  # the directory may hold any run, which is removed

    def check(self) -> None:
        """Checks that the directory is free, or holds a run that may be resumed or overwritten.

        A directory is free if it does not exist, or holds only what a run writes before its first
        checkpoint.

        Raises:
          UsageError, RunError: the directory cannot be used.
        """
        directory = self.directory
        try:
            _check_writable(directory)
            if not directory.exists() or (directory.is_dir() and _is_free(directory)):
                return
        except OSError as error:
            raise UsageError(f"cannot write to {directory}: {error.strerror}.") from None
        if self.resume:
            files.check_config(directory, self.config)
            files.check_resumable(directory)
        elif not self.overwrite:
            raise UsageError(
                f"{directory} already exists: choose another directory, or continue it (--resume) "
                f"or start again in it (--overwrite)."
            )
        elif not files.is_config(directory / files.CONFIG):
            raise UsageError(
                f"{directory} is not the directory of a run, so it is left alone: choose another "
                f"--out."
            )

    @contextlib.contextmanager
    def hold(self) -> Iterator[None]:
        """Context manager: makes the directory and locks it against other processes.

        Raises:
          BusyError: another process trains in it.
          UsageError, RunError: see `check`; or the directory cannot be made.
        """
        self.check()
        with locks.holding(self.directory, wait=False):
            self.check()  # again: another process may have been here meanwhile
            if self.overwrite:
                _remove_run(self.directory)
            yield


def _check_writable(directory: Path) -> None:
    """Raises UsageError if the directory cannot be made, or cannot be written."""
    place = next(p for p in (directory, *directory.absolute().parents) if os.path.lexists(p))
    try:
        str(directory.absolute()).encode()
    except UnicodeEncodeError:  # TensorStore does not accept such bytes
        raise UsageError(f"cannot write to {directory}: its path must be UTF-8.") from None
    if place.is_symlink() and not place.exists():
        raise UsageError(f"cannot write to {directory}: {place} is a broken link.")
    if not place.is_dir() and place != directory:
        raise UsageError(f"cannot write to {directory}: {place} is not a directory.")
    if place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
        raise UsageError(f"cannot write to {directory}: {place} is not writable.")


def _is_free(directory: Path) -> bool:
    """Whether it holds only what a run leaves that ended before its first checkpoint."""
    if integrity.checkpoints(directory):
        return False
    return all(_precedes_checkpoints(path) for path in directory.iterdir())


def _precedes_checkpoints(path: Path) -> bool:
    directory = path.parent
    if path.name == files.CONFIG and path.is_file():
        return files.is_config(path)
    if path.name == files.METRICS:
        return path.is_file() and path.stat().st_size == 0
    if path.name == integrity.FOLDER:
        unfinished = path.is_dir() and all(
            inside.name.startswith(integrity.UNFINISHED) for inside in path.iterdir()
        )
        return unfinished and not path.is_symlink()
    if path.name in (*LOGGERS, files.FIRST):
        return (directory / files.CONFIG).is_file()
    return path.name == locks.LOCK or atomic.final_of(path.name) in (files.CONFIG, files.METRICS)


def _remove_run(directory: Path) -> None:
    """Removes all that a run writes, and nothing else.

    The config goes last: without it, a removal that was interrupted could not be repeated.
    """
    written = [path for path in directory.iterdir() if files.is_written(path.name)]
    for path in sorted(written, key=lambda path: path.name == files.CONFIG):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
