"""Makes the package compute in 32 bits, even in a program that enables jax's 64 bits."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

Function = TypeVar("Function", bound=Callable[..., Any])


def in_32_bits(function: Function) -> Function:
    """Wraps a function so that all of it is traced without `jax_enable_x64`."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return call  # type: ignore[return-value]
