"""Physics on the host: C MuJoCo on all cores, behind a callback."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch

from maxent_jax.envs.physics import Derived, Physics, PhysicsState

CORES = os.cpu_count() or 1
STATE = ("qpos", "qvel", "qacc_warmstart")  # a PhysicsState, as MjData names it
Rows = list[np.ndarray]  # [B, ...] each


def make(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> Physics:
    """The model in C.

    Args:
      num_substeps: physics steps in a control step.
      derived: fields of MjData to give beside the state.
    """
    scratch = mujoco.MjData(model)
    outputs = [*STATE, *derived]
    sizes = [getattr(scratch, name).size for name in outputs]
    simulate = _Threads(model, num_substeps, derived) if derived else _Batches(model, num_substeps)

    def call(simulator: Callable[[Rows], Rows], state: PhysicsState, control: jax.Array):
        leading = control.shape[:-1]
        shapes = [jax.ShapeDtypeStruct((*leading, n), control.dtype) for n in sizes]

        def rows(*arrays):
            flat = [np.asarray(x).reshape(-1, x.shape[-1]) for x in arrays]
            lead = arrays[0].shape[:-1]
            # A diverging simulation becomes inf, and is guarded against.
            with np.errstate(over="ignore"):
                return [x.reshape(*lead, -1).astype(np.float32) for x in simulator(flat)]

        found = jax.pure_callback(rows, shapes, *state, control, vmap_method="broadcast_all")
        return PhysicsState(*found[:3]), dict(zip(derived, found[3:], strict=True))

    def step(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        return call(simulate, state, control)

    if not derived:
        return Physics(step, lambda state: {})
    look = _Threads(model, 0, derived)

    def derive(state: PhysicsState) -> Derived:
        return call(look, state, jnp.zeros((*state.qpos.shape[:-1], model.nu)))[1]

    return Physics(step, derive)


class _Batches:
    """mujoco.batch: whole batches, without Python between their rows.

    A pure function of its arguments: what it holds is only scratch space.
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
    """One MjData for each core, its rows one by one: the derived fields are those of mj_step and,
    as in Gymnasium, mj_rnePostConstraint, which no batched call of MuJoCo's makes.

    With 0 substeps it looks at the state instead of stepping it, and external forces are 0.
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
