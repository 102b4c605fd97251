"""Access to a run's results: metrics, policies, fresh episodes, datasets, exported policies."""

from maxent_jax.analysis.run import (
    Paths,
    Run,
    Summary,
    load_run,
    mean_end_distances,
    mean_ends,
    paths,
)

__all__ = ["Paths", "Run", "Summary", "load_run", "mean_end_distances", "mean_ends", "paths"]
