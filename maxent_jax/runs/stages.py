"""Advances a run by one program: the beginning of an iteration, a segment, or its end."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import algorithm, errors
from maxent_jax.algorithm import Programs, State
from maxent_jax.algorithm.convergence import has_plateaued
from maxent_jax.config import Config
from maxent_jax.runs import atomic, integrity
from maxent_jax.runs.checkpoint import Progress
from maxent_jax.runs.clock import Clock
from maxent_jax.runs.progress import Bar


class Stage(NamedTuple):
    """The state of a run and its progress."""

    state: State
    progress: Progress


def advance(
    config: Config,
    programs: Programs,
    state: State,
    progress: Progress,
    clock: Clock,
    bar: Bar,
) -> Stage:
    """Runs the next of the three programs of an iteration, and updates clock and bar."""
    if progress.begun is None:
        state, begun = clock.time("wall_begin", programs.begin, state)
        return Stage(state, progress._replace(begun=begun))
    if not _trained(config, progress.segments):
        state, metrics = clock.time("wall_train", programs.train_segment, state)
        bar.segment_done()
        return Stage(state, progress._replace(segments=[*progress.segments, metrics]))
    state, at_end = clock.time("wall_end", programs.end, state)
    row = atomic.jsonable(_row(config, progress, at_end) | clock.end_iteration())
    bar.iteration_done(row)
    return Stage(state, progress._replace(rows=[*progress.rows, row], begun=None, segments=[]))


def _row(config: Config, progress: Progress, at_end: dict[str, np.ndarray]) -> dict[str, Any]:
    """The line of metrics.jsonl for an iteration, without its times."""
    segments = progress.segments
    stacked = jax.tree.map(lambda *x: np.stack(x), *segments)
    rewards = np.full((*stacked["step_reward"].shape[1:], config.budget.num_segments), np.nan)
    rewards[..., : len(segments)] = np.moveaxis(stacked["step_reward"], 0, -1)
    return {
        **at_end,
        **(progress.begun or {}),
        **jax.tree.map(np.asarray, algorithm.reduce_metrics(stacked)),
        "segments_trained": len(segments),
        "converged": _all_converged(config, segments),
        "segment_reward": rewards,
    }


def _trained(config: Config, segments: list[dict[str, np.ndarray]]) -> bool:
    """Whether the iteration's budget is spent, or its reward has stopped rising."""
    if not segments:
        return False
    return len(segments) == config.budget.num_segments or _all_converged(config, segments)


def _all_converged(config: Config, segments: list[dict[str, np.ndarray]]) -> bool:
    """Whether all seeds, which train in step, have converged."""
    rewards = np.stack([metrics["step_reward"] for metrics in segments], axis=-1)
    return all(
        has_plateaued(
            list(of_seed), config.budget.plateau_segments, config.budget.plateau_tolerance
        )
        for of_seed in np.atleast_2d(rewards)
    )


def check_finite(directory: Path, state: State, progress: Progress) -> None:
    """Checks a state before it is saved.

    Raises:
      NonFiniteError: the state holds a number that is not finite.
    """
    leaves = jax.tree_util.tree_flatten_with_path(jax.device_get(_finite(state)))[0]
    wrong = [path for path, is_finite in leaves if not is_finite]
    if wrong:
        where = jax.tree_util.keystr(wrong[0], simple=True, separator=".")
        iteration = len(progress.rows) + (progress.begun is not None)
        when = f"in segment {len(progress.segments)}" if progress.segments else "at its beginning"
        if progress.begun is None:
            when = "at its end"
        saved = integrity.checkpoints(directory)
        raise errors.NonFiniteError(
            f"iteration {iteration} produced a number that is not finite {when} (first in "
            f"{where}): this is not saved, and {directory} holds "
            f"{f'the run up to checkpoint {saved[-1]}' if saved else 'no checkpoint yet'}."
        )


@jax.jit
def _finite(state: State) -> State:
    """Whether all numbers are finite, for each leaf."""

    def of_leaf(x: jax.Array) -> jax.Array:
        return jnp.isfinite(x).all() if jnp.issubdtype(x.dtype, jnp.floating) else jnp.array(True)

    return jax.tree.map(of_leaf, state)
