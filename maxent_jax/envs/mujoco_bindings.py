"""C MuJoCo's Python bindings: control steps of many rows of numpy arrays, on all cores."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from mujoco import batch

CORES = os.cpu_count() or 1
STATE = ("qpos", "qvel", "qacc_warmstart")  # of a PhysicsState, by their names in MjData
Rows = list[np.ndarray]  # [B, ...] each


def simulator(
    model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]
) -> Callable[..., Rows]:
    """Returns the simulation of numpy arrays with any leading axes.

    Args:
      model: the model.
      num_substeps: physics steps in a control step; with 0 the state is evaluated, not stepped.
      derived: fields of MjData to return in addition to the state.
    Returns:
      A function of the three arrays of a PhysicsState and the controls. It returns the state after
      the step, and the derived fields, in float32.
    """
    simulate: Callable[[Rows], Rows] = (
        _Threads(model, num_substeps, derived) if derived else _Batches(model, num_substeps)
    )

    def of_arrays(*arrays: np.ndarray) -> Rows:
        flat = [np.asarray(x).reshape(-1, x.shape[-1]) for x in arrays]
        lead = arrays[0].shape[:-1]
        # A diverging simulation becomes inf; base.step ends its episode.
        with np.errstate(over="ignore"):
            return [x.reshape(*lead, -1).astype(np.float32) for x in simulate(flat)]

    return of_arrays


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
