"""What an environment's module gives: how it is made, and what is known of it besides."""

import functools
from collections.abc import Callable
from typing import NamedTuple

from brax.envs.base import Env

from maxent_jax.density.histogram import Grid
from maxent_jax.envs.task import MujocoEnv, Task
from maxent_jax.envs.torso import Torso
from maxent_jax.types import Features


class Entry(NamedTuple):
    """An environment: a row of the registry says where to find it."""

    make: Callable[..., Env]  # backend, physics, **deviations -> Env
    grid: Grid  # where coverage and histogram entropy are measured
    torso: Torso | None = None
    phi: Features | None = None  # its feature map; None: see features.make_feature_map


def of_task(task: Task) -> Entry:
    """A MuJoCo environment."""
    return Entry(functools.partial(MujocoEnv, task), task.grid, task.torso)


def of_class(kind: Callable[[], Env], grid: Grid) -> Entry:
    """An environment that has one backend and one physics."""

    def make(_backend: str, _physics: str) -> Env:
        return kind()

    return Entry(make, grid)
