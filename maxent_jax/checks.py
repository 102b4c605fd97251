"""Checks of arguments: the right type, a value in range, a known name. Loads no array library."""

import difflib
import operator
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from maxent_jax.errors import ConfigError

NUM_SEEDS = 2**31  # from 2^32 on, jax's keys repeat


def check_whole(name: str, value: Any, least: int | None = None) -> int:
    """Returns the value as an int.

    Raises:
      TypeError: the value is not a whole number.
      ValueError: the value is below `least`.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        whole = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {value!r}, but must be a whole number") from None
    if least is not None and whole < least:
        raise ValueError(f"{name} is {value}, but must be at least {least}")
    return whole


def check_seed(name: str, value: Any) -> int:
    """Returns the value as an int.

    Raises:
      TypeError: the value is not a whole number.
      ConfigError: the value is not in [0, NUM_SEEDS).
    """
    seed = check_whole(name, value)
    if not 0 <= seed < NUM_SEEDS:
        raise ConfigError(
            f"{name} is {value}, but must be 0 or more, and below 2^31 = {NUM_SEEDS}."
        )
    return seed


def check_number(name: str, value: Any) -> float:
    """Returns the value as a float.

    Raises:
      TypeError: the value is not a real number.
    """
    try:
        if isinstance(value, str | bytes | bool):
            raise TypeError
        return float(value)
    except (TypeError, OverflowError):
        raise TypeError(f"{name} is {value!r}, but must be a number") from None


def check_path(name: str, value: Any) -> Path:
    """Returns the value as a Path.

    Raises:
      TypeError: the value is neither a string nor a path.
    """
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name} is {value!r}, but must be a string or a pathlib.Path")
    return Path(value)


def check_choice(what: str, value: str, known: Collection[str]) -> None:
    """Raises ConfigError, which names the closest match, unless the value is known."""
    if isinstance(value, str) and value in known:
        return
    shown = f"'{value[:80]}'" if isinstance(value, str) else repr(value)[:80]
    nearest = difflib.get_close_matches(shown.strip("'"), known, n=1, cutoff=0.4)
    hint = f"did you mean '{nearest[0]}'?" if nearest else f"choose one of {', '.join(known)}."
    raise ConfigError(f"unknown {what} {shown}: {hint}")
