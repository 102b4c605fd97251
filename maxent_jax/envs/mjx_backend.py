"""Physics on the device: MuJoCo MJX, in jax or in Warp."""

import contextlib
import contextvars
import copy
import importlib
import importlib.util
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx
from mujoco.mjx._src import collision_driver

from maxent_jax.envs.physics import Derived, Physics, PhysicsState
from maxent_jax.errors import ConfigError

WARP_CONTACTS = 2**17  # contacts that Warp has room for, in all environments together
WARP_CONSTRAINTS = 512  # rows of the constraint solver, for each environment


def make(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...], impl: str) -> Physics:
    """Returns the physics of a model in MJX.

    Args:
      model: the model.
      num_substeps: physics steps in a control step.
      derived: fields of MjData to return in addition to the state.
      impl: "jax" or "warp".
    Raises:
      ConfigError: Warp is not installed, or the model has a feature that MJX lacks.
    """
    if impl == "warp":
        if importlib.util.find_spec("warp") is None:
            raise ConfigError(
                "backend 'warp' needs the package warp-lang, which is in the extra 'cuda': "
                "install it, or choose mjx or mujoco"
            )
        importlib.import_module("warp").config.quiet = True  # it reports each kernel it compiles
    model = _for_mjx(model)
    device_model, blank = _put(model, impl, needs_forces="cfrc_ext" in derived)

    def single(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        qpos, qvel, warmstart = state
        data = blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=control)
        data = jax.lax.fori_loop(0, num_substeps, lambda _, d: mjx.step(device_model, d), data)
        after = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
        if "cfrc_ext" in derived and impl == "jax":  # Warp computes it in its step
            data = mjx.rne_postconstraint(device_model, data)
        return after, _fields(data, derived)

    def step(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        with jax.numpy_rank_promotion("allow"), _capsule_frames():  # MJX promotes ranks
            return _batched(single, control.ndim - 1)(state, control)

    return Physics(step, _derive(model, derived))


def center_of_mass(model: mujoco.MjModel) -> Callable[[jax.Array], jax.Array]:
    """Returns the map from positions to the centre of mass: qpos [..., nq] -> [..., 3] metres."""
    device_model = mjx.put_model(_for_mjx(model), impl="jax")
    blank = mjx.make_data(device_model, impl="jax")
    share = jnp.asarray(model.body_mass / model.body_mass.sum(), jnp.float32)

    def single(qpos: jax.Array) -> jax.Array:
        return share @ mjx.kinematics(device_model, blank.replace(qpos=qpos)).xipos

    def of_positions(qpos: jax.Array) -> jax.Array:
        with jax.numpy_rank_promotion("allow"):  # MJX promotes ranks
            return _batched(single, qpos.ndim - 1)(qpos)

    return of_positions


def _for_mjx(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model with options that MJX has."""
    model = copy.copy(model)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # MJX never resets
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:  # MJX has no PGS
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return model


def _put(model: mujoco.MjModel, impl: str, needs_forces: bool) -> tuple[mjx.Model, mjx.Data]:
    """Puts the model on the device; also returns data at rest."""
    try:
        device_model = mjx.put_model(model, impl=impl)
        if impl == "jax":
            return device_model, mjx.make_data(device_model, impl=impl)
        device_model = device_model.tree_replace({"opt._impl.run_rne_postconstraint": needs_forces})
        sizes = dict(naconmax=WARP_CONTACTS, njmax=WARP_CONSTRAINTS)
        return device_model, mjx.make_data(model, impl=impl, **sizes)
    except NotImplementedError as error:
        reason = str(error).splitlines()[0].rstrip(".")
        name = model.names.split(b"\0")[0].decode()
        raise ConfigError(f"MJX cannot simulate '{name}' ({reason}): use backend mujoco") from None


def _derive(model: mujoco.MjModel, derived: tuple[str, ...]) -> Callable[[PhysicsState], Derived]:
    if not derived:
        return lambda state: {}
    device_model = mjx.put_model(model, impl="jax")
    blank = mjx.make_data(device_model, impl="jax")

    def single(qpos: jax.Array, qvel: jax.Array) -> Derived:
        data = blank.replace(qpos=qpos, qvel=qvel)
        data = mjx.com_vel(
            device_model, mjx.com_pos(device_model, mjx.kinematics(device_model, data))
        )
        return _fields(data, derived)

    def derive(state: PhysicsState) -> Derived:
        with jax.numpy_rank_promotion("allow"):
            return _batched(single, state.qpos.ndim - 1)(state.qpos, state.qvel)

    return derive


def _batched(function: Callable, num_axes: int) -> Callable:
    """Maps a function over `num_axes` leading axes."""
    for _ in range(num_axes):
        function = jax.vmap(function)
    return function


def _fields(data: mjx.Data, names: tuple[str, ...]) -> Derived:
    public = ("cvel", "qfrc_actuator")
    return {n: jnp.ravel(getattr(data if n in public else data._impl, n)) for n in names}


# MJX has one table of colliders in a process, and programs are traced in several threads. Its entry
# is therefore replaced once, when this module is imported, and each context chooses for itself.
_COLLIDERS = collision_driver._COLLISION_FUNC
_PAIR = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE)
_plane_capsule = _COLLIDERS[_PAIR]  # MJX's own
_aligns = contextvars.ContextVar("aligns", default=False)


@contextlib.contextmanager
def _capsule_frames() -> Iterator[None]:
    """Aligns the friction of a capsule on a plane with the capsule, as in C, while MJX is traced.

    MJX 3.17 uses the world's y-axis for a capsule within 30 degrees of the plane's normal. That
    turns the friction pyramid: the velocity after one Ant step in ten is 1 to 20 % off, and turning
    the world is no longer a symmetry. See google-deepmind/mujoco, issue 2774.
    """
    before = _aligns.set(True)
    try:
        yield
    finally:
        _aligns.reset(before)


def _plane_on_capsule(model, data, key, geoms):
    """MJX's contacts of planes with capsules; within `_capsule_frames`, with aligned frames."""
    distance, position, frame = _plane_capsule(model, data, key, geoms)
    if not _aligns.get():
        return distance, position, frame
    normal, axis = (data.geom_xmat[geom][..., 2] for geom in geoms.T)
    along = axis - normal * jnp.sum(normal * axis, -1, keepdims=True)
    length = jnp.linalg.norm(along, axis=-1, keepdims=True)
    along = jnp.where(length > 0, along / length, jnp.array([1.0, 0.0, 0.0]))
    frame = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    return distance, position, jnp.repeat(frame, _plane_capsule.ncon, axis=0)


_plane_on_capsule.ncon = _plane_capsule.ncon  # type: ignore[attr-defined]
_COLLIDERS[_PAIR] = _plane_on_capsule
