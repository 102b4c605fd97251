"""The files of a run's directory: its config and its metrics. Loads no array library."""

import dataclasses
import importlib.metadata
import json
import os
import platform
import re
import uuid
from pathlib import Path
from typing import Any

from maxent_jax.config import DEFAULTS, Config, from_flat, imports
from maxent_jax.errors import ConfigError, RunError
from maxent_jax.runs import atomic

SCHEMA = 7  # of the directory, including its checkpoints
READABLE = (4, 5, 6, 7)  # schemas with the same arrays for policies and visits
RESUMABLE = (6, 7)  # schemas with the same arrays for the whole state
REMOVED = {"restart_actor": False}  # settings of older schemas, with the value now fixed
CONFIG, METRICS, FIGURES = "config.json", "metrics.jsonl", "figures"
FIRST = "first_episodes.json"  # of a run that starts from another
EVALUATION = "evaluation.json"  # of the first seed; see `evaluation`
# All that any command writes there, but for the evaluations of the other seeds.
WRITTEN = (
    *(CONFIG, METRICS, FIRST, FIGURES, "checkpoints", EVALUATION),
    *("videos", "report.html", "tensorboard", "wandb"),
)
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint")


def stack() -> dict[str, str]:
    """Returns the software versions on which bit-identical results depend."""
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version()} | versions


def write_config(
    directory: Path, config: Config, method: dict[str, Any], machine: dict[str, Any]
) -> None:
    """Writes config.json: settings, departures from the paper, software versions and machine."""
    departures = {
        name: {"value": config[name], "why": why} for name, why in config.deviations().items()
    }
    content = {
        "schema": SCHEMA,
        "id": uuid.uuid4().hex[:12],
        "config": dataclasses.asdict(config),
        "method": method,
        "imported": imports.imported,
        "deviations_from_the_paper": departures,
        "budget": {
            "env_steps": config.budget.steps_per_iteration * config.budget.num_iterations,
            "gradient_steps": config.updates_per_vector_step
            * config.vector_steps
            * config.budget.num_segments
            * config.budget.num_iterations,
        },
        "versions": stack(),
        "machine": machine,
    }
    atomic.write_json(directory / CONFIG, content)


def read_config(directory: Path) -> Config:
    """Reads the config of a run.

    Raises:
      RunError: the directory holds no run, or a run of another schema.
    """
    path = directory / CONFIG
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        schema, settings = content["schema"], content["config"]
    except (OSError, ValueError, KeyError, TypeError):
        raise RunError(
            f"{directory} is not the directory of a run: no readable {CONFIG}."
        ) from None
    if schema not in READABLE:
        raise RunError(
            f"{path} has schema {schema}, but this release reads schemas {READABLE[0]} to {SCHEMA}."
        )
    try:
        return from_flat(_ungrouped(settings))
    except (TypeError, AttributeError, ConfigError) as error:
        raise RunError(f"{path} does not match this release: {error}") from None


def _ungrouped(settings: dict[str, Any]) -> dict[str, Any]:
    """Returns every setting by name; schemas before 7 had no groups."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= value if isinstance(value, dict) else {name: value}
    return {n: x for n, x in flat.items() if not (n in REMOVED and REMOVED[n] == x)}


def evaluation(directory: Path, seed_index: int = 0) -> Path:
    """Returns the file for the evaluation of a seed, counted from 0."""
    return directory / (f"evaluation_seed_{seed_index}.json" if seed_index else EVALUATION)


def beside(directory: Path, ending: str) -> Path:
    """Returns the path of a sibling of a run's directory, named after it: runs/ant-ENDING."""
    named = directory if directory.name not in ("", "..") else Path(os.path.abspath(directory))
    return named.with_name(f"{named.name}-{ending}")


def is_written(name: str) -> bool:
    """Whether a command writes a file or folder of this name into a run's directory."""
    name = atomic.final_of(name) or name
    return name in WRITTEN or re.fullmatch(r"evaluation_seed_\d+\.json", name) is not None


def check_resumable(directory: Path) -> None:
    """Checks that this release can resume the run.

    Raises:
      RunError: an older release, which stores the replay differently, made the run.
    """
    schema = read_schema(directory)
    if schema not in RESUMABLE:
        raise RunError(
            f"{directory} cannot be resumed: it has schema {schema}, and this release resumes "
            f"schemas {RESUMABLE[0]} to {SCHEMA}. Its results can still be loaded."
        )


def is_config(path: Path) -> bool:
    """Whether a run can have written this file: of any schema, or empty after a crash."""
    try:
        text = path.read_text(encoding="utf-8")
        return not text or {"schema", "config"} <= json.loads(text).keys()
    except (OSError, ValueError, AttributeError):
        return False


def check_config(directory: Path, config: Config) -> None:
    """Checks that the run has these settings; the name of the preset may differ.

    Raises:
      RunError: a setting differs, or the directory holds no run.
    """
    saved = read_config(directory)
    # A preset only names values, which are compared one by one.
    values = ((name, saved[name], config[name]) for name in DEFAULTS if name != "preset")
    changed = [f"{name} was {old} and is {new}" for name, old, new in values if old != new]
    if changed:
        raise RunError(f"{directory} holds a run with other settings: {', '.join(changed)}.")


def read_schema(directory: Path) -> int:
    """Returns the schema of a run's directory."""
    return _read(directory)["schema"]


def read_versions(directory: Path) -> dict[str, str]:
    """Returns the software versions with which the run began."""
    return _read(directory)["versions"]


def read_id(directory: Path) -> str:
    """Returns the id of the run, drawn when it began."""
    return _read(directory)["id"]


def _read(directory: Path) -> dict[str, Any]:
    return json.loads((directory / CONFIG).read_text(encoding="utf-8"))


def append_metrics(directory: Path, row: dict[str, Any]) -> None:
    """Appends one line to metrics.jsonl; it is on disk when this function returns.

    Raises:
      SaveError: the line cannot be written; readers skip an unfinished line.
    """
    path = directory / METRICS
    with atomic.writing(path), open(path, "a", encoding="utf-8") as file:
        file.write(_lines([row]))
        file.flush()
        os.fsync(file.fileno())


def read_metrics(directory: Path) -> list[dict[str, Any]]:
    """Reads the rows of metrics.jsonl; skips an unfinished last line.

    Raises:
      RunError: a line is not a JSON object.
    """
    path = directory / METRICS
    lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(dict(json.loads(line)))
        except (ValueError, TypeError):
            raise RunError(
                f"line {number} of {path} is not a JSON object: the command train --resume writes "
                f"the file again, from the last checkpoint."
            ) from None
    return rows


def of_seed(row: dict[str, Any], index: int) -> dict[str, Any]:
    """Returns a row of metrics for one seed of the run, counted from 0, of one or several."""
    return {name: x[index] if isinstance(x, list) else x for name, x in row.items()}


def write_metrics(directory: Path, rows: list[dict[str, Any]]) -> None:
    """Writes metrics.jsonl with exactly these rows, unless it has them already."""
    path, text = directory / METRICS, _lines(rows)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        atomic.write(path, text)


def as_name(text: str) -> str:
    """Returns a text as a part of a file name: goal:15,0 is goal_15_0."""
    return re.sub(r"[^\w.-]", "_", text)


def check_writable(directory: Path) -> None:
    """Checks that a command can write its results there.

    Raises:
      RunError: the directory is not writable.
    """
    if not os.access(directory, os.W_OK | os.X_OK):
        raise RunError(f"{directory} is not writable: make it writable, or copy it elsewhere.")


def _lines(rows: list[dict[str, Any]]) -> str:
    return "".join(json.dumps(atomic.jsonable(row)) + "\n" for row in rows)
