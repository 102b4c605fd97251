"""Loads a finished or running run from its directory."""

import itertools
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np

from maxent_jax import errors
from maxent_jax.analysis.run import Run
from maxent_jax.checks import check_path, check_whole
from maxent_jax.precision import in_32_bits
from maxent_jax.runs import checkpoint, files


@in_32_bits
def load_run(path: str | Path, seed_index: int = 0, fallback: bool = False) -> Run:
    """Loads a run's results from its last checkpoint; the replay stays on disk.

    Args:
      path: the run's directory.
      seed_index: the seed, counted from 0, in a run of several seeds.
      fallback: skip damaged checkpoints, with a warning for each.
    Returns:
      The run.
    Raises:
      RunError: `path` is not the directory of a run, or there is no such seed.
      CheckpointError: there is no complete checkpoint.
      CheckpointCorruptError: a file of the checkpoint differs from what was written.
      TypeError: the path or the index has the wrong type.
    """
    directory = check_path("path", path)
    seed_index = check_whole("seed_index", seed_index)
    config = files.read_config(directory)
    if not 0 <= seed_index < config.num_seeds:
        raise errors.RunError(
            f"seed_index is {seed_index}, but {directory} has {config.num_seeds} "
            f"{'seed' if config.num_seeds == 1 else 'seeds'}, counted from 0."
        )
    remedy = "load_run(..., fallback=True), or --fallback of a command, uses the one before"
    name, results, rows, passed_over = checkpoint.restore_latest(
        directory, config, remedy, fallback
    )
    for sentence in passed_over.values():
        warnings.warn(sentence, stacklevel=2)
    if config.num_seeds > 1:
        results = jax.tree.map(lambda x: x[seed_index], results)
        rows = [files.of_seed(row, seed_index) for row in rows]
    return Run(
        path=directory,
        config=config,
        metrics={name: _column(rows, name) for name in dict.fromkeys(itertools.chain(*rows))},
        seed=config.seed + seed_index,
        mixture=results.archive,
        histogram=np.asarray(results.visits.cells),
        random_histogram=np.asarray(results.random_visits.cells),
        checkpoint=name,
    )


def _column(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """[T, ...]; NaN where a row lacks it: an older release did not measure it."""
    known = [np.shape(row[name]) for row in rows if row.get(name) is not None]
    missing = np.full(known[0] if known else (), np.nan)
    values = np.array([missing if row.get(name) is None else row[name] for row in rows])
    return values.astype(float) if values.dtype == object else values
