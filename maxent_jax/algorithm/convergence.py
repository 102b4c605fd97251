"""Is a policy trained? The rule that ends step 4 of Algorithm 1 before its budget is spent."""

from collections.abc import Sequence

import numpy as np


def has_plateaued(rewards: Sequence[float], patience: int, tolerance: float) -> bool:
    """Whether the reward of the last segments has stopped rising.

    It has when, since its lowest segment, the mean of the last `patience` segments lies above that
    of the `patience` before them by at most `tolerance` of all that the reward rose. A reward that
    falls, as where a policy first unlearns what it knew, is at its lowest: that is no plateau. One
    that has not moved yet is one, so patience must outlast the wait. Adding a constant to the
    reward, or scaling it, changes nothing.

    Args:
      rewards: mean unshaped r_t of each segment so far, in order.
      patience: segments; 0 switches the rule off.
      tolerance: a share.
    """
    if patience < 1 or len(rewards) < 2 * patience:
        return False
    since_lowest = np.asarray(rewards[int(np.argmin(rewards)) :], float)
    if len(since_lowest) < 2 * patience:
        return False
    last, before = since_lowest[-patience:], since_lowest[-2 * patience : -patience]
    rise = float(since_lowest.max() - since_lowest[0])
    return bool(last.mean() - before.mean() <= tolerance * rise)
