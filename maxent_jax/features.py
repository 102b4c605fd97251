"""The feature map phi(s): some coordinates of the state, and five projections of the rest.

Densities are measured in the space of features. A small table fixes the map of an environment for
all methods and seeds; `python -m experiments.measure_features` makes it. An environment without a
table has a default map.
"""

import dataclasses
import json
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import envs
from maxent_jax.envs.task import observation_size
from maxent_jax.precision import in_32_bits
from maxent_jax.types import Features

NUM_PROJECTIONS = 5
PROJECTION_SEED = 20_240_501


@dataclasses.dataclass(frozen=True)
class FeatureMap:
    """A feature map, [..., D] -> [..., F] float32; F is 7 for Gymnasium's robots."""

    coordinates: tuple[int, ...]  # indices of the entries that are kept
    units: tuple[float, ...]  # what each is divided by; 1 for metres
    projection: tuple[tuple[float, ...], ...]  # [D - coordinates, 5 or 0]; results are of order 1
    names: tuple[str, ...]

    @in_32_bits
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Returns the features [..., F] of states [..., D].

        Raises:
          ValueError: D is not that of the environment.
        """
        observation = jnp.asarray(observation, jnp.float32)
        size = len(self.coordinates) + len(self.projection)
        if observation.shape[-1:] != (size,):
            raise ValueError(f"states have shape {observation.shape}, but must be [..., {size}]")
        kept = observation[..., list(self.coordinates)]
        kept = kept / jnp.broadcast_to(jnp.array(self.units), kept.shape)
        if not self.projection:
            return kept
        rest = jnp.delete(observation, np.array(self.coordinates), axis=-1)
        projected = jnp.matmul(
            rest,
            jnp.array(self.projection, jnp.float32),
            precision=jax.lax.Precision.HIGHEST,  # not TF32: features serve to measure distances
        )
        return jnp.concatenate([kept, projected], axis=-1)


def raw_projection(num_inputs: int) -> np.ndarray:
    """Returns [num_inputs, 5] float64 standard normal, always the same. Source: the paper, §5.1."""
    generator = np.random.default_rng(PROJECTION_SEED)
    return generator.standard_normal((num_inputs, NUM_PROJECTIONS))


def make_feature_map(env_name: str, num_dims: int | None = None) -> Features:
    """Returns the feature map of an environment: its own, else its table's, else the default.

    The default keeps the first two entries of the observation and projects the others. The
    projections of standard normal entries are standard normal.

    Args:
      env_name: the name of the environment.
      num_dims: D; if left out, it is traced, which takes seconds in environments of brax.
    Raises:
      ConfigError: the environment is unknown.
    """
    own = envs.entry(env_name).phi
    if own is not None:
        return own
    path = resources.files("maxent_jax.envs") / "tables" / f"features_{env_name}.json"
    if not path.is_file():
        return _default(num_dims or observation_size(envs.make(env_name)))
    table = json.loads(path.read_text(encoding="utf-8"))
    return FeatureMap(
        coordinates=tuple(table["coordinates"]),
        units=tuple(table["units"]),
        projection=tuple(tuple(row) for row in table["projection"]),
        names=tuple(table["names"]),
    )


def _default(observation_size: int) -> FeatureMap:
    rest = observation_size - 2
    projection = raw_projection(rest) / np.sqrt(max(rest, 1))
    names = [f"projection_{i}" for i in range(NUM_PROJECTIONS)] if rest else []
    return FeatureMap(
        coordinates=(0, 1),
        units=(1.0, 1.0),
        projection=tuple(tuple(row) for row in projection.tolist()),
        names=("state_0", "state_1", *names),
    )
