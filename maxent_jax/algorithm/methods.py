"""A method as arrays: the algorithm reads these and knows no method by name.

The methods are the rows of `config.registry.METHODS`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import mixture
from maxent_jax.config import Config, registry
from maxent_jax.config.registry import BY_METHOD, STARTS, MethodRow


class Method(NamedTuple):
    """A method in numbers, part of the state, so that one compiled program runs every method."""

    weights: jax.Array  # [P, P] float32, see mixture.weight_table
    refresh_period: jax.Array  # [] int32, as in MethodRow
    from_history: jax.Array  # [] bool
    start: jax.Array  # [] int32, index into STARTS


def row(config: Config) -> MethodRow:
    """Returns the method's row, with the config's own choices where it makes any."""
    of_method, own = registry.method(config.method), config.mixture
    period = own.refresh_period
    return MethodRow(
        weights=of_method.weights if own.weights == "method" else own.weights,
        refresh_period=of_method.refresh_period if period == BY_METHOD else period,
        reference=of_method.reference if own.reference == "method" else own.reference,
        start=of_method.start if own.start == "method" else own.start,
    )


def make(config: Config) -> Method:
    """Returns the config's method as arrays."""
    chosen = row(config)
    return Method(
        weights=jnp.asarray(
            mixture.weight_table(chosen.weights, config.archive_size, config.mixture.eta)
        ),
        refresh_period=jnp.asarray(chosen.refresh_period, jnp.int32),
        from_history=jnp.asarray(chosen.reference == "history"),
        start=jnp.asarray(STARTS.index(chosen.start), jnp.int32),
    )
