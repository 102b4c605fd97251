"""How large is the replay, and how long do inserting into a full one and drawing take?

The usual buffer stores both observations of each transition, which takes twice the memory.
"""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks import common
from maxent_jax import components
from maxent_jax.algorithm import experience
from maxent_jax.algorithm.experience import Reference
from maxent_jax.config import Config, preset
from maxent_jax.config.registry import MUJOCO_ENVS
from maxent_jax.runs import memory
from maxent_jax.sac import replay
from maxent_jax.sac.replay import Replay
from maxent_jax.types import Transition

CAPACITY = 1_000_000
NUM_INSERTS = 100


def both_observations(config: Config) -> int:
    """Returns the bytes of a buffer of both observations, action, reward and flag in float32."""
    sac = components.make(config).sac
    return 4 * config.learner.replay_size * (2 * sac.observation_size + sac.action_size + 2)


def ring_of(config: Config, full: bool) -> Replay:
    """Returns an empty replay, or one that is full of a single long episode per environment."""
    ring = experience.init(components.make(config))
    if not full:
        return ring
    rows = jnp.arange(config.learner.replay_size, dtype=jnp.int32)
    pointers = {
        "previous": (rows - config.budget.num_envs) % config.learner.replay_size,
        "following": (rows + config.budget.num_envs) % config.learner.replay_size,
    }
    size = jnp.asarray(config.learner.replay_size, jnp.int32)
    return ring._replace(items=ring.items._replace(**pointers), size=size)


def insert_seconds(config: Config, full: bool, repeats: int) -> float:
    """Returns the time of one vector step in a donated scan, with the search of its distances."""
    p = components.make(config)
    n, sac = config.budget.num_envs, p.sac
    state = jnp.ones((n, sac.observation_size))
    flags = jnp.zeros((3, n), bool)
    transition = Transition(
        *(state, jnp.zeros((n, sac.action_size)), state),
        *(flags[0], flags[1], ~flags[2], jnp.zeros(n)),
    )
    reference = Reference(
        jax.random.normal(jax.random.key(0), (config.mixture.reference_size, len(p.phi.names))),
        jnp.asarray(config.mixture.reference_size),
    )

    def step(carry, key):
        ring, place = carry
        ring, rows = experience.add(p, reference, ring, transition, place, jnp.zeros(n), key)
        return (ring, rows), None

    @functools.partial(jax.jit, donate_argnums=0)
    def inserts(carry):
        return jax.lax.scan(step, carry, jax.random.split(jax.random.key(1), NUM_INSERTS))[0]

    place = (
        (jnp.arange(n, dtype=jnp.int32) - n) % config.learner.replay_size
        if full
        else jnp.full(n, -1)
    )
    start = ring_of(config, full), place
    taken, _ = common.continued_seconds(lambda carry: (inserts(carry), None), start, repeats)
    return taken / NUM_INSERTS


def sample_seconds(config: Config, repeats: int) -> float:
    """Returns the time to draw one batch from a full replay."""
    p = components.make(config)
    starts = jnp.ones((config.environment.num_starts, p.sac.observation_size))
    ring = ring_of(config, full=True)
    sample = jax.jit(functools.partial(experience.sample, p, shape=(config.learner.batch_size,)))
    return common.median_seconds(lambda: sample(ring, starts, key=jax.random.key(0)), repeats)


def measure(env: str, capacity: int, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields a row for each dtype of the states."""
    for dtype in ("float32", "float16"):
        settings = {"replay_size": capacity, "replay_dtype": dtype, "yaw_copies": 0}
        config = preset("quick", env=env, **settings)
        ring = jax.eval_shape(lambda c=config: experience.init(components.make(c)))
        assert replay.capacity_of(ring) == capacity
        size = memory.nbytes(ring)
        empty, full = (insert_seconds(config, full, repeats) for full in (False, True))
        yield {
            "benchmark": "replay",
            "env": env,
            "states": dtype,
            "transitions": capacity,
            "gigabytes": size / 1e9,
            "over_both_observations": size / both_observations(config),
            "insert_microseconds": 1e6 * full,
            "insert_full_over_empty": full / empty,
            "sample_microseconds": 1e6 * sample_seconds(config, repeats),
        }


def main() -> None:
    args = common.parser(__doc__).parse_args()
    common.print_versions()
    envs, capacity = (("ant",), 1_000) if args.toy else (MUJOCO_ENVS, CAPACITY)
    for env in envs:
        for row in measure(env, capacity, args.repeats):
            common.emit(row)


if __name__ == "__main__":
    main()
