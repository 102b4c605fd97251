"""What a few seeds say: interquartile mean, stratified bootstrap, probability of improvement.

After Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice",
arXiv 2108.13264. Scores are lists of arrays, one array of seeds for each task.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from scipy import stats

Scores = Sequence[np.ndarray]
RESAMPLES = 2000
CONFIDENCE = 0.95
EXACT: Final = "inverted_cdf"  # percentiles are values that were found: none lies beside -inf


def interquartile_mean(scores: Scores) -> np.ndarray:
    """The mean of the middle half of all runs of all tasks, which have one unit.

    It is taken over the last axis. From four runs on no single one can move it far; of three it is
    their mean.
    """
    return stats.trim_mean(np.concatenate(scores, axis=-1), 0.25, axis=-1)


def probability_of_improvement(ours: Scores, theirs: Scores) -> np.ndarray:
    """How likely a run of ours is to beat one of theirs on the same task, ties counted half.

    The runs lie along the last axis.

    Raises:
      ValueError: different numbers of tasks.
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
    """The 95 % percentile interval of a statistic by stratified bootstrap.

    The seeds of each task, of each of the scores, are drawn anew with replacement; tasks stay.

    Args:
      statistic: of as many scores as are given, over the last axis of arrays [resamples, seeds].
      scores: not empty. With one seed a task the interval is a point, and says nothing; with
        three it holds the mean of normal values three times in four.
    Raises:
      ValueError: a task without seeds.
    """
    if any(len(of_task) == 0 for some in scores for of_task in some):
        raise ValueError("each task needs at least one seed")
    random = np.random.default_rng(seed)
    found = statistic(
        *([x[random.integers(len(x), size=(resamples, len(x)))] for x in some] for some in scores)
    )
    low, high = _percentiles(found)
    return float(low), float(high)


def interval_of_curves(curves: np.ndarray, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Interquartile mean of curves [N, T] at each time, and its interval: three arrays [T].

    Whole curves are drawn, so that neighbouring times rise and fall together.
    """
    random = np.random.default_rng(seed)
    rows = random.integers(len(curves), size=(RESAMPLES, len(curves)))
    found = stats.trim_mean(curves[rows], 0.25, axis=1)  # [resamples, T]
    return stats.trim_mean(curves, 0.25, axis=0), *_percentiles(found)


def compare(scores: Mapping[str, np.ndarray], ours: str) -> dict[str, dict[str, Any]]:
    """Methods on one task, an array of seeds each: interquartile mean and interval and, but for
    `ours` itself, how likely that is to be better.
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
    """By each other name: how likely `ours` is to be better, on all tasks, with its interval."""
    return {
        name: {
            "probability_of_improvement": float(probability_of_improvement(scores[ours], theirs)),
            "probability_interval": interval(probability_of_improvement, scores[ours], theirs),
        }
        for name, theirs in scores.items()
        if name != ours
    }


def _percentiles(found: np.ndarray) -> np.ndarray:
    """The two ends of what resamples [N, ...] found."""
    outside = 50 * (1 - CONFIDENCE)
    return np.percentile(found, [outside, 100 - outside], axis=0, method=EXACT)
