"""The settings of a run: their groups, presets, names and checks. Loads no array library."""

from maxent_jax.config.registry import register_method
from maxent_jax.config.settings import (
    DATA_FIELDS,
    DEFAULTS,
    GROUPS,
    Config,
    from_flat,
    preset,
)

__all__ = [
    "DATA_FIELDS",
    "DEFAULTS",
    "GROUPS",
    "Config",
    "from_flat",
    "preset",
    "register_method",
]
