"""Estimates from shapes whether a run fits into memory, before anything is allocated or compiled.

The estimate is a lower bound: the state and the largest arrays next to it. A run that is refused
cannot fit; a run that is accepted can still run out of memory, with a sentence and exit code 1.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax

from maxent_jax import algorithm, components
from maxent_jax.config import Config
from maxent_jax.config.validation import MOST
from maxent_jax.envs import base
from maxent_jax.errors import ConfigError
from maxent_jax.runs import machine
from maxent_jax.runs.machine import Room, readable

FLOAT = 4  # bytes
LARGE_POLICY = 2**28  # bytes of one; from here on, a message blames their size, not their number
MANY_COPIES = 64
CELLS = "cell-restarts"  # the states of its cells take the same memory whatever its value
# Settings whose arrays the devices of a seed divide among them, see devices.placement.
DIVIDED = ("replay-size", "yaw-copies", "num-envs")


def check(config: Config, devices: Sequence[jax.Device]) -> None:
    """Rejects a run that cannot fit, and names the setting that takes the most memory.

    Raises:
      ConfigError: it needs more memory than a device, the machine or this process has.
    """
    need, room = on_a_device(config, len(devices)), _room(devices)
    total = sum(need.values())
    if total <= room.size:
        return
    setting = max(need, key=need.__getitem__)
    if config.num_seeds > 1 and total / config.num_seeds <= room.size:
        setting = "num-seeds"
    value = config[setting.replace("-", "_")]
    remedy = "set it to 0" if setting == CELLS else f"choose a smaller {setting}"
    raise ConfigError(
        f"{setting} is {value}, so the run needs at least {readable(total)} of memory, "
        f"but {room.of} has {readable(room.size)}: {remedy}."
    )


def check_episodes(config: Config, num_episodes: int) -> None:
    """As `check_rows`, for the states of whole episodes."""
    what = f"states ({num_episodes} episodes of {config.environment.episode_length} steps)"
    check_rows(config, num_episodes * config.environment.episode_length, what)


def check_rows(config: Config, num_rows: int, what: str) -> None:
    """Rejects a number of states that cannot be held in memory together.

    Raises:
      ConfigError: the states need too much memory, or are more than 32 bits can count.
    """
    room = _room(jax.devices()[:1])
    total = num_rows * _bytes_of_a_visit(config)
    if total > room.size:
        raise ConfigError(
            f"{num_rows} {what} need at least {readable(total)} of memory, but {room.of} has "
            f"{readable(room.size)}: choose fewer."
        )
    if num_rows > MOST:
        raise ConfigError(f"{num_rows} {what} are more than {MOST}: choose fewer.")


def on_a_device(config: Config, num_devices: int = 1) -> dict[str, int]:
    """Returns the fewest bytes that a run needs per device, by the setting they grow with.

    In addition to the state, `begin` and `end` need the states that the mixture visits, an actor
    for each episode, and two agents to start from; a step needs the batches drawn for it.
    """
    c, one_seed = config, of_a_seed(config.program())
    across_seeds = math.gcd(c.num_seeds, num_devices)
    sharing = num_devices // across_seeds
    return {
        name: size * (c.num_seeds // across_seeds) // (sharing if name in DIVIDED else 1)
        for name, size in one_seed.items()
    }


@functools.lru_cache(maxsize=8)
def of_a_seed(config: Config) -> dict[str, int]:
    """Returns the same as `on_a_device`, for one seed of a program."""
    c, state = config, algorithm.shapes(config)
    learner = state.learner
    policies, agent = nbytes(state.archive), nbytes(learner.agent)
    policy = policies // c.archive_size
    actor = nbytes(state.archive.parameters.actor) // c.archive_size
    actors = c.mixture.mixture_episodes * actor if c.mixture.mixing == "episode" else 0
    large = policy >= LARGE_POLICY
    num_dims = components.make(config).num_seen
    drawn = c.updates_per_vector_step * c.learner.batch_size
    visited = c.mixture.mixture_episodes * c.environment.episode_length * _bytes_of_a_visit(c)
    begin_or_end = {
        "hidden-size": 2 * agent + (actors if large else 0),
        "mixture-episodes": visited + (0 if large else actors),
    }
    batches = "num-envs" if c.updates_per_vector_step > c.learner.batch_size else "batch-size"
    layers = "batch-size" if c.learner.batch_size > c.learner.hidden_size else "hidden-size"
    step = {"num-envs": 0, "batch-size": 0, "hidden-size": agent}
    step[batches] += FLOAT * drawn * 2 * num_dims
    step[layers] += (
        FLOAT * c.learner.batch_size * c.learner.hidden_size * c.learner.hidden_layers * 3
    )
    plain, cells = learner.episodes.starts, 0
    if c.environment.cell_restarts:
        plain = jax.eval_shape(base.only_starts, learner.episodes)
        cells = nbytes(learner.episodes.starts) - nbytes(plain) + nbytes(learner.episodes.restarts)
    beside = max(begin_or_end, step, key=lambda need: sum(need.values()))
    of_state = {
        "replay-size" if c.learner.yaw_copies < MANY_COPIES else "yaw-copies": nbytes(
            learner.replay
        ),
        "hidden-size": agent + (policies if large else 0),
        "num-iterations": nbytes(state.method) + (0 if large else policies),
        "num-envs": nbytes((learner.episodes.env, learner.place, learner.memory)),
        "num-starts": nbytes(plain),
        CELLS: cells,
        "reference-size": nbytes((learner.reference, learner.history)),
    }
    return {name: of_state.get(name, 0) + beside.get(name, 0) for name in of_state.keys() | beside}


def nbytes(tree: Any) -> int:
    """Returns the bytes of all arrays of a tree, or of their shapes."""
    return sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(tree))


def _room(devices: Sequence[jax.Device]) -> Room:
    """Memory of each device: its own, or its share of the machine's."""
    device = devices[0]
    limit = (device.memory_stats() or {}).get("bytes_limit") if device.platform != "cpu" else None
    if limit:
        return Room(limit, f"the {device.device_kind}")
    whole = machine.memory()
    here = sum(d.process_index == jax.process_index() for d in devices) or 1
    return whole._replace(size=whole.size // here)


def _bytes_of_a_visit(config: Config) -> int:
    """Bytes of a state in a rollout: the state, its features, its policy and its weight."""
    made = components.make(config)
    return FLOAT * (made.sac.observation_size + len(made.phi.names) + 2)
