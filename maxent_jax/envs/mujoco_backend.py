"""C MuJoCo on all cores.

On a CPU, XLA calls it through the native library. Without that library, or on another device, a
callback calls its Python bindings. Both give the same numbers.
"""

import copy
import ctypes
import hashlib
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch

from maxent_jax import native
from maxent_jax.envs.physics import Derived, Physics, PhysicsState

CORES = os.cpu_count() or 1
STATE = ("qpos", "qvel", "qacc_warmstart")  # of a PhysicsState, by their names in MjData
# Of C MuJoCo, in the order that maxent_add_model expects.
FUNCTIONS = ("mj_makeData", "mj_step", "mj_forward", "mj_rnePostConstraint")
Rows = list[np.ndarray]  # [B, ...] each
Simulate = Callable[[PhysicsState, jax.Array], tuple[PhysicsState, Derived]]
_added: dict[str, mujoco.MjModel] = {}  # the native library keeps pointers to these


def make(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> Physics:
    """Returns the physics of a model in C MuJoCo.

    Args:
      model: the model.
      num_substeps: physics steps in a control step.
      derived: fields of MjData to return in addition to the state.
    """
    model = copy.copy(model)  # the caller may change the original
    step = _simulate(model, num_substeps, derived)
    if not derived:
        return Physics(step, lambda state: {})
    look = _simulate(model, 0, derived)

    def derive(state: PhysicsState) -> Derived:
        return look(state, jnp.zeros((*state.qpos.shape[:-1], model.nu)))[1]

    return Physics(step, derive)


def _simulate(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> Simulate:
    """A control step or, with 0 substeps, an evaluation of the state, by the fastest way."""
    by_python = through_python(model, num_substeps, derived)
    by_xla = through_xla(model, num_substeps, derived)
    if by_xla is None:
        return by_python

    def simulate(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        return jax.lax.platform_dependent(state, control, cpu=by_xla, default=by_python)

    return simulate


def through_xla(
    model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]
) -> Simulate | None:
    """Returns the native library's simulation, for a CPU; None if no library can step the model."""
    name = _add(model, derived)
    if name is None:
        return None
    sizes = _sizes(model, derived)

    def simulate(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        widths = [*(x.shape[-1] for x in state), sum(sizes.values())]
        shapes = [jax.ShapeDtypeStruct((*control.shape[:-1], n), jnp.float32) for n in widths]
        call = jax.ffi.ffi_call("maxent_physics", shapes, vmap_method="broadcast_all")
        *after, fields = call(*state, control, model=name, num_substeps=np.int64(num_substeps))
        ends = np.cumsum(list(sizes.values()), dtype=int)[:-1]
        parts = jnp.split(fields, ends, axis=-1) if sizes else []
        return PhysicsState(*after), dict(zip(sizes, parts, strict=True))

    return simulate


def through_python(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> Simulate:
    """Returns the simulation by Python's bindings in a callback, for any device."""
    sizes = _sizes(model, derived)
    simulator: Callable[[Rows], Rows] = (
        _Threads(model, num_substeps, derived) if derived else _Batches(model, num_substeps)
    )

    def rows(*arrays):
        flat = [np.asarray(x).reshape(-1, x.shape[-1]) for x in arrays]
        lead = arrays[0].shape[:-1]
        # A diverging simulation becomes inf; base.step ends its episode.
        with np.errstate(over="ignore"):
            return [x.reshape(*lead, -1).astype(np.float32) for x in simulator(flat)]

    def simulate(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        widths = [*(x.shape[-1] for x in state), *sizes.values()]
        shapes = [jax.ShapeDtypeStruct((*control.shape[:-1], n), jnp.float32) for n in widths]
        found = jax.pure_callback(rows, shapes, *state, control, vmap_method="broadcast_all")
        return PhysicsState(*found[:3]), dict(zip(derived, found[3:], strict=True))

    return simulate


def _sizes(model: mujoco.MjModel, derived: tuple[str, ...]) -> dict[str, int]:
    scratch = mujoco.MjData(model)
    return {name: getattr(scratch, name).size for name in derived}


def _add(model: mujoco.MjModel, derived: tuple[str, ...]) -> str | None:
    """Adds a model to the native library and returns its name; None if it cannot be stepped."""
    library = native.library()
    if library is None or library.maxent_mujoco_version() != mujoco.mj_version():
        return None
    # A hash of the content as the name: programs that another process compiled find the model too.
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    name = hashlib.sha256(content.tobytes() + " ".join(derived).encode()).hexdigest()
    if name in _added:
        return name
    loaded = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
    functions = [ctypes.cast(getattr(loaded, f), ctypes.c_void_p) for f in FUNCTIONS]
    sizes = _sizes(model, derived).values()
    known = library.maxent_add_model(
        name.encode(),
        ctypes.c_void_p(model._address),
        (ctypes.c_void_p * len(functions))(*functions),
        (ctypes.c_char_p * len(derived))(*(field.encode() for field in derived)),
        (ctypes.c_int64 * len(derived))(*sizes),
        ctypes.c_int64(len(derived)),
    )
    if not known:
        return None
    _added[name] = model
    return name


class _Batches:
    """mujoco.batch: steps whole batches, without Python between their rows.

    A pure function of its arguments: it keeps only scratch space.
    """

    def __init__(self, model: mujoco.MjModel, num_substeps: int):
        self._model, self._num_substeps = model, num_substeps
        self._batches: dict[int, batch.Batch] = {}
        self._lock = threading.Lock()

    def __call__(self, rows: Rows) -> Rows:
        with self._lock:
            simulations = self._batch(len(rows[0]))
            for name, values in zip((*STATE, "ctrl"), rows, strict=True):
                simulations.bind(name)[:] = values
            simulations.bind("time")[:] = 0
            simulations.step(nstep=self._num_substeps)
            return [simulations.bind(name).copy() for name in STATE]

    def _batch(self, rows: int) -> batch.Batch:
        if rows not in self._batches:
            self._batches[rows] = batch.Batch(self._model, rows, CORES)
        return self._batches[rows]


class _Threads:
    """Steps row by row, with one MjData for each core.

    The derived fields are those after mj_step and, as in Gymnasium, mj_rnePostConstraint, which no
    batched call of MuJoCo makes. With 0 substeps the state is evaluated, not stepped, and external
    forces are 0.
    """

    def __init__(self, model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]):
        self._model, self._num_substeps, self._derived = model, num_substeps, derived
        self._data = [mujoco.MjData(model) for _ in range(CORES)]
        self._pool = ThreadPoolExecutor(CORES)
        self._lock = threading.Lock()

    def __call__(self, rows: Rows) -> Rows:
        count = len(rows[0])
        names = (*STATE, *self._derived)
        found = [np.empty((count, getattr(self._data[0], name).size)) for name in names]
        parts = np.array_split(np.arange(count), CORES)
        with self._lock:
            list(self._pool.map(lambda d, part: self._run(d, part, rows, found), self._data, parts))
        return found

    def _run(self, data: mujoco.MjData, part: Sequence[int], rows: Rows, found: Rows) -> None:
        inputs = [getattr(data, name) for name in (*STATE, "ctrl")]
        outputs = [getattr(data, name).ravel() for name in (*STATE, *self._derived)]
        for row in part:
            data.time = 0
            for field, values in zip(inputs, rows, strict=True):
                field[:] = values[row]
            if self._num_substeps:
                mujoco.mj_step(self._model, data, self._num_substeps)
                mujoco.mj_rnePostConstraint(self._model, data)
            else:
                data.cfrc_ext[:] = 0
                mujoco.mj_forward(self._model, data)
            for field, values in zip(outputs, found, strict=True):
                values[row] = field
