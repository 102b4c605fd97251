"""Environments by name: `make(name)` returns a brax Env, and base.py steps many in parallel.

A name is that of a Gymnasium task or a classic environment (config.registry.ENVS), `brax:NAME` for
an environment of brax, `playground:NAME` for one of MuJoCo Playground's, or `user:NAME` for one
that was added by `register`.
"""

import contextlib
import functools
import inspect
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp (optional) is missing
    import mujoco.mjx  # noqa: F401

from brax import envs as brax_envs
from brax.envs.base import Env

from maxent_jax.checks import check_number, check_path, check_whole
from maxent_jax.config import registry
from maxent_jax.config.registry import BRAX_HIDES_POSITION, MUJOCO_ENVS, resolve
from maxent_jax.config.validation import check_physics
from maxent_jax.density.histogram import Grid
from maxent_jax.envs.entries import Entry
from maxent_jax.envs.physics import REFERENCE, Options, PhysicsState
from maxent_jax.envs.task import MujocoEnv, Task, uniform_reset
from maxent_jax.errors import ConfigError, ConfigTypeError
from maxent_jax.types import Features

TASKS: dict[str, Task] = {name: resolve(f"maxent_jax.envs.{name}:TASK") for name in MUJOCO_ENVS}
DEVIATIONS = ("torque_limit", "end_flipped", "end_unhealthy")  # of MujocoEnv
DEFAULT_GRID = Grid(
    names=("state 0", "state 1"), low=(-10.0, -10.0), high=(10.0, 10.0), bins=(100, 100)
)


def make(name: str, backend: str = "auto", physics: str = "reference", **deviations: Any) -> Env:
    """Makes the environment of a name.

    Args:
      name: one of ENVS, "brax:NAME", "playground:NAME" or "user:NAME".
      backend: "mjx", "mujoco" (C MuJoCo), "warp", or "auto": `mujoco` on a CPU, else `mjx`. Classic
        environments have only "auto"; brax's have "auto" (brax's default) and "mjx";
        Playground's have "auto" and "mjx", which are the same, and "warp".
      physics: "reference" (the XML's options) or, for Gymnasium's tasks, "fast" (the task's).
      **deviations: from Gymnasium's task, see MujocoEnv.
    Raises:
      ConfigError (a ValueError): an unknown name, backend or physics, or one that cannot run here.
      ConfigTypeError (a TypeError as well): an unknown deviation.
    """
    found = entry(name)
    check_physics(name, backend, physics)
    known = DEVIATIONS if registry.environment(name).is_robot else ()
    for deviation in deviations:
        if deviation not in known:
            raise ConfigTypeError(
                f"{name} has no deviation '{deviation}': it has {', '.join(known) or 'none'}."
            )
    return found.make(backend, physics, **deviations)


def entry(name: str) -> Entry:
    """Returns how to make the environment of a name, and its grid, torso and feature map.

    Raises:
      ConfigError: the name is unknown.
    """
    row = registry.environment(name)
    for prefix, make_theirs in _THEIRS.items():
        if name.startswith(prefix):
            return Entry(functools.partial(make_theirs, name.removeprefix(prefix)), DEFAULT_GRID)
    if row.entry is None:
        raise registry.not_registered("environment", name)
    return resolve(row.entry)


def register(
    name: str,
    make: Callable[..., Env],
    grid: Grid = DEFAULT_GRID,
    phi: Features | None = None,
    in_metres: bool = False,
) -> None:
    """Registers a user's environment as `user:NAME`, to be trained like any other.

    Args:
      name: NAME.
      make: backend, physics -> a brax Env with observation [D], D at least 2, and action [A] in
        [-1, 1]. Its reward is used by the task `environment` alone; its `done` marks a terminal
        state.
      grid: where coverage is measured; by default the observation's first two entries, within ±10.
      phi: the feature map, [..., D] -> [..., F], with `.names`; by default the observation's first
        two entries and five random projections of the others.
      in_metres: the grid's coordinates are a position in metres. Runs then count visited cells of
        1 m². If the default feature map keeps these coordinates, bonuses see them in eighths of the
        grid's sides.
    Raises:
      ConfigError: the name is already in use in this process, or the grid has no cells.
      ConfigTypeError (a ValueError and a TypeError): an argument has the wrong type or form.
    """
    registry.check_name("environment", name)
    if not callable(make):
        raise ConfigTypeError(f"make is {make!r}, but must be a function that makes a brax Env.")
    if not _takes_two(make):
        raise ConfigTypeError(
            f"make is {make!r}, but must take two arguments, the backend and the physics."
        )
    _check_grid(grid)
    if phi is not None and not (callable(phi) and hasattr(phi, "names")):
        raise ConfigTypeError(f"phi is {phi!r}, but must be a function with `names`.")
    if not isinstance(in_metres, bool):
        raise ConfigTypeError(f"in_metres is {in_metres!r}, but must be True or False.")
    registry.register_environment(name, Entry(make, grid, None, phi), in_metres)


def from_xml(
    xml: str | Path,
    frame_skip: int,
    backend: str = "auto",
    physics: str | Options = REFERENCE,
    reset_noise: float = 1e-2,
    healthy: Callable | None = None,
    fast: Options = REFERENCE,
) -> MujocoEnv:
    """Makes an environment from an MJCF file. It observes qpos and qvel; actions are its controls.

    Args:
      xml: the file.
      frame_skip: physics steps of the file in a control step, at least 1.
      backend: as in MujocoEnv.
      physics: the profile, as in MujocoEnv.
      reset_noise: half the range of the noise in every coordinate of a start.
      healthy: observation [..., D] -> [...] bool, false ends the episode; by default only numbers
        that are not finite end it.
      fast: the options of the profile `fast`; by default there is no such profile.
    Raises:
      ConfigError: MuJoCo cannot read the file, nothing in it can move, an actuator has no control
        range, the backend cannot simulate it, or there is no such profile.
      TypeError: an argument has the wrong type.
    """
    path = check_path("xml", xml)
    if check_whole("frame_skip", frame_skip) < 1:
        raise ConfigError(f"frame_skip is {frame_skip}, but must be at least 1.")
    if not 0 <= check_number("reset_noise", reset_noise) < float("inf"):
        raise ConfigError(f"reset_noise is {reset_noise}, but must be 0 or more.")
    if not (healthy is None or callable(healthy)):
        raise ConfigTypeError(f"healthy is {healthy!r}, but must be a function of observations.")
    if not isinstance(fast, Options):
        raise ConfigTypeError(f"fast is {fast!r}, but must be an envs.Options.")
    task = Task(
        name=path.stem,
        xml=path,
        frame_skip=frame_skip,
        reset=uniform_reset(reset_noise),
        observe=_qpos_and_qvel,
        healthy=healthy or _finite,
        grid=DEFAULT_GRID,
        fast=fast,
    )
    return MujocoEnv(task, backend, physics)


def _takes_two(make: Callable) -> bool:
    """Whether a function can be called with two arguments; if nobody can know, it is trusted."""
    try:
        inspect.signature(make).bind("auto", "reference")
    except TypeError:
        return False
    except ValueError:  # of a builtin without a signature
        return True
    return True


def _check_grid(grid: Grid) -> None:
    if not isinstance(grid, Grid):
        raise ConfigTypeError(f"grid is {grid!r}, but must be a density.histogram.Grid.")
    if not all(low < high for low, high in zip(grid.low, grid.high, strict=True)):
        raise ConfigError(
            f"the grid is from {grid.low} to {grid.high}, but low must be below high."
        )
    if min(grid.bins) < 1:
        raise ConfigError(f"the grid has bins {grid.bins}, but both must be at least 1.")
    if min(grid.coordinates) < 0:
        raise ConfigError(f"the grid has coordinates {grid.coordinates}, but none may be negative.")


def _qpos_and_qvel(state: PhysicsState, _) -> Any:
    return jnp.concatenate([state.qpos, state.qvel], axis=-1)


def _finite(observation: Any) -> Any:
    return jnp.isfinite(observation).all(-1)


def _make_brax(name: str, backend: str, _physics: str) -> Env:
    options: dict[str, Any] = {} if backend == "auto" else {"backend": backend}
    if name in BRAX_HIDES_POSITION:
        options["exclude_current_positions_from_observation"] = False
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Brax System")  # it says that MJX is better maintained
        return brax_envs.get_environment(name, **options)


def _make_playground(name: str, backend: str, _physics: str) -> Env:
    from maxent_jax.envs.playground import PlaygroundEnv

    return PlaygroundEnv(name, backend)


_THEIRS = {registry.BRAX: _make_brax, registry.PLAYGROUND: _make_playground}
