"""Statistics of a few seeds: interquartile mean, bootstrap interval, probability of improvement.

Scores are lists of arrays: for each task one array with an entry per seed.

Source: Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice",
arXiv 2108.13264.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from scipy import stats

Scores = Sequence[np.ndarray]
RESAMPLES = 2000
CONFIDENCE = 0.95
EXACT: Final = "inverted_cdf"  # takes values that occur; interpolation would fail at -inf


def interquartile_mean(scores: Scores) -> np.ndarray:
    """Returns the mean of the middle half of all runs of all tasks, over the last axis.

    All tasks have the same unit. With four or more runs a single run cannot move it far; with three
    it is their mean.
    """
    return stats.trim_mean(np.concatenate(scores, axis=-1), 0.25, axis=-1)


def probability_of_improvement(ours: Scores, theirs: Scores) -> np.ndarray:
    """Returns the probability that a run of ours beats one of theirs on the same task.

    Ties count half. Runs are along the last axis.

    Raises:
      ValueError: the numbers of tasks differ.
    """
    pairs = ((x[..., :, None], y[..., None, :]) for x, y in zip(ours, theirs, strict=True))
    of_tasks = [np.mean((x > y) + 0.5 * (x == y), axis=(-2, -1)) for x, y in pairs]
    return np.mean(of_tasks, axis=0)


def interval(
    statistic: Callable[..., np.ndarray],
    *scores: Scores,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> tuple[float, float]:
    """Returns the 95 % percentile interval of a statistic by stratified bootstrap.

    The seeds of each task are resampled with replacement, separately in each of the scores. The
    tasks stay the same.

    Args:
      statistic: a function of the scores, over the last axis of arrays [resamples, seeds].
      scores: not empty. With one seed per task the interval is a point and meaningless; with three
        it contains the mean of normal values three times in four.
    Raises:
      ValueError: a task has no seeds.
    """
    if any(len(of_task) == 0 for some in scores for of_task in some):
        raise ValueError("a task has no seeds, but needs at least one")
    random = np.random.default_rng(seed)
    found = statistic(
        *([x[random.integers(len(x), size=(resamples, len(x)))] for x in some] for some in scores)
    )
    low, high = _percentiles(found)
    return float(low), float(high)


def interval_of_curves(curves: np.ndarray, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Returns the interquartile mean of curves [N, T] and the ends of its interval, [T] each.

    The bootstrap resamples whole curves, which keeps the correlation of neighbouring times.
    """
    random = np.random.default_rng(seed)
    rows = random.integers(len(curves), size=(RESAMPLES, len(curves)))
    found = stats.trim_mean(curves[rows], 0.25, axis=1)  # [resamples, T]
    return stats.trim_mean(curves, 0.25, axis=0), *_percentiles(found)


def compare(scores: Mapping[str, np.ndarray], ours: str) -> dict[str, dict[str, Any]]:
    """Returns each method's interquartile mean and interval on one task, and compares with `ours`.

    The comparison is the probability that `ours` is better than the method.

    Args:
      scores: by method, [N] one value for each seed.
      ours: one of the methods.
    """
    found = {
        name: {
            "interquartile_mean": float(interquartile_mean([own])),
            "interval": interval(interquartile_mean, [own]),
            "values": own,
        }
        for name, own in scores.items()
    }
    better = improvements({name: [own] for name, own in scores.items()}, ours)
    return {name: of_method | better.get(name, {}) for name, of_method in found.items()}


def improvements(scores: Mapping[str, Scores], ours: str) -> dict[str, dict[str, Any]]:
    """Returns the probability that `ours` is better than each other method, with its interval."""
    return {
        name: {
            "probability_of_improvement": float(probability_of_improvement(scores[ours], theirs)),
            "probability_interval": interval(probability_of_improvement, scores[ours], theirs),
        }
        for name, theirs in scores.items()
        if name != ours
    }


def _percentiles(found: np.ndarray) -> np.ndarray:
    """The two ends of the interval of resampled values [N, ...]."""
    outside = 50 * (1 - CONFIDENCE)
    return np.percentile(found, [outside, 100 - outside], axis=0, method=EXACT)
