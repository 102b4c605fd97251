"""phi(s): the space in which densities are measured. Coordinates, and five projections of the rest.

The map of an environment is fixed by a small table, shared by all methods and seeds;
`python -m experiments.measure_features` makes it. One without a table has a default map.
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
    """phi(s[..., D]) -> [..., F] float32; F is 7 for Gymnasium's robots."""

    coordinates: tuple[int, ...]  # of the state, kept
    units: tuple[float, ...]  # what counts as 1 of each; 1 where they are metres
    projection: tuple[tuple[float, ...], ...]  # [D - coordinates, 5 or 0], order 1 each
    names: tuple[str, ...]

    @in_32_bits
    def __call__(self, observation: jax.Array) -> jax.Array:
        """[..., D] -> [..., F].

        Raises:
          ValueError: another D than that of the environment.
        """
        observation = jnp.asarray(observation, jnp.float32)
        size = len(self.coordinates) + len(self.projection)
        if self.projection and observation.shape[-1:] != (size,):
            raise ValueError(f"states have shape {observation.shape}, but must be [..., {size}]")
        kept = observation[..., list(self.coordinates)]
        kept = kept / jnp.broadcast_to(jnp.array(self.units), kept.shape)
        if not self.projection:
            return kept
        rest = jnp.delete(observation, np.array(self.coordinates), axis=-1)
        projected = jnp.matmul(
            rest,
            jnp.array(self.projection, jnp.float32),
            precision=jax.lax.Precision.HIGHEST,  # not TF32: distances are measured in it
        )
        return jnp.concatenate([kept, projected], axis=-1)


def raw_projection(num_inputs: int) -> np.ndarray:
    """[num_inputs, 5] float64 standard normal, the same for every run. Source: the paper's §5.1."""
    generator = np.random.default_rng(PROJECTION_SEED)
    return generator.standard_normal((num_inputs, NUM_PROJECTIONS))


def make_feature_map(env_name: str) -> Features:
    """The feature map of an environment: its own, or that of its table, or the default one.

    The default keeps the first two observations, and projects the others so that a projection of
    standard normal ones is standard normal.

    Raises:
      ConfigError: an unknown environment.
    """
    own = envs.entry(env_name).phi
    if own is not None:
        return own
    path = resources.files("maxent_jax.envs") / "tables" / f"features_{env_name}.json"
    if not path.is_file():
        return _default(observation_size(envs.make(env_name)))
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
