"""Imports a user's modules, which register environments, bonuses, methods and tasks.

Loads no array library; a user's module may.
"""

import hashlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from maxent_jax.errors import UsageError

imported: list[str] = []
"""The modules that `import_modules` imported, as the user named them."""


def import_modules(modules: Sequence[str]) -> None:
    """Imports modules by name or by the path of a .py file.

    Raises:
      UsageError: a module does not exist, or fails.
    """
    for name in modules:
        try:
            if name.endswith(".py"):
                _import_file(Path(name))
            else:
                _import_by_name(name)
        except Exception as error:
            raise UsageError(
                f"import is '{name}', but it cannot be imported: {type(error).__name__}: {error}."
            ) from error
        if name not in imported:
            imported.append(name)


def _import_by_name(name: str) -> None:
    if "" not in sys.path and str(Path.cwd()) not in sys.path:  # as with python -m
        sys.path.insert(0, str(Path.cwd()))
    importlib.import_module(name)


def _import_file(path: Path) -> None:
    """Imports a file under a name that no other module has: it may be called random.py."""
    path = path.resolve()
    digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:16]
    name = f"_imported_{path.stem.replace('.', '_')}_{digest}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError("no such file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # a dataclass looks its module up there
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
