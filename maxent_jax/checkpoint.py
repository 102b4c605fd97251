"""The whole state of a run on disk, and back. A step is the number of iterations completed.

The archive and the visits are items of their own, so that analysis loads them without the replay.
"""

import contextlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
from orbax.checkpoint import v1 as ocp

from maxent_jax import algorithm
from maxent_jax.algorithm import State
from maxent_jax.config import Config
from maxent_jax.mixture import Archive
from maxent_jax.runs import CheckpointError
from maxent_jax.training import Visits

FOLDER = "checkpoints"
STEPS_KEPT = 2


class Results(NamedTuple):
    """What analysis needs of a state. With several seeds, leaves have a leading axis [S, ...]."""

    archive: Archive
    visits: Visits
    random_visits: Visits


def save(run_directory: Path, state: State, step: int) -> None:
    """Writes the state; complete or, to all who look, not there. Older steps go.

    With several processes each calls it, and writes its part of the state.

    Args:
      step: iterations completed.
    """
    with _open(run_directory, cleanup_tmp_directories=True) as checkpointer:
        checkpointer.save_checkpointables(step, _items(_without_typed_key(state)), overwrite=True)


def latest_step(run_directory: Path) -> int | None:
    """The last complete step, None if there is none."""
    if not (run_directory / FOLDER).is_dir():
        return None
    with _open(run_directory) as checkpointer:
        return None if checkpointer.latest is None else checkpointer.latest.step


def restore(run_directory: Path, config: Config, placed: State | None = None) -> State:
    """The state of the last complete step, on whatever devices it was saved from.

    Args:
      placed: the sharding of each leaf, see devices.placement; one device if left out.
    Raises:
      CheckpointError: there is none.
    """
    items = _load(run_directory, _items(_abstract(config, placed)))
    results, rest = items["results"], items["rest"]
    learner = rest.learner._replace(visits=results.visits, random_visits=results.random_visits)
    key = jax.random.wrap_key_data(rest.key)
    return rest._replace(key=key, archive=results.archive, learner=learner)


def restore_results(run_directory: Path, config: Config) -> Results:
    """The archive and visits of the last complete step, without the replay.

    Raises:
      CheckpointError: there is none.
    """
    return _load(run_directory, {"results": _items(_abstract(config))["results"]})["results"]


def _items(state: State) -> dict[str, Any]:
    learner = state.learner
    return {
        "results": Results(state.archive, learner.visits, learner.random_visits),
        "rest": state._replace(
            archive=None,  # type: ignore[arg-type]
            learner=learner._replace(visits=None, random_visits=None),  # type: ignore[arg-type]
        ),
    }


def _without_typed_key(state: State) -> State:
    return state._replace(key=jax.random.key_data(state.key))


def _abstract(config: Config, placed: State | None = None) -> State:
    shapes = jax.eval_shape(lambda: _without_typed_key(algorithm.start(config)))
    if placed is None:
        device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        placed = jax.tree.map(lambda _: device, shapes)
    return jax.tree.map(
        lambda x, sharding: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding),
        shapes,
        placed,
    )


def _load(run_directory: Path, abstract: dict[str, Any]) -> dict[str, Any]:
    step = latest_step(run_directory)
    if step is None:
        raise CheckpointError(f"{run_directory} holds no complete checkpoint.")
    try:
        with _open(run_directory) as checkpointer:
            return checkpointer.load_checkpointables(step, abstract)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(
            f"checkpoint {step} of {run_directory} is damaged: {reason}"
        ) from error


@contextlib.contextmanager
def _open(run_directory: Path, **options):
    keep = ocp.training.preservation_policies.LatestN(STEPS_KEPT)
    folder = (run_directory / FOLDER).absolute()
    with ocp.training.Checkpointer(folder, preservation_policy=keep, **options) as checkpointer:
        yield checkpointer
