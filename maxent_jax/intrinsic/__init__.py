"""Bonuses: intrinsic rewards of the methods that this package compares with, one in each file."""

from collections.abc import Callable

import jax

from maxent_jax.config import registry
from maxent_jax.config.registry import BonusRow, resolve
from maxent_jax.errors import ConfigTypeError
from maxent_jax.intrinsic.protocol import HIDDEN_SIZE, Bonus, Episodic, Setting, Steps

__all__ = ["Bonus", "Episodic", "Setting", "Steps", "make", "register"]


def register(name: str, make: Callable[[Setting], Bonus], num_neighbors: int = 0) -> None:
    """Registers a user's bonus as `user:NAME`, and a method of that name that uses it as reward.

    Args:
      name: NAME.
      make: Setting -> Bonus.
      num_neighbors: k of a bonus that compares the states of a batch; a batch must be larger.
    Raises:
      ConfigError: the name is already in use in this process.
      ConfigTypeError (a ValueError and a TypeError): an argument has the wrong type or form.
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
    state_size: int = 0,
    skill_size: int = 0,
    hidden_size: int = HIDDEN_SIZE,
) -> Bonus:
    """Makes the bonus of a name.

    Args:
      name: a row of config.registry.BONUSES.
      observation_size: D.
      action_size: A.
      scale: [D] positive, the unit of each entry: networks and distances see observation / scale.
      learning_rate: of Adam, if the bonus learns by gradients.
      num_cells: of the grid on which coverage is counted.
      state_size: I, of what the networks see without the skill.
      skill_size: Z.
      hidden_size: of the actor and the critics.
    Raises:
      ValueError: the name is unknown, or the scale is not [D].
    """
    row = registry.bonus(name)
    if scale.shape != (observation_size,):
        raise ValueError(f"scale has shape {scale.shape}, but must be ({observation_size},)")
    return resolve(row.make)(
        Setting(
            *(observation_size, action_size, scale, learning_rate, num_cells),
            *(state_size, skill_size, hidden_size),
        )
    )
