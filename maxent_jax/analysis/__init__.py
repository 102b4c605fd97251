"""Access to a run's results: metrics, policies, fresh episodes, datasets, exported policies."""

from maxent_jax.analysis.episodes import Paths, paths
from maxent_jax.analysis.load import load_run
from maxent_jax.analysis.run import Run, Summary, mean_end_distances, mean_ends

__all__ = ["Paths", "Run", "Summary", "load_run", "mean_end_distances", "mean_ends", "paths"]
