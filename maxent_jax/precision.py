"""The package computes in 32 bits, also where a program has switched jax's 64 bits on."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax

Function = TypeVar("Function", bound=Callable[..., Any])


def in_32_bits(function: Function) -> Function:
    """The function, of which everything is traced without `jax_enable_x64`."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
            return function(*args, **kwargs)
        with jax.enable_x64(False):
            return function(*args, **kwargs)

    return call  # type: ignore[return-value]
