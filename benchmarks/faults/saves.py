"""Do memory, open files or disk usage grow with the number of checkpoints?"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from maxent_jax import algorithm
from maxent_jax.config import preset
from maxent_jax.runs import checkpoint, files
from maxent_jax.runs.checkpoint import Progress

NUM_SAVES = 300
SETTLED = 50  # saves after which nothing may grow any more
ROOM = 1.1


def measure(folder: Path, short: bool) -> Iterator[dict[str, Any]]:
    """Yields one row."""
    num_saves = 20 if short else NUM_SAVES
    config = preset("smoke", env="pendulum")
    state = algorithm.start(config)
    files.write_config(folder, config, {}, {})
    progress = Progress([], {}, [], {})
    used = []
    for i in range(num_saves):
        checkpoint.save(folder, state, progress._replace(rows=[{"iteration": i}] * (i + 1)), {})
        used.append(_used(folder))
    settled, last = used[min(SETTLED, num_saves // 2) - 1], used[-1]
    yield {
        "fault": f"{num_saves} saves in a row",
        "times": num_saves,
        **{f"{name}, from": value for name, value in settled.items()},
        **{f"{name}, to": value for name, value in last.items()},
        "passed": all(last[name] <= ROOM * settled[name] for name in last),
    }


def _used(folder: Path) -> dict[str, float]:
    with open("/proc/self/statm", encoding="utf-8") as file:
        resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {
        "resident MB": round(resident / 1e6, 1),
        "open files": len(os.listdir("/proc/self/fd")),
        "disk MB": round(sum(path.stat().st_size for path in files) / 1e6, 2),
        "files": len(files),
    }
