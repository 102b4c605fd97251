"""Bonuses: intrinsic rewards of the methods that this package compares with, one in each file."""

from collections.abc import Callable

from maxent_jax.config import registry
from maxent_jax.config.registry import BonusRow, resolve
from maxent_jax.errors import ConfigTypeError
from maxent_jax.intrinsic.protocol import Bonus, Episodic, Setting, Steps

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


def make(name: str, setting: Setting) -> Bonus:
    """Makes the bonus of a name.

    Args:
      name: a row of config.registry.BONUSES.
      setting: the sizes and units of the run.
    Raises:
      ValueError: the name is unknown, or the scale is not [F].
    """
    row = registry.bonus(name)
    size = setting.num_features
    if setting.scale.shape != (size,):
        raise ValueError(f"scale has shape {setting.scale.shape}, but must be ({size},)")
    return resolve(row.make)(setting)
