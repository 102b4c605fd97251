"""Results that take long to compute: computed once, then read from their file."""

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from maxent_jax.runs import atomic, files


def once(
    path: Path, asked: Mapping[str, Any], compute: Callable[[], dict[str, Any]]
) -> dict[str, Any]:
    """Returns what `compute` gives, from the file if it holds the results of the same request.

    Args:
      path: JSON file for the request and its results; replaced if it is damaged, or if it holds
        the results of another request.
      asked: on what the results depend.
      compute: returns the results by name, other names than those of `asked`.
    Returns:
      The results in JSON's types.
    """
    wanted = atomic.jsonable(dict(asked))
    with contextlib.suppress(OSError, ValueError, AttributeError):  # no file yet, or a damaged one
        held = json.loads(path.read_text(encoding="utf-8"))
        if {name: held.get(name) for name in wanted} == wanted:
            return held
    found = atomic.jsonable(compute())
    atomic.write_json(path, wanted | {"versions": files.stack()} | found)
    return found
