"""Places the state of a run on several devices: seeds first, then environments.

The functions are those for one device; this module only says where their data lies. A device with
seeds of its own runs them alone and exchanges only metrics. Where several devices share a seed, XLA
divides the work: each device steps its environments, holds its share of the replay, and updates its
own copy of the networks. XLA cannot divide what C++ computes on a CPU (C MuJoCo, the
nearest-neighbour search): there each device computes all of its seed.
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
    """Returns a mesh over seeds as far as they divide; the other devices share seeds.

    Raises:
      ConfigError: the devices that share a seed cannot divide its environments and replay evenly.
    """
    across_seeds = math.gcd(config.num_seeds, len(devices))
    sharing = len(devices) // across_seeds
    for name in ("num_envs", "replay_size"):
        if config[name] % sharing:
            raise ConfigError(
                f"{name.replace('_', '-')} is {config[name]}, but must be a multiple of "
                f"{sharing}, the number of devices that share a seed."
            )
    axis_types = (AxisType.Auto, AxisType.Auto)
    return jax.make_mesh((across_seeds, sharing), (SEEDS, ENVS), axis_types, devices=devices)


def placement(config: Config, mesh: Mesh) -> State:
    """Returns the sharding of every leaf of the state."""
    specs = _specs(config, (ENVS,))
    return jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs)


def start(config: Config, placed: State) -> State:
    """Runs `algorithm.start`; each leaf is made on the devices that hold it."""
    return jax.jit(lambda: algorithm.start(config), out_shardings=placed)()


def programs(config: Config, placed: State) -> Programs:
    """Returns `algorithm.programs` for a state placed so; every device gets the metrics."""
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
                    check_vma=False,  # it cannot look into foreign functions
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
    """A spec for every leaf; environments and replay rows lie along the axes `of_rows`."""
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
