"""phi(s): the space in which densities are measured. Two coordinates and five projections.

The projections are fixed for each environment by a small table, shared by all methods and seeds;
`python -m experiments.measure_features` makes it.
"""

import dataclasses
import json
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np

NUM_PROJECTIONS = 5
PROJECTION_SEED = 20_240_501


@dataclasses.dataclass(frozen=True)
class FeatureMap:
    """phi(s[..., D]) -> [..., 7] float32."""

    coordinates: tuple[int, int]  # kept as they are, in metres
    projection: tuple[tuple[float, ...], ...]  # [D - 2, 5]; each output is about within [-1, 1]
    names: tuple[str, ...]

    def __call__(self, observation: jax.Array) -> jax.Array:
        """[..., D] -> [..., 7]."""
        kept = observation[..., list(self.coordinates)]
        rest = jnp.delete(observation, np.array(self.coordinates), axis=-1)
        projected = jnp.matmul(
            rest,
            jnp.array(self.projection, jnp.float32),
            precision=jax.lax.Precision.HIGHEST,  # not TF32: distances are measured in it
        )
        return jnp.concatenate([kept, projected], axis=-1)


def raw_projection(observation_size: int) -> np.ndarray:
    """[D - 2, 5] float64 standard normal, the same for every run. Source: the paper's §5.1."""
    generator = np.random.default_rng(PROJECTION_SEED)
    return generator.standard_normal((observation_size - 2, NUM_PROJECTIONS))


def make_feature_map(env_name: str) -> FeatureMap:
    """The feature map of an environment, from its table.

    Raises:
      ValueError: an environment without a table.
    """
    path = resources.files("maxent_jax") / "tables" / f"features_{env_name}.json"
    if not path.is_file():
        raise ValueError(
            f"no feature table for '{env_name}': make one with experiments.measure_features"
        )
    table = json.loads(path.read_text())
    return FeatureMap(
        coordinates=tuple(table["coordinates"]),
        projection=tuple(tuple(row) for row in table["projection"]),
        names=tuple(table["names"]),
    )
