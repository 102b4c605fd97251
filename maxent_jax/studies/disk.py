"""A study on disk: whose directory it is, where each cell's run is, and which are finished.

Loads no array library.
"""

import json
from pathlib import Path
from typing import Any

from maxent_jax.config import DEFAULTS, Config
from maxent_jax.errors import UsageError
from maxent_jax.runs import atomic, files, integrity, locks
from maxent_jax.studies.protocol import Cell

STUDY = "study.json"
VERSION = 1  # of the layout of a study's directory

Content = dict[str, Any]


def claim(directory: Path, study: str, scale: str, cells: list[Cell]) -> None:
    """Makes the study's directory, or checks that it belongs to this study; seeds may be added.

    Raises:
      UsageError: the directory holds another study, or this one with other settings, or cannot be
        written.
    """
    content = atomic.jsonable(
        {
            "version": VERSION,
            "study": study,
            "scale": scale,
            "cells": {cell.name: cell.config.flat() for cell in cells},
        }
    )
    with locks.holding(directory):
        _claim(directory, content)


def _claim(directory: Path, content: Content) -> None:
    path = directory / STUDY
    if path.exists():
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
            differs = _difference(held, content)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            differs = f"its {STUDY} cannot be read"
        if differs:
            raise UsageError(f"{directory} holds another study: {differs}; choose another --out.")
        content["cells"] = held["cells"] | content["cells"]
        if content == held:
            return
    elif not locks.is_free(directory, STUDY):
        raise UsageError(f"{directory} is not a study's, and not empty: choose another --out.")
    atomic.write_json(path, content)


def _difference(held: Content, asked: Content) -> str:
    for what in ("version", "study", "scale"):
        if held[what] != asked[what]:
            return f"{what} is {held[what]}, not {asked[what]}"
    for name, config in asked["cells"].items():
        if name not in held["cells"]:
            continue
        for field, value in config.items():
            was = held["cells"][name].get(field, DEFAULTS[field])
            if was != value:
                return f"in {name}, {field} was {was} and is {value}"
    return ""


def home(directory: Path, cell: Cell) -> Path:
    """Returns the directory of the cell's run.

    If the cell has no directory yet, this may be that of an equal run, of this study or of another
    in the same folder, under any name.
    """
    own = directory / cell.name
    if not own.exists() and cell.source is None:
        config = atomic.jsonable(cell.config.flat())
        for study in sorted(directory.parent.glob(f"*/{STUDY}")):
            for name, held in _cells(study).items():
                if held == config and (study.parent / name).exists():
                    return study.parent / name
    return own


def _cells(study: Path) -> dict[str, Content]:
    try:
        held = json.loads(study.read_text(encoding="utf-8"))
        return dict(held["cells"]) if held["version"] == VERSION else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def config_of(directory: Path, cell: Cell) -> Config:
    """Returns the config of the cell's run, with the directory of the cell that it starts from."""
    if cell.source is None:
        return cell.config
    begun = home(directory, cell)
    if integrity.checkpoints(begun):  # wherever the study lay when the run began
        at = files.read_config(begun).downstream.source
    else:
        at = str(home(directory, cell.source))
    return cell.config.replace(source=at)


def finished(directory: Path, cell: Cell) -> bool:
    """Tells whether the cell's run is complete and saved.

    Raises:
      RunError: the directory holds a run with other settings.
    """
    at = home(directory, cell)
    if integrity.checkpoints(at)[-1:] != [f"{cell.config.budget.num_iterations}"]:
        return False
    files.check_config(at, config_of(directory, cell))
    return True
