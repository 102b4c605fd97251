"""The settings of a run: their groups, presets, names and checks. Loads no array library."""

from maxent_jax.config.settings import DATA_FIELDS, DEFAULTS, Config, preset

__all__ = ["DATA_FIELDS", "DEFAULTS", "Config", "preset"]
