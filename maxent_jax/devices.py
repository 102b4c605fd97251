"""Where the state of a run lies on several devices: seeds first, then environments.

Nothing here computes. The programs are those of one device, and XLA parts them along what is given
here: with a device for each seed nothing is exchanged but metrics; where several share a seed, each
steps its part of the environments, holds its part of the replay, and updates its own copy of the
networks.
"""

import math
from collections.abc import Sequence

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from maxent_jax import algorithm
from maxent_jax.algorithm import SEED_AXES, State
from maxent_jax.config import Config, ConfigError

SEEDS, ENVS = "seeds", "envs"  # the mesh's axes


def make_mesh(config: Config, devices: Sequence[jax.Device]) -> Mesh:
    """A mesh in which as many devices as can have seeds of their own, and the rest share those.

    Raises:
      ConfigError: the devices that share a seed cannot share its environments and replay evenly.
    """
    across_seeds = math.gcd(config.num_seeds, len(devices))
    sharing = len(devices) // across_seeds
    for name in ("num_envs", "replay_size"):
        if getattr(config, name) % sharing:
            raise ConfigError(
                f"{name.replace('_', '-')} is {getattr(config, name)}, but must be a multiple of "
                f"{sharing}: so many devices share a seed."
            )
    shape = (across_seeds, sharing)
    return jax.make_mesh(shape, (SEEDS, ENVS), devices=devices, axis_types=(AxisType.Auto,) * 2)


def placement(config: Config, mesh: Mesh) -> State:
    """The sharding of every leaf of the state."""
    shapes = jax.eval_shape(lambda: algorithm.start(config))
    seeds = (SEEDS,) if config.num_seeds > 1 else ()
    whole, of_seed, of_env = (NamedSharding(mesh, P(*axes)) for axes in ((), seeds, (*seeds, ENVS)))

    def everywhere(sharding, tree):
        return jax.tree.map(lambda _: sharding, tree)

    placed = everywhere(of_seed, shapes)
    learner, episodes = placed.learner, placed.learner.episodes
    return placed._replace(
        method=everywhere(whole if SEED_AXES.method is None else of_seed, shapes.method),
        learner=learner._replace(
            replay=learner.replay._replace(items=everywhere(of_env, learner.replay.items)),
            place=of_env,
            episodes=episodes._replace(
                env=everywhere(of_env, episodes.env), age=of_env, start=of_env
            ),
            memory=everywhere(of_env, learner.memory),
        ),
    )


def start(config: Config, placed: State) -> State:
    """algorithm.start, each part made where it will lie."""
    return jax.jit(lambda: algorithm.start(config), out_shardings=placed)()
