"""Saves and restores a run: its whole state, its config, and what it has measured.

A checkpoint is a folder named by the progress of the run. It is written under another name and
renamed once it is complete and sealed, so a folder with its final name that is incomplete is
damaged. See stored.py for the arrays in it.
"""

import contextlib
import functools
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from maxent_jax import algorithm
from maxent_jax.algorithm import State
from maxent_jax.config import Config
from maxent_jax.errors import CheckpointError, SaveError
from maxent_jax.runs import atomic, files, integrity, stored
from maxent_jax.runs.integrity import ARRAYS, FOLDER, UNFINISHED
from maxent_jax.runs.stored import Results
from maxent_jax.sac.agent import Parameters

CHECKPOINTS_KEPT = 2
WITH_MOMENTS = 5  # from this schema on, an agent can have moments of its inputs
# In a checkpoint's folder, in addition to config.json and metrics.jsonl:
PROGRESS, PARTIAL = "progress.json", "partial.npz"


class Progress(NamedTuple):
    """What a run has measured so far; its metrics are made from it."""

    rows: list[dict[str, Any]]  # one for each complete iteration, as in metrics.jsonl
    begun: dict[str, np.ndarray] | None  # from the beginning of the next iteration, if it has begun
    segments: list[dict[str, np.ndarray]]  # from each of its segments so far
    clock: dict[str, Any]  # seconds by name

    @property
    def name(self) -> str:
        """The checkpoint's name: 3 after three iterations, 3+7 after seven segments of the next."""
        return f"{len(self.rows)}" + ("" if self.begun is None else f"+{len(self.segments)}")


class Latest(NamedTuple):
    """What analysis needs of a run's latest checkpoint."""

    name: str
    results: Results
    rows: list[dict[str, Any]]  # as in metrics.jsonl
    passed_over: dict[str, str]  # by name, a sentence on each damaged checkpoint


def save(run_directory: Path, state: State, progress: Progress, machine: dict[str, Any]) -> None:
    """Writes a checkpoint atomically, then removes older ones.

    With several processes, each calls this function and writes its share of the arrays.

    Args:
      machine: what the state was computed on, in addition to the versions of the software.
    Raises:
      SaveError: the checkpoint cannot be written; earlier ones are intact.
    """
    folder = run_directory / FOLDER
    temporary = (folder / f"{UNFINISHED}{progress.name}").absolute()
    first = jax.process_index() == 0
    try:
        if first:
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir(parents=True)
        with _silence():
            ocp.save_checkpointables(temporary / ARRAYS, stored.items(stored.encode(state)))
        if first:
            shutil.copy(run_directory / files.CONFIG, temporary)
            files.write_metrics(temporary, progress.rows)
            _write_progress(temporary, progress, machine)
            integrity.seal(temporary)
            if (folder / progress.name).exists():
                integrity.remove(run_directory, progress.name)
            temporary.rename(folder / progress.name)
            for old in integrity.checkpoints(run_directory)[:-CHECKPOINTS_KEPT]:
                integrity.remove(run_directory, old)
    except (OSError, ValueError, SaveError) as error:  # TensorStore raises ValueErrors
        shutil.rmtree(temporary, ignore_errors=True)
        raise SaveError(
            f"cannot save checkpoint {progress.name} of {run_directory}: {_reason(error)}; "
            f"earlier checkpoints are intact."
        ) from error


def read_progress(run_directory: Path, name: str) -> tuple[Progress, dict[str, Any]]:
    """Returns what the run had measured at a checkpoint, and what it was computed with."""
    folder = run_directory / FOLDER / name
    content = json.loads((folder / PROGRESS).read_text(encoding="utf-8"))
    begun, segments = None, []
    if content["begun"]:
        with np.load(folder / PARTIAL) as arrays:
            parts = {key: arrays[key] for key in arrays.files}
        begun = _beneath("begun/", parts)
        segments = [_beneath(f"{i}/", parts) for i in range(content["segments"])]
    rows = files.read_metrics(folder)
    return Progress(rows, begun, segments, content["clock"]), content["computed_with"]


def restore(run_directory: Path, name: str, config: Config, placed: State | None = None) -> State:
    """Restores the state of a checkpoint, whatever devices it was saved from.

    Args:
      placed: the sharding of each leaf, see devices.placement; one device if left out.
    Raises:
      CheckpointError: the checkpoint does not hold a state of this config.
    """
    shapes = _shapes(config)
    wanted = stored.items(stored.abstract(shapes, placed))
    held = _held(run_directory, name)
    wanted["rest"] = stored.held_part(wanted["rest"], held)
    items = _load(run_directory, name, wanted)
    results, rest = items["results"], stored.completed(items["rest"], shapes, placed)
    learner = rest.learner._replace(visits=results.visits, random_visits=results.random_visits)
    return stored.decode(rest._replace(archive=results.archive, learner=learner), shapes, placed)


def restore_latest(
    run_directory: Path, config: Config, remedy: str, fallback: bool = False
) -> Latest:
    """Restores the results of the latest checkpoint, also while the run trains and removes it.

    Args:
      remedy: as in `integrity.find`.
      fallback: as in `integrity.find`.
    Raises:
      CheckpointError: the run has no checkpoint, or it does not hold results of this config.
      CheckpointCorruptError: as in `integrity.find`.
    """
    name, passed_over = integrity.find(run_directory, False, fallback, remedy)
    try:
        results = restore_results(run_directory, name, config)
        rows = read_progress(run_directory, name)[0].rows
    except Exception:
        if (run_directory / FOLDER / name).exists():
            raise
        return restore_latest(run_directory, config, remedy, fallback)
    return Latest(name, results, rows, passed_over)


def restore_results(run_directory: Path, name: str, config: Config) -> Results:
    """Restores the archive and visits of a checkpoint, without the replay.

    Raises:
      CheckpointError: the checkpoint does not hold results of this config.
    """
    results: Results = stored.items(stored.abstract(_shapes(config)))["results"]
    if files.read_schema(run_directory) >= WITH_MOMENTS:
        return _load(run_directory, name, {"results": results})["results"]
    less: Any = results.archive.parameters._asdict()
    del less["moments"]
    older = results._replace(archive=results.archive._replace(parameters=less))
    found = _load(run_directory, name, {"results": older})["results"]
    parameters = Parameters(**found.archive.parameters)
    return found._replace(archive=found.archive._replace(parameters=parameters))


def _held(run_directory: Path, name: str) -> Mapping[str, Any]:
    """The fields of the learner that the checkpoint holds; older ones lack those added since."""
    path = (run_directory / FOLDER / name / ARRAYS).absolute()
    return ocp.checkpointables_metadata(path).metadata["rest"]["learner"]


def _write_progress(folder: Path, progress: Progress, machine: dict[str, Any]) -> None:
    parts = {f"begun/{key}": value for key, value in (progress.begun or {}).items()}
    for i, segment in enumerate(progress.segments):
        parts |= {f"{i}/{key}": value for key, value in segment.items()}
    if progress.begun is not None:
        np.savez(folder / PARTIAL, **parts)  # type: ignore[arg-type]
    content = {
        "begun": progress.begun is not None,
        "segments": len(progress.segments),
        "clock": progress.clock,
        "computed_with": files.stack() | machine,
    }
    atomic.write_json(folder / PROGRESS, content)


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Silences Orbax's threads, which print tracebacks of errors that Orbax also raises."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _reason(error: Exception) -> str:
    """The system's message where there is one; TensorStore gives only its number."""
    code = re.search(r"os_error_code='(\d+)'", str(error))
    if code:
        return os.strerror(int(code[1]))
    said = str(error).splitlines() or [type(error).__name__]
    return getattr(error, "strerror", None) or said[0]


def _beneath(prefix: str, parts: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {k.removeprefix(prefix): v for k, v in parts.items() if k.startswith(prefix)}


def _shapes(config: Config) -> State:
    return jax.eval_shape(lambda: algorithm.start(config))


def _load(run_directory: Path, name: str, abstract: dict[str, Any]) -> dict[str, Any]:
    path = (run_directory / FOLDER / name / ARRAYS).absolute()
    saved = ocp.checkpointables_metadata(path).metadata
    for item, expected in abstract.items():
        # Orbax itself would silently convert another dtype to the expected one.
        wrong = _arrays(saved[item]) ^ _arrays(expected)
        if wrong:
            array, shape, dtype = min(wrong)
            raise CheckpointError(
                f"checkpoint {name} of {run_directory} does not match its config: see {array}, "
                f"{dtype} of shape {shape}."
            )
    return ocp.load_checkpointables(path, abstract)


def _arrays(tree: Any) -> set[tuple[str, tuple[int, ...], str]]:
    """The name, shape and dtype of each array."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    keystr = functools.partial(jax.tree_util.keystr, simple=True, separator=".")
    return {(keystr(path), tuple(x.shape), str(x.dtype)) for path, x in leaves if x is not None}
