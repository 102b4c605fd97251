"""Several processes that train one run: how they connect, wait for each other, and disconnect."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

TIMEOUT = 20  # seconds until the others notice that a process is gone, and end too


def join(coordinator: str, num_processes: int, process_id: int) -> None:
    """Connects to the other processes; afterwards jax sees the devices of all.

    Args:
      coordinator: HOST:PORT of process 0, or auto where jax can find it itself.
    """
    where: dict[str, Any] = {}
    if coordinator != "auto":
        where = {
            "coordinator_address": coordinator,
            "num_processes": num_processes,
            "process_id": process_id,
        }
    jax.distributed.initialize(
        **where, heartbeat_timeout_seconds=TIMEOUT, shutdown_timeout_seconds=TIMEOUT
    )


def leave() -> None:
    """Waits for all processes, then disconnects from them."""
    if jax.process_count() > 1:
        jax.distributed.shutdown()


def is_first() -> bool:
    """Whether this is the process that writes what is not an array; true if it is alone."""
    return jax.process_index() == 0


def wait_for_all(where: str) -> None:
    """Waits until every process has reached the point of that name."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(where)


def first_alone(act: Callable[[], Any], where: str) -> None:
    """Lets the first process act while the others wait."""
    if is_first():
        act()
    wait_for_all(where)


def largest(*numbers: int) -> list[int]:
    """Returns, for each number, the largest of any process, so that all decide alike."""
    if jax.process_count() == 1:
        return list(numbers)
    return np.max(multihost_utils.process_allgather(np.array(numbers)), axis=0).tolist()
