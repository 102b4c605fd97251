"""Several processes that train one run: joining them, and what only the first of them does."""

from collections.abc import Callable
from typing import Any

import jax
from jax.experimental import multihost_utils

HEARTBEAT_TIMEOUT = 20  # seconds until the others know that a process is gone, and end too


def join(coordinator: str, num_processes: int, process_id: int) -> None:
    """Meets the other processes; afterwards jax sees the devices of all.

    Args:
      coordinator: HOST:PORT of process 0, or auto where jax can find out by itself.
    """
    where: dict[str, Any] = {}
    if coordinator != "auto":
        where = {
            "coordinator_address": coordinator,
            "num_processes": num_processes,
            "process_id": process_id,
        }
    jax.distributed.initialize(**where, heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT)


def is_first() -> bool:
    """Whether this process writes what is not an array; true where there is only one."""
    return jax.process_index() == 0


def first_alone(act: Callable[[], Any]) -> None:
    """The first process acts while the others wait."""
    if is_first():
        act()
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("first_alone")
