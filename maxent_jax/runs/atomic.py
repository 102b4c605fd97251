"""Writes files completely or not at all: readers never see half a file. Loads no array library.

A writer fills a temporary file and renames it. No two writers share a temporary file, so of several
processes that write the same file the last one wins.
"""

import contextlib
import csv
import json
import math
import os
import re
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from maxent_jax.errors import SaveError, UsageError

# NAME.xxxxxxxx.tmp.SUFFIX; older releases wrote NAME.tmp.SUFFIX.
_TEMPORARY = re.compile(r"(.+?)(?:\.[0-9a-f]{8})?\.tmp(\.[^.]+)?")


def check_file(path: Path) -> None:
    """Checks that a file can be written, before a computation whose results it will hold.

    Raises:
      UsageError: the path is that of a folder, or its folder cannot be made or written.
    """
    if path.is_dir():
        raise UsageError(f"{path} is a folder: name a file.")
    check_folder(path.parent)


def check_folder(folder: Path) -> None:
    """Makes a folder, and checks that files can be written into it.

    Raises:
      UsageError: the folder cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder {folder}: {error.strerror}.") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UsageError(f"cannot write into {folder}: make it writable, or name another folder.")


def write(path: Path, text: str) -> None:
    """Writes a text file in UTF-8."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a JSON file atomically; numbers that are not finite become null."""
    write(path, json.dumps(jsonable(content), indent=2) + "\n")


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Writes a CSV file with these columns, completely or not at all."""
    with (
        whole_file(path) as temporary,
        open(temporary, "w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def jsonable(value: Any) -> Any:
    """Returns the value in JSON's types: numbers that are not finite become null, paths text."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Context manager: turns a full disk or a missing permission into one sentence.

    Raises:
      SaveError: an OSError occurred inside.
    """
    try:
        yield
    except OSError as error:
        raise SaveError(
            f"cannot write {path}: {error.strerror or error}; what was saved before is intact."
        ) from error


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Context manager: gives a temporary file, which replaces `path` if nothing fails.

    Raises:
      SaveError: the file cannot be written.
    """
    temporary = path.with_name(f"{path.stem}.{uuid.uuid4().hex[:8]}.tmp{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def final_of(name: str) -> str | None:
    """Returns the name that a temporary file of this name will get; None for any other file."""
    found = _TEMPORARY.fullmatch(name)
    return None if found is None else found[1] + (found[2] or "")


def clear(folder: Path, suffix: str) -> None:
    """Removes the temporary files of killed processes; call it where no other process writes."""
    for path in folder.glob(f"*.tmp{suffix}"):
        path.unlink(missing_ok=True)
