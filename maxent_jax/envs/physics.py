"""Physics as one pure function: a Gymnasium XML, a profile and a backend give a step.

`step(state, control) -> state` takes any leading axes and may be jitted, scanned and vmapped. The
backends `mjx` (on the device) and `mujoco` (C MuJoCo, threaded, behind a callback) run the same
model with the same options; the rest of the program cannot tell them apart.
"""

import contextlib
import importlib.util
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch, mjx
from mujoco.mjx._src import collision_driver

BACKENDS = ("auto", "mjx", "mujoco", "warp")
PROFILES = ("reference", "fast")


class PhysicsState(NamedTuple):
    """All that the next step depends on: with the warm start in it, both backends are functions."""

    qpos: jax.Array  # [..., nq] metres, unit quaternion, radians
    qvel: jax.Array  # [..., nv] metres and radians per second
    warmstart: jax.Array  # [..., nv] acceleration from which the constraint solver starts


Step = Callable[[PhysicsState, jax.Array], PhysicsState]


def load_model(xml: str, profile: str) -> mujoco.MjModel:
    """The MuJoCo model of a file in the installed gymnasium package.

    Args:
      xml: file name in gymnasium/envs/mujoco/assets.
      profile: "reference" keeps the XML's options; "fast" bounds the constraint solver to
        4 iterations of 8 line-search steps, for MJX, where every iteration is paid for by all
        environments at once.
    Raises:
      ValueError: unknown profile.
    """
    if profile not in PROFILES:
        raise ValueError(f"unknown physics '{profile}': choose one of {', '.join(PROFILES)}")
    spec = importlib.util.find_spec("gymnasium")
    assert spec is not None and spec.origin is not None
    path = Path(spec.origin).parent / "envs" / "mujoco" / "assets" / xml
    model = mujoco.MjModel.from_xml_path(str(path))
    # A diverging simulation must show as such: MuJoCo would put it back to its rest pose unsaid.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if profile == "fast":
        model.opt.iterations, model.opt.ls_iterations = 4, 8
    return model


def resolve_backend(backend: str) -> str:
    """The backend that runs: "auto" is `mujoco` on a CPU and `mjx` on anything else.

    Raises:
      ValueError: unknown backend, or one that cannot run here.
    """
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend '{backend}': choose one of {', '.join(BACKENDS)}")
    if backend == "warp":
        raise ValueError("backend 'warp' is not available in this release: choose mjx or mujoco")
    if backend == "auto":
        return "mujoco" if jax.default_backend() == "cpu" else "mjx"
    return backend


def make_step(model: mujoco.MjModel, backend: str, frame_skip: int) -> Step:
    """One control step of `frame_skip` physics steps, control held, as a pure function."""
    if resolve_backend(backend) == "mujoco":
        return _threaded_step(model, frame_skip)
    return _mjx_step(model, frame_skip)


def _mjx_step(model: mujoco.MjModel, frame_skip: int) -> Step:
    device_model = mjx.put_model(model, impl="jax")
    blank = mjx.make_data(device_model, impl="jax")

    def single(qpos, qvel, warmstart, control):
        data = blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=control)
        data = jax.lax.fori_loop(0, frame_skip, lambda _, d: mjx.step(device_model, d), data)
        return data.qpos, data.qvel, data.qacc_warmstart

    batched = jnp.vectorize(single, signature="(q),(v),(v),(u)->(q),(v),(v)")

    def step(state: PhysicsState, control: jax.Array) -> PhysicsState:
        with jax.numpy_rank_promotion("allow"), _capsule_frames():  # MJX promotes ranks
            return PhysicsState(*batched(*state, control))

    return step


@contextlib.contextmanager
def _capsule_frames() -> Iterator[None]:
    """While MJX is traced: friction at a capsule on a plane lies along the capsule, as in C.

    MJX 3.17 takes the world's y-axis for a capsule within 30 degrees of the plane's normal. That
    turns the pyramid of friction: one Ant step in ten ends 1 to 20 % off in velocity, and turning
    the world is no symmetry any more. See google-deepmind/mujoco, issue 2774.
    """
    colliders = collision_driver._COLLISION_FUNC
    pair = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE)
    original = colliders[pair]

    def aligned(model, data, key, geoms):
        distance, position, _ = original(model, data, key, geoms)
        normal, axis = (data.geom_xmat[geom][..., 2] for geom in geoms.T)
        along = axis - normal * jnp.sum(normal * axis, -1, keepdims=True)
        length = jnp.linalg.norm(along, axis=-1, keepdims=True)
        along = jnp.where(length > 0, along / length, jnp.array([1.0, 0.0, 0.0]))
        frame = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
        return distance, position, jnp.repeat(frame, original.ncon, axis=0)

    aligned.ncon = original.ncon  # type: ignore[attr-defined]
    colliders[pair] = aligned
    try:
        yield
    finally:
        colliders[pair] = original


def _threaded_step(model: mujoco.MjModel, frame_skip: int) -> Step:
    simulate = _Simulator(model, frame_skip)

    def step(state: PhysicsState, control: jax.Array) -> PhysicsState:
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
        after = jax.pure_callback(
            simulate, tuple(shapes), tuple(state), control, vmap_method="broadcast_all"
        )
        return PhysicsState(*after)

    return step


class _Simulator:
    """C MuJoCo on all cores. A pure function of its arguments: batches are only scratch space."""

    def __init__(self, model: mujoco.MjModel, frame_skip: int):
        self._model, self._frame_skip = model, frame_skip
        self._batches: dict[int, batch.Batch] = {}
        self._lock = threading.Lock()

    def __call__(
        self, state: tuple[np.ndarray, ...], control: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        state = tuple(np.asarray(x) for x in state)
        rows = int(np.prod(state[0].shape[:-1]))
        with self._lock:
            simulations = self._batch(rows)
            fields = [simulations.bind(name) for name in ("qpos", "qvel", "qacc_warmstart")]
            for field, value in zip(fields, state, strict=True):
                field[:] = value.reshape(rows, -1)
            simulations.bind("ctrl")[:] = np.asarray(control).reshape(rows, -1)
            simulations.bind("time")[:] = 0
            simulations.step(nstep=self._frame_skip)
            with np.errstate(over="ignore"):  # a diverging simulation becomes inf, and is guarded
                return tuple(
                    field.reshape(value.shape).astype(value.dtype)
                    for field, value in zip(fields, state, strict=True)
                )

    def _batch(self, rows: int) -> batch.Batch:
        if rows not in self._batches:
            self._batches[rows] = batch.Batch(self._model, rows, os.cpu_count() or 1)
        return self._batches[rows]
