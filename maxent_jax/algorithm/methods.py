"""MaxEnt-H, LA and V: rows of data. The algorithm reads the arrays and knows no method.

The rows are what differs between programs' data; what a method as its authors published it does
otherwise is in presets.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import mixture
from maxent_jax.config import Config
from maxent_jax.config.names import BASELINES, BY_METHOD


class Row(NamedTuple):
    """A method in words, one entry for each choice that the methods differ in."""

    weights: str  # of the archived policies
    refresh_period: int  # steps of all envs between refreshes of the reward; 0: once an iteration
    reference: str  # the states that the reward is measured against
    start: str  # the agent that an iteration starts from


ROWS = {
    "h": Row("geometric", 0, "mixture", "scratch"),
    "la": Row("uniform", 1, "history", "last"),
    "v": Row("uniform", 0, "mixture", "best"),
    "h-official": Row("geometric", 0, "mixture", "scratch"),
    **{name: Row("last", 0, "mixture", "last") for name in BASELINES},
}
STARTS = ("scratch", "last", "best")


class Method(NamedTuple):
    """A method in numbers: part of the state, so that one compiled program runs them all."""

    weights: jax.Array  # [P, P] float32, see mixture.weight_table
    refresh_period: jax.Array  # [] int32, as in Row
    from_history: jax.Array  # [] bool
    start: jax.Array  # [] int32, index into STARTS


def row(config: Config) -> Row:
    """The method's row, with the choices that the config makes itself in their place."""
    chosen = ROWS[config.method]
    return Row(
        weights=chosen.weights if config.weights == "method" else config.weights,
        refresh_period=chosen.refresh_period
        if config.refresh_period == BY_METHOD
        else config.refresh_period,
        reference=chosen.reference if config.reference == "method" else config.reference,
        start=chosen.start if config.start == "method" else config.start,
    )


def make(config: Config) -> Method:
    """The arrays of the config's method."""
    chosen = row(config)
    return Method(
        weights=jnp.asarray(mixture.weight_table(chosen.weights, config.archive_size, config.eta)),
        refresh_period=jnp.asarray(chosen.refresh_period, jnp.int32),
        from_history=jnp.asarray(chosen.reference == "history"),
        start=jnp.asarray(STARTS.index(chosen.start), jnp.int32),
    )
