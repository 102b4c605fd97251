"""Gradient descent on a loss."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import optax

from maxent_jax.types import Metrics


class Learned(NamedTuple):
    """Parameters, and the state of their optimiser."""

    parameters: Any
    optimizer: Any


def begin(optimizer: optax.GradientTransformation, parameters: Any) -> Learned:
    """Returns the parameters with a fresh optimiser."""
    return Learned(parameters, optimizer.init(parameters))


def descend(
    optimizer: optax.GradientTransformation,
    learned: Learned,
    loss: Callable[[Any], tuple[jax.Array, Metrics]],
) -> tuple[Learned, Metrics]:
    """Takes one step down the gradient of `loss`, which returns a loss [] and metrics."""
    gradient, metrics = jax.grad(loss, has_aux=True)(learned.parameters)
    step, optimizer_state = optimizer.update(gradient, learned.optimizer, learned.parameters)
    return Learned(optax.apply_updates(learned.parameters, step), optimizer_state), metrics
