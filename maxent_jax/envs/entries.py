"""The entry of an environment: how to make it, its grid, torso and feature map."""

import functools
from collections.abc import Callable
from typing import NamedTuple

from brax.envs.base import Env

from maxent_jax.density.histogram import Grid
from maxent_jax.envs.task import MujocoEnv, Task
from maxent_jax.envs.torso import Torso
from maxent_jax.types import Features


class Entry(NamedTuple):
    """An environment. A row of the registry says where its entry is."""

    make: Callable[..., Env]  # backend, physics, **deviations -> Env
    grid: Grid  # where coverage and histogram entropy are measured
    torso: Torso | None = None
    phi: Features | None = None  # its feature map; None: see features.make_feature_map


def of_task(task: Task) -> Entry:
    """Returns the entry of a MuJoCo environment."""
    return Entry(functools.partial(MujocoEnv, task), task.grid, task.torso)


def of_class(kind: Callable[[], Env], grid: Grid) -> Entry:
    """Returns the entry of an environment with one backend and one physics."""

    def make(_backend: str, _physics: str) -> Env:
        return kind()

    return Entry(make, grid)
