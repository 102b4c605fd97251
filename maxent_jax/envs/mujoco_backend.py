"""C MuJoCo on all cores, called from XLA.

On a CPU, XLA calls it through the native library. Without that library, or on another device, a
callback calls its Python bindings (mujoco_bindings.py). Both give the same numbers.
"""

import copy
import ctypes
import hashlib
import itertools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from maxent_jax import native
from maxent_jax.envs import mujoco_bindings
from maxent_jax.envs.physics import Derived, Physics, PhysicsState, StepBeside, Work

# Of C MuJoCo, in the order that maxent_add_model expects.
FUNCTIONS = ("mj_makeData", "mj_step", "mj_forward", "mj_rnePostConstraint")
Simulate = Callable[[PhysicsState, jax.Array], tuple[PhysicsState, Derived]]


class Halves(NamedTuple):
    """A control step in two halves; what is computed between them runs beside the simulation."""

    start: Callable[[PhysicsState, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
    """State, control and the words of a key [W] uint32 -> a ticket [] int32 and the same words,
    from which the computation between must start."""
    finish: Callable[[jax.Array, jax.Array, PhysicsState, jax.Array], tuple[PhysicsState, Derived]]
    """A ticket, a number [] that the computation between ends with, and the state and control
    before the step (only for their shapes) -> the state after the step, and its derived fields."""


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
    step_beside = _beside(model, num_substeps, derived)
    if not derived:
        return Physics(step, lambda state: {}, step_beside)
    look = _simulate(model, 0, derived)

    def derive(state: PhysicsState) -> Derived:
        return look(state, jnp.zeros((*state.qpos.shape[:-1], model.nu)))[1]

    return Physics(step, derive, step_beside)


def _simulate(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> Simulate:
    """A control step or, with 0 substeps, an evaluation of the state, by the fastest way."""
    by_python = through_python(model, num_substeps, derived)
    by_xla = through_xla(model, num_substeps, derived)
    return by_python if by_xla is None else _on_cpu(by_xla, by_python)


def _beside(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> StepBeside:
    """A control step beside another computation, by the fastest way."""
    halves = halves_through_python(model, num_substeps, derived)
    by_xla = halves_through_xla(model, num_substeps, derived)
    if by_xla is not None:
        halves = Halves(_on_cpu(by_xla.start, halves.start), _on_cpu(by_xla.finish, halves.finish))
    return beside(halves)


def beside(halves: Halves) -> StepBeside:
    """Returns the step that computes something else between its two halves."""

    def step_beside(
        state: PhysicsState, control: jax.Array, work: Work, key: jax.Array
    ) -> tuple[tuple[PhysicsState, Derived], Any]:
        ticket, words = halves.start(state, control, jax.random.key_data(key))
        result, last = work(jax.random.wrap_key_data(words, impl=jax.random.key_impl(key)))
        return halves.finish(ticket, last, state, control), result

    return step_beside


def _on_cpu(by_xla: Callable, by_python: Callable) -> Callable:
    def either(*args):
        return jax.lax.platform_dependent(*args, cpu=by_xla, default=by_python)

    return either


def through_xla(
    model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]
) -> Simulate | None:
    """Returns the native library's simulation, for a CPU; None if no library can step the model."""
    name = _add(model, derived)
    if name is None:
        return None
    sizes = _sizes(model, derived)

    def simulate(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        call = jax.ffi.ffi_call(
            "maxent_physics",
            _shapes(state, control, [sum(sizes.values())]),
            vmap_method="broadcast_all",
        )
        found = call(*state, control, model=name, num_substeps=np.int64(num_substeps))
        return _divided(found, sizes)

    return simulate


def halves_through_xla(
    model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]
) -> Halves | None:
    """Returns the native library's simulation in two halves; None as `through_xla`."""
    name = _add(model, derived)
    if name is None:
        return None
    sizes = _sizes(model, derived)

    def start(
        state: PhysicsState, control: jax.Array, words: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        call = jax.ffi.ffi_call(
            "maxent_physics_start", _tickets(words), vmap_method="broadcast_all"
        )
        ticket, words = call(
            *(*state, control, words),
            model=name,
            num_substeps=np.int64(num_substeps),
            derived_size=np.int64(sum(sizes.values())),
        )
        return ticket, words

    def finish(
        ticket: jax.Array, last: jax.Array, state: PhysicsState, control: jax.Array
    ) -> tuple[PhysicsState, Derived]:
        call = jax.ffi.ffi_call(
            "maxent_physics_finish",
            _shapes(state, control, [sum(sizes.values())]),
            vmap_method="broadcast_all",
        )
        return _divided(call(ticket, last), sizes)

    return Halves(start, finish)


def through_python(model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]) -> Simulate:
    """Returns the simulation by Python's bindings in a callback, for any device."""
    sizes = _sizes(model, derived)
    rows = mujoco_bindings.simulator(model, num_substeps, derived)

    def simulate(state: PhysicsState, control: jax.Array) -> tuple[PhysicsState, Derived]:
        shapes = _shapes(state, control, sizes.values())
        found = jax.pure_callback(rows, shapes, *state, control, vmap_method="broadcast_all")
        return PhysicsState(*found[:3]), dict(zip(derived, found[3:], strict=True))

    return simulate


def halves_through_python(
    model: mujoco.MjModel, num_substeps: int, derived: tuple[str, ...]
) -> Halves:
    """Returns the simulation by Python's bindings in two halves, for any device."""
    sizes = _sizes(model, derived)
    rows = mujoco_bindings.simulator(model, num_substeps, derived)
    pool = ThreadPoolExecutor(1)
    started: dict[int, Future] = {}
    tickets = itertools.count(1)

    def begin(*arrays):
        *inputs, words = arrays
        number = next(tickets)
        # XLA may use the memory of the inputs again before they are read
        started[number] = pool.submit(rows, *(np.array(x) for x in inputs))
        return np.full(words.shape[:-1], number, np.int32), words

    def end(ticket, last):
        del last
        return started.pop(int(np.ravel(ticket)[0])).result()

    def start(
        state: PhysicsState, control: jax.Array, words: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        inputs = (*state, control, words)
        ticket, words = jax.pure_callback(
            begin, _tickets(words), *inputs, vmap_method="broadcast_all"
        )
        return ticket, words

    def finish(
        ticket: jax.Array, last: jax.Array, state: PhysicsState, control: jax.Array
    ) -> tuple[PhysicsState, Derived]:
        shapes = _shapes(state, control, sizes.values())
        found = jax.pure_callback(end, shapes, ticket, last, vmap_method="broadcast_all")
        return PhysicsState(*found[:3]), dict(zip(derived, found[3:], strict=True))

    return Halves(start, finish)


def _shapes(
    state: PhysicsState, control: jax.Array, of_derived: Iterable[int]
) -> list[jax.ShapeDtypeStruct]:
    widths = [*(x.shape[-1] for x in state), *of_derived]
    return [jax.ShapeDtypeStruct((*control.shape[:-1], n), jnp.float32) for n in widths]


def _tickets(words: jax.Array) -> list[jax.ShapeDtypeStruct]:
    return [
        jax.ShapeDtypeStruct(words.shape[:-1], jnp.int32),
        jax.ShapeDtypeStruct(words.shape, words.dtype),
    ]


def _divided(found: Sequence[jax.Array], sizes: dict[str, int]) -> tuple[PhysicsState, Derived]:
    *after, fields = found
    ends = np.cumsum(list(sizes.values()), dtype=int)[:-1]
    parts = jnp.split(fields, ends, axis=-1) if sizes else []
    return PhysicsState(*after), dict(zip(sizes, parts, strict=True))


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
