"""The mixture policy: an archive of policies, their weights, and the states that they visit."""

from maxent_jax.mixture.archive import Archive, append, init, policy
from maxent_jax.mixture.sampling import assign_episodes, draw_distinct, draw_rows
from maxent_jax.mixture.weights import (
    fully_corrective_weights,
    geometric_weights,
    last_weights,
    most_entropic_weights,
    project_to_simplex,
    uniform_weights,
    weight_table,
)

__all__ = [
    "Archive",
    "append",
    "assign_episodes",
    "draw_distinct",
    "draw_rows",
    "fully_corrective_weights",
    "geometric_weights",
    "init",
    "last_weights",
    "most_entropic_weights",
    "policy",
    "project_to_simplex",
    "uniform_weights",
    "weight_table",
]
