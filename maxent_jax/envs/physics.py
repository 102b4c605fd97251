"""The interface of physics: its state, the options of a model, and the type of a step.

`step(state, control) -> (state, derived)` is a pure function for any leading axes; it can be
jitted, scanned and vmapped. The backends (mjx_backend, mujoco_backend) run the same model with the
same options, behind the same interface.
"""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco

from maxent_jax.checks import check_choice, check_whole
from maxent_jax.errors import ConfigError


class PhysicsState(NamedTuple):
    """All that the next step depends on; with the warm start, every backend is a pure function."""

    qpos: jax.Array  # [..., nq] metres, unit quaternion, radians
    qvel: jax.Array  # [..., nv] metres and radians per second
    warmstart: jax.Array  # [..., nv] acceleration from which the constraint solver starts


Derived = dict[str, jax.Array]
"""Fields of MjData that a task observes in addition to the state, each [..., its size]."""


Work = Callable[[jax.Array], tuple[Any, jax.Array]]
"""A computation that runs beside a step: from a typed key to its result, and to a number [] that it
computes last."""


StepBeside = Callable[
    [PhysicsState, jax.Array, Work, jax.Array], tuple[tuple[PhysicsState, Derived], Any]
]
"""`step_beside(state, control, work, key)` returns what `step(state, control)` returns, and the
result of `work(key)`, which runs at the same time."""


class Physics(NamedTuple):
    """A model on a backend."""

    step: Callable[[PhysicsState, jax.Array], tuple[PhysicsState, Derived]]
    """One control step with constant control. The derived fields are those that Gymnasium reads
    after mj_step and mj_rnePostConstraint: they belong to the last evaluation of the dynamics."""
    derive: Callable[[PhysicsState], Derived]
    """The derived fields of a start, before any control or external force acts."""
    step_beside: StepBeside | None = None
    """None: the backend cannot step beside another computation."""


class Options(NamedTuple):
    """Changes to the physics of an XML; None and the defaults change nothing."""

    integrator: str | None = None  # Euler, RK4 or implicitfast
    substeps: int = 1  # physics steps in each step of the XML, whose time step is divided
    solver: str | None = None  # Newton, CG or PGS
    iterations: int | None = None  # of the constraint solver, at most
    ls_iterations: int | None = None  # of its line search, at most
    eulerdamp: bool = True  # Euler integrates joint damping implicitly
    self_collisions: bool = True  # else bodies collide only with the world
    max_contacts: int | None = None  # MJX keeps this many of each kind of contact, the deepest


REFERENCE = Options()
MUJOCO_LOG = "MUJOCO_LOG.TXT"  # where C MuJoCo writes by default
_INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
_SOLVERS = {
    "Newton": mujoco.mjtSolver.mjSOL_NEWTON,
    "CG": mujoco.mjtSolver.mjSOL_CG,
    "PGS": mujoco.mjtSolver.mjSOL_PGS,
}


def gymnasium_xml(name: str) -> Path:
    """Returns the path of a model in the installed gymnasium package."""
    spec = importlib.util.find_spec("gymnasium")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / name


def keep_no_log() -> None:
    """Stops C MuJoCo from writing its warnings to the working folder; the console shows them.

    A diverging simulation would write a line for each warning. A log file that the user chose with
    MjLogConfig is kept.
    """
    config = mujoco.MjLogConfig.get()
    if config.logfile == MUJOCO_LOG and config.logto_file:
        config.logto_file = False
        mujoco.MjLogConfig.set(config)


def load_model(xml: Path, options: Options = REFERENCE) -> mujoco.MjModel:
    """Loads the MuJoCo model of a file, with changed options.

    Raises:
      ConfigError: MuJoCo cannot read the file, or an option has an invalid value.
      TypeError: an option has the wrong type.
    """
    _check_options(options)
    keep_no_log()
    try:
        spec = mujoco.MjSpec.from_file(str(xml))
    except ValueError as error:
        raise ConfigError(_unreadable(xml, error)) from None
    if options.max_contacts is not None:
        for numeric in spec.numerics:  # MJX 3.17 finds its own only if it is the first
            spec.delete(numeric)
        spec.add_numeric(name="max_contact_points", size=1, data=[options.max_contacts])
    try:
        model = spec.compile()
    except ValueError as error:  # a missing mesh, for example
        raise ConfigError(_unreadable(xml, error)) from None
    if options.integrator is not None:
        model.opt.integrator = _INTEGRATORS[options.integrator]
    if options.solver is not None:
        model.opt.solver = _SOLVERS[options.solver]
    if options.iterations is not None:
        model.opt.iterations = options.iterations
    if options.ls_iterations is not None:
        model.opt.ls_iterations = options.ls_iterations
    if not options.eulerdamp:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    if not options.self_collisions:
        model.geom_conaffinity[model.geom_bodyid > 0] = 0
    model.opt.timestep /= options.substeps
    # A diverging simulation must be noticed: MuJoCo would silently reset it to its rest pose.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def _check_options(options: Options) -> None:
    for name, known in (("integrator", _INTEGRATORS), ("solver", _SOLVERS)):
        if getattr(options, name) is not None:
            check_choice(name, getattr(options, name), known)
    for name in ("substeps", "iterations", "ls_iterations", "max_contacts"):
        value = getattr(options, name)
        if value is not None and check_whole(name, value) < 1:
            raise ConfigError(f"{name} is {value}, but must be at least 1.")


def _unreadable(xml: Path, error: ValueError) -> str:
    return f"MuJoCo cannot read {xml}: {' '.join(str(error).split())}"
