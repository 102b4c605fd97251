"""Errors that a user can see. Each message is one sentence: what is wrong, and what to do.

Loads no array library.
"""


class UsageError(ValueError):
    """A command line asks for something impossible."""


class ConfigError(ValueError):
    """A setting has an invalid value."""


class ConfigTypeError(ConfigError, TypeError):
    """A setting has the wrong type, or does not exist."""


class RunError(ValueError):
    """A directory does not hold the expected run."""


class CheckpointError(RunError):
    """A run has no checkpoint that can be loaded."""


class CheckpointCorruptError(CheckpointError):
    """A checkpoint differs from what was written."""


class SaveError(RuntimeError):
    """A file could not be written; everything saved before it is intact."""


class NonFiniteError(RuntimeError):
    """Training produced a number that is not finite; that state was not saved."""
