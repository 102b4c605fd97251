"""Intrinsic rewards that maximum-state-entropy methods are compared with, one a file."""

from collections.abc import Callable

import jax

from maxent_jax.intrinsic import apt, histogram, icm, kmeans, ngu, re3, rise, rnd, vcse
from maxent_jax.intrinsic.protocol import Bonus, Episodic, Setting, Steps

__all__ = ["NAMES", "Bonus", "Episodic", "Setting", "Steps", "make"]

_MAKERS: dict[str, Callable[[Setting], Bonus]] = {
    "rnd": rnd.make,
    "icm": icm.make,
    "ngu": ngu.make,
    "re3": re3.make,
    "rise": rise.make,
    "renyi": rise.make_renyi,
    "vcse": vcse.make,
    "kmeans": kmeans.make,
    "apt": apt.make,
    "histogram": histogram.make,
}
NAMES = tuple(_MAKERS)


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
      name: one of NAMES.
      observation_size, action_size: D and A.
      scale: [D] positive, what counts as 1 of each observation: networks and distances see
        observation / scale.
      learning_rate: of Adam, where a method learns by gradients.
      num_cells: of the grid on which coverage is counted.
    Raises:
      ValueError: an unknown name, or a scale that is not [D].
    """
    if name not in _MAKERS:
        raise ValueError(f"unknown bonus '{name}': choose one of {', '.join(NAMES)}")
    if scale.shape != (observation_size,):
        raise ValueError(f"scale has shape {scale.shape}, but must be ({observation_size},)")
    return _MAKERS[name](Setting(observation_size, action_size, scale, learning_rate, num_cells))
