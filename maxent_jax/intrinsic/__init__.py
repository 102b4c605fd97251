"""Intrinsic rewards that maximum-state-entropy methods are compared with, one a file."""

from collections.abc import Callable

import jax

from maxent_jax.config import registry
from maxent_jax.config.registry import BonusRow, resolve
from maxent_jax.errors import ConfigTypeError
from maxent_jax.intrinsic.protocol import Bonus, Episodic, Setting, Steps

__all__ = ["Bonus", "Episodic", "Setting", "Steps", "make", "register"]


def register(name: str, make: Callable[[Setting], Bonus], num_neighbors: int = 0) -> None:
    """Makes a bonus of the user's known as `user:NAME`, and a method of that name which it pays.

    Args:
      make: the functions of the bonus, for what it is made from.
      num_neighbors: k, where it compares the states of a batch, which must then hold more.
    Raises:
      ConfigTypeError (a ValueError and a TypeError): an argument that is no such thing.
    """
    registry.check_name("bonus", name)
    if not callable(make):
        raise ConfigTypeError(f"make is {make!r}, but must be a function that makes a Bonus.")
    registry.register_bonus(name, BonusRow(make, num_neighbors))


def make(
    name: str,
    observation_size: int,
    action_size: int,
    scale: jax.Array,
    learning_rate: float,
    num_cells: int,
) -> Bonus:
    """The bonus of that name.

    Args:
      name: a row of config.registry.BONUSES.
      observation_size, action_size: D and A.
      scale: [D] positive, what counts as 1 of each observation: networks and distances see
        observation / scale.
      learning_rate: of Adam, where a method learns by gradients.
      num_cells: of the grid on which coverage is counted.
    Raises:
      ValueError: an unknown name, or a scale that is not [D].
    """
    row = registry.bonus(name)
    if scale.shape != (observation_size,):
        raise ValueError(f"scale has shape {scale.shape}, but must be ({observation_size},)")
    return resolve(row.make)(
        Setting(observation_size, action_size, scale, learning_rate, num_cells)
    )
