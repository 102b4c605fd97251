"""Exploration by maximum state entropy, on accelerators. See README.md for an overview.

Importing the package loads no array library, so a command line can reject bad input at once.
`load_run`, `train` and the modules load it when they are used.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maxent_jax.analysis import Run, load_run
    from maxent_jax.config import Config, preset
    from maxent_jax.training import train

__version__ = "0.1.0"
__all__ = ["Config", "Run", "load_run", "preset", "train"]
_MODULES = {
    "Config": "config",
    "Run": "analysis",
    "load_run": "analysis",
    "preset": "config",
    "train": "training",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"maxent_jax.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'maxent_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
