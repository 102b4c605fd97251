"""Finds a run's checkpoints, and checks that every file of them is what was written.

A checkpoint is sealed by a manifest of SHA-256 sums, which `sha256sum -c` can also read. Loads no
array library.
"""

import hashlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from maxent_jax.errors import CheckpointCorruptError, CheckpointError
from maxent_jax.runs import files

FOLDER, UNFINISHED = "checkpoints", "unfinished-"
ARRAYS = "arrays"
REPLAY = f"{ARRAYS}/rest/"  # and everything else that analysis does not need
MANIFEST = "manifest.sha256"
_NAME = re.compile(r"(\d+)(?:\+(\d+))?")
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def checkpoints(run_directory: Path) -> list[str]:
    """Returns the names of the checkpoints, from the oldest to the latest."""
    found = [_NAME.fullmatch(path.name) for path in (run_directory / FOLDER).glob("*")]
    return [m[0] for m in sorted((m for m in found if m), key=_how_far)]


def complete_iterations(run_directory: Path) -> int:
    """Returns how many iterations were complete at the latest checkpoint; 0 without one."""
    return max((int(name.split("+")[0]) for name in checkpoints(run_directory)), default=0)


def remove(run_directory: Path, name: str) -> None:
    """Removes a checkpoint; no reader, and no later process, finds a part of it."""
    folder = run_directory / FOLDER
    doomed = folder / f"{UNFINISHED}{name}-removed"
    shutil.rmtree(doomed, ignore_errors=True)
    (folder / name).rename(doomed)
    shutil.rmtree(doomed)


def clear_unfinished(run_directory: Path) -> None:
    """Removes what a killed process did not finish writing, or removing."""
    for path in (run_directory / FOLDER).glob(f"{UNFINISHED}*"):
        shutil.rmtree(path)


def find(
    run_directory: Path, whole: bool = True, fallback: bool = False, remedy: str = ""
) -> tuple[str, dict[str, str]]:
    """Finds the latest checkpoint, and compares each of its files with its checksum.

    Args:
      whole: include the replay, which is otherwise not read.
      fallback: skip damaged checkpoints.
      remedy: what the user can do about a damaged one; ends the message, if any.
    Returns:
      Its name, and by name a sentence on each checkpoint that was skipped.
    Raises:
      CheckpointError: the run has no checkpoint.
      CheckpointCorruptError: it is damaged or, with fallback, all are; the message names the file.
    """
    passed_over: dict[str, str] = {}
    for name in reversed(checkpoints(run_directory)):
        damage = next(damages(run_directory, name, whole), None)
        if damage is None:
            return name, passed_over
        if not (run_directory / FOLDER / name).exists():  # its run has continued, and removed it
            return find(run_directory, whole, fallback, remedy)
        sentence = f"checkpoint {name} of {run_directory} is damaged: {damage}"
        if not fallback:
            raise CheckpointCorruptError(f"{sentence}{remedy and '; '}{remedy}.")
        passed_over[name] = f"{sentence}."
    if passed_over:
        raise CheckpointCorruptError(f"{sentence}, and no earlier one is intact.")
    check_any(run_directory)
    return find(run_directory, whole, fallback, remedy)  # one was saved meanwhile


def check_any(run_directory: Path) -> None:
    """Raises CheckpointError if the run has no checkpoint."""
    if not checkpoints(run_directory):
        raise CheckpointError(
            f"{run_directory} holds no complete checkpoint: wait until its run saves one, or "
            f"train it with --resume if it is not running."
        )


def damages(run_directory: Path, name: str, whole: bool = True) -> Iterator[str]:
    """Yields what is wrong with a checkpoint: phrases that begin with a file's name."""
    folder = run_directory / FOLDER / name
    if folder.is_symlink() or folder.parent.is_symlink():
        yield f"{FOLDER}/{name} is a link"
        return
    yield from _damages(folder, () if whole else (REPLAY,))
    copy, original = folder / files.CONFIG, run_directory / files.CONFIG
    if copy.is_file() and original.is_file() and copy.read_bytes() != original.read_bytes():
        yield f"{files.CONFIG} of the run is not the one in the checkpoint"


def seal(folder: Path) -> None:
    """Writes the manifest of all files in the folder, once each of them is on the disk."""
    names = sorted(_names(folder))
    sums = "".join(f"{checksum(folder / name, to_disk=True)}  {name}\n" for name in names)
    manifest = folder / MANIFEST
    manifest.write_text(f"{sums}# {checksum_of(sums)}\n", encoding="utf-8")
    checksum(manifest, to_disk=True)


def checksum(path: Path, to_disk: bool = False) -> str:
    """Returns the SHA-256 of a file; with `to_disk`, forces the file to the disk first."""
    with open(path, "rb") as file:
        if to_disk:
            os.fsync(file.fileno())
        return hashlib.file_digest(file, "sha256").hexdigest()


def checksum_of(text: str) -> str:
    """Returns the SHA-256 of a text in UTF-8."""
    return hashlib.sha256(text.encode()).hexdigest()


def _damages(folder: Path, unread: tuple[str, ...]) -> Iterator[str]:
    expected = _read(folder / MANIFEST)
    if isinstance(expected, str):
        yield f"{MANIFEST} {expected}"
        return
    found = set(_names(folder)) - {MANIFEST}
    for name in sorted(found - expected.keys()):
        yield f"{name} does not belong there"
    for name, written in expected.items():
        path = folder / name
        if name not in found:
            yield f"{name} is missing"
        elif path.is_symlink() or not path.is_file():
            yield f"{name} is not a plain file"
        elif not name.startswith(unread) and not _holds(path, written):
            yield f"{name} is not what was written"


def _holds(path: Path, written: str) -> bool:
    """Whether the file has this checksum; it may have been removed meanwhile."""
    try:
        return checksum(path) == written
    except FileNotFoundError:
        return False


def _names(folder: Path) -> Iterator[str]:
    """Names of all files in the folder, relative to it; links are not followed."""
    for place, folders, plain in os.walk(folder):
        links = [name for name in folders if Path(place, name).is_symlink()]
        for name in plain + links:
            yield Path(place, name).relative_to(folder).as_posix()


def _read(manifest: Path) -> dict[str, str] | str:
    """The sums by name, or what is wrong with the manifest."""
    try:
        sums, own = manifest.read_bytes().decode().split("# ")
    except FileNotFoundError:
        return "is missing"
    except (OSError, ValueError):
        return "is not what was written"
    matches = [_LINE.fullmatch(line) for line in sums.splitlines()]
    if own != f"{checksum_of(sums)}\n" or not all(matches):
        return "is not what was written"
    expected = {match[2]: match[1] for match in matches if match}
    if any(Path(name).is_absolute() or ".." in Path(name).parts for name in expected):
        return "names a file outside its folder"
    return expected


def _how_far(name: re.Match[str]) -> tuple[int, int]:
    iterations, segments = name.groups()
    return int(iterations), -1 if segments is None else int(segments)
