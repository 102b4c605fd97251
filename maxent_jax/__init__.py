"""Exploration by maximum state entropy, on accelerators. See README.md for an overview.

Importing the package loads no array library, so a command line can reject bad input at once.
`load_run`, `train` and the modules load it when they are used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maxent_jax.analysis import Run, load_run
    from maxent_jax.commands.train import train

__version__ = "0.1.0"
__all__ = ["Run", "load_run", "train"]


def __getattr__(name: str) -> Any:
    if name == "train":
        from maxent_jax.commands.train import train

        return train
    if name in __all__:
        from maxent_jax import analysis

        return getattr(analysis, name)
    raise AttributeError(f"module 'maxent_jax' has no attribute '{name}'")
