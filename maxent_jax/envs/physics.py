"""What physics is: a state, the options of a model, and the type of a step.

`step(state, control) -> (state, derived)` is a pure function of any leading axes, which may be
jitted, scanned and vmapped. The backends (mjx_backend, mujoco_backend) run the same model with the
same options; the rest of the program cannot tell them apart.
"""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco

from maxent_jax.errors import ConfigError


class PhysicsState(NamedTuple):
    """All that the next step depends on: with the warm start in it, every backend is a function."""

    qpos: jax.Array  # [..., nq] metres, unit quaternion, radians
    qvel: jax.Array  # [..., nv] metres and radians per second
    warmstart: jax.Array  # [..., nv] acceleration from which the constraint solver starts


Derived = dict[str, jax.Array]
"""Fields of MjData that a task observes beside the state, each [..., its size]."""


class Physics(NamedTuple):
    """A model on a backend."""

    step: Callable[[PhysicsState, jax.Array], tuple[PhysicsState, Derived]]
    """One control step, the control held. The derived fields are those that Gymnasium reads after
    mj_step and mj_rnePostConstraint: they belong to the last evaluation of the dynamics."""
    derive: Callable[[PhysicsState], Derived]
    """The derived fields of a start, before any control or external force."""


class Options(NamedTuple):
    """What is changed in an XML's physics; None and the defaults keep it."""

    integrator: str | None = None  # Euler, RK4 or implicitfast
    substeps: int = 1  # physics steps in each of the XML's: its time step is divided
    solver: str | None = None  # Newton, CG or PGS
    iterations: int | None = None  # of the constraint solver, at most
    ls_iterations: int | None = None  # of its line search, at most
    eulerdamp: bool = True  # Euler integrates joint damping implicitly
    self_collisions: bool = True  # else a body collides with the world alone
    max_contacts: int | None = None  # MJX keeps this many, the deepest, of each kind of contact


REFERENCE = Options()
MUJOCO_LOG = "MUJOCO_LOG.TXT"  # where C MuJoCo writes, unless told of another place
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
    """A file among the models of the installed gymnasium package."""
    spec = importlib.util.find_spec("gymnasium")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / name


def keep_no_log() -> None:
    """Keeps C MuJoCo from leaving its warnings in the working folder too; the console has them.

    Of a diverging simulation it writes a line for each warning. A log file that the user chose by
    MjLogConfig stays.
    """
    config = mujoco.MjLogConfig.get()
    if config.logfile == MUJOCO_LOG and config.logto_file:
        config.logto_file = False
        mujoco.MjLogConfig.set(config)


def load_model(xml: Path, options: Options = REFERENCE) -> mujoco.MjModel:
    """The MuJoCo model of a file, with its options changed.

    Raises:
      ConfigError: MuJoCo cannot read the file.
    """
    keep_no_log()
    try:
        spec = mujoco.MjSpec.from_file(str(xml))
    except ValueError as error:
        raise ConfigError(_unreadable(xml, error)) from None
    if options.max_contacts is not None:
        for numeric in spec.numerics:  # MJX 3.17 finds its own only if no other stands before it
            spec.delete(numeric)
        spec.add_numeric(name="max_contact_points", size=1, data=[options.max_contacts])
    try:
        model = spec.compile()
    except ValueError as error:  # of a mesh that is missing, for example
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
    # A diverging simulation must show as such: MuJoCo would put it back to its rest pose unsaid.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def _unreadable(xml: Path, error: ValueError) -> str:
    return f"MuJoCo cannot read {xml}: {' '.join(str(error).split())}"
