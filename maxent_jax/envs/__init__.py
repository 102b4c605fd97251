"""Where states come from. `make(name)` gives a brax Env; base.py runs many of them at once."""

import contextlib
import io
from typing import Any

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, an option, is missing
    import mujoco.mjx  # noqa: F401

from maxent_jax.envs import ant
from maxent_jax.envs.task import MujocoEnv

TASKS = {task.name: task for task in (ant.TASK,)}


def make(
    name: str, backend: str = "auto", physics: str = "reference", **deviations: Any
) -> MujocoEnv:
    """The environment of that name.

    Args:
      name: one of TASKS.
      backend: "mjx", "mujoco" (C MuJoCo), or "auto": `mujoco` on a CPU, else `mjx`.
      physics: "reference" (the XML's options) or "fast", see physics.load_model.
      **deviations: from Gymnasium's task, see MujocoEnv.
    Raises:
      ValueError: unknown name, backend or physics, or a backend that cannot run here.
    """
    if name not in TASKS:
        raise ValueError(f"unknown environment '{name}': choose one of {', '.join(TASKS)}")
    return MujocoEnv(TASKS[name], backend, physics, **deviations)
