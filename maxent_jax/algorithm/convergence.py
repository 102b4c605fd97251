"""The rule that ends step 4 of Algorithm 1 early, when the reward has stopped rising."""

from collections.abc import Sequence

import numpy as np


def has_plateaued(rewards: Sequence[float], patience: int, tolerance: float) -> bool:
    """Tells whether the reward has stopped rising in the last segments.

    The rule looks at the segments since the lowest one. The reward has a plateau if the mean of the
    last `patience` segments exceeds that of the `patience` segments before them by at most
    `tolerance` times its whole rise. A falling reward, as when a policy first unlearns what it
    knew, is at its lowest and so is not a plateau. A reward that has not moved yet is one, so
    `patience` must be longer than that phase. A constant added to the reward, or a positive factor,
    changes nothing.

    Args:
      rewards: mean unshaped r_t of each segment so far, in order.
      patience: number of segments; 0 switches the rule off.
      tolerance: a share of the rise.
    """
    if patience < 1 or len(rewards) < 2 * patience:
        return False
    since_lowest = np.asarray(rewards[int(np.argmin(rewards)) :], float)
    if len(since_lowest) < 2 * patience:
        return False
    last, before = since_lowest[-patience:], since_lowest[-2 * patience : -patience]
    rise = float(since_lowest.max() - since_lowest[0])
    return bool(last.mean() - before.mean() <= tolerance * rise)
