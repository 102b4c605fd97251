"""Compares every file of a run's checkpoints with its checksum.

Prints one line per checkpoint and one per damage; the exit code is 1 if there is any damage.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from maxent_jax.commands import cli
from maxent_jax.runs import files, integrity


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Verify the checkpoints of a run."""

    directory: Annotated[Path, tyro.conf.Positional]
    """The run's directory."""


def main(argv: Sequence[str]) -> None:
    """Parses the arguments and verifies; loads no array library."""
    directory = cli.parse(Arguments, argv, "verify").directory
    files.read_config(directory)
    integrity.check_any(directory)
    if not verify(directory, integrity.checkpoints(directory)):
        sys.exit(1)


def verify(directory: Path, names: Sequence[str]) -> bool:
    """Prints a line about each checkpoint; returns whether all are intact."""
    intact = True
    for name in names:
        damages = list(integrity.damages(directory, name))
        folder = directory / integrity.FOLDER / name
        try:
            sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
        except FileNotFoundError:
            sizes = []
        if not folder.exists():
            print(f"checkpoint {name}: removed meanwhile, because its run has continued")
            continue
        intact &= not damages
        print(
            f"checkpoint {name}: {'damaged' if damages else 'intact'}, "
            f"{len(sizes)} files, {sum(sizes) / 1e6:,.1f} MB"
        )
        for damage in damages:
            print(f"  {damage}")
    return intact
