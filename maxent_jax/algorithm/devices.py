"""Where the state of a run lies on several devices: seeds first, then environments.

Nothing here computes. The functions are those of one device. A device with seeds of its own runs
them on these and exchanges nothing but metrics. Where several share a seed XLA parts the work: each
steps its environments, holds its part of the replay, and updates its own copy of the networks. What
C++ computes on a CPU (C MuJoCo, the search) XLA cannot part: there each computes all of its seed.
"""

import math
from collections.abc import Sequence

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from maxent_jax import algorithm
from maxent_jax.algorithm import Programs, State
from maxent_jax.config import Config
from maxent_jax.errors import ConfigError

SEEDS, ENVS = "seeds", "envs"  # the mesh's axes


def make_mesh(config: Config, devices: Sequence[jax.Device]) -> Mesh:
    """A mesh in which as many devices as can have seeds of their own, and the rest share those.

    Raises:
      ConfigError: the devices that share a seed cannot share its environments and replay evenly.
    """
    across_seeds = math.gcd(config.num_seeds, len(devices))
    sharing = len(devices) // across_seeds
    for name in ("num_envs", "replay_size"):
        if config[name] % sharing:
            raise ConfigError(
                f"{name.replace('_', '-')} is {config[name]}, but must be a multiple of "
                f"{sharing}: so many devices share a seed."
            )
    axis_types = (AxisType.Auto, AxisType.Auto)
    return jax.make_mesh((across_seeds, sharing), (SEEDS, ENVS), axis_types, devices=devices)


def placement(config: Config, mesh: Mesh) -> State:
    """The sharding of every leaf of the state."""
    specs = _specs(config, (ENVS,))
    return jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs)


def start(config: Config, placed: State) -> State:
    """algorithm.start, each part made where it will lie."""
    return jax.jit(lambda: algorithm.start(config), out_shardings=placed)()


def programs(config: Config, placed: State) -> Programs:
    """algorithm.programs for a state that is placed so; every device ends with the metrics."""
    mesh = placed.iteration.mesh  # type: ignore[attr-defined]  # a sharding stands for the leaf
    functions = algorithm.functions(config.program(), config.num_seeds > 1)
    if config.num_seeds > 1:
        specs = _specs(config, ())
        functions = Programs(
            *(
                jax.shard_map(
                    f,
                    mesh=mesh,
                    in_specs=(specs,),
                    out_specs=(specs, P(SEEDS)),
                    axis_names={SEEDS},
                    check_vma=False,  # of foreign functions nothing is known
                )
                for f in functions
            )
        )
    outputs = placed, NamedSharding(mesh, P())
    return Programs(
        *(
            jax.jit(f, in_shardings=(placed,), out_shardings=outputs, donate_argnums=0)
            for f in functions
        )
    )


def _specs(config: Config, of_rows: tuple[str, ...]) -> State:
    """Every leaf's; environments and rows of the replay lie along the axes `of_rows`."""
    shapes = jax.eval_shape(lambda: algorithm.start(config))
    seeds = (SEEDS,) if config.num_seeds > 1 else ()
    of_seed, of_env = P(*seeds), P(*seeds, *of_rows)

    def everywhere(spec, tree):
        return jax.tree.map(lambda _: spec, tree)

    placed = everywhere(of_seed, shapes)
    learner, episodes = placed.learner, placed.learner.episodes
    return placed._replace(
        method=everywhere(P(), shapes.method),
        learner=learner._replace(
            replay=learner.replay._replace(items=everywhere(of_env, learner.replay.items)),
            place=of_env,
            episodes=episodes._replace(
                env=everywhere(of_env, episodes.env), age=of_env, start=of_env
            ),
            memory=everywhere(of_env, learner.memory),
        ),
    )
