"""A run's directory: its config, its metrics, and where the rest lies. Loads no array library."""

import dataclasses
import importlib.metadata
import json
import math
import os
import platform
from pathlib import Path
from typing import Any

from maxent_jax.config import Config, ConfigError

SCHEMA = 2  # of the directory, checkpoints included
CONFIG, METRICS, FIGURES = "config.json", "metrics.jsonl", "figures"
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "orbax-checkpoint")


class RunError(ValueError):
    """A directory that is not the run it is taken for."""


class CheckpointError(RunError):
    """A run without a checkpoint that can be loaded."""


def write_config(
    directory: Path, config: Config, method: dict[str, Any], machine: dict[str, str]
) -> None:
    """config.json: every setting, what departs from the paper, the stack and the machine."""
    departures = {
        name: {"value": getattr(config, name), "why": why}
        for name, why in config.deviations().items()
    }
    content = {
        "schema": SCHEMA,
        "config": dataclasses.asdict(config),
        "method": method,
        "deviations_from_the_paper": departures,
        "budget": {
            "env_steps": config.steps_per_iteration * config.num_iterations,
            "gradient_steps": config.updates_per_vector_step
            * config.vector_steps
            * config.num_segments
            * config.num_iterations,
        },
        "versions": {"python": platform.python_version()}
        | {name: importlib.metadata.version(name) for name in PACKAGES},
        "machine": machine,
    }
    write_json(directory / CONFIG, content)


def read_config(directory: Path) -> Config:
    """The config of a run.

    Raises:
      RunError: no run there, or one of another schema.
    """
    path = directory / CONFIG
    try:
        content = json.loads(path.read_text())
        schema, settings = content["schema"], content["config"]
    except (OSError, ValueError, KeyError, TypeError):
        raise RunError(
            f"{directory} is not the directory of a run: no readable {CONFIG}."
        ) from None
    if schema != SCHEMA:
        raise RunError(f"{path} has schema {schema}, but this release reads schema {SCHEMA}.")
    try:
        return Config(**settings)
    except (TypeError, ConfigError) as error:
        raise RunError(f"{path} does not fit this release: {error}") from None


def append_metrics(directory: Path, row: dict[str, Any]) -> None:
    """One line of metrics.jsonl, on disk when this returns. What is not finite becomes null."""
    with open(directory / METRICS, "a") as file:
        file.write(json.dumps(_jsonable(row)) + "\n")
        file.flush()
        os.fsync(file.fileno())


def read_metrics(directory: Path) -> list[dict[str, Any]]:
    """The rows of metrics.jsonl; an unfinished last line is left out."""
    path = directory / METRICS
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    try:
        return [json.loads(line) for line in lines]
    except ValueError:
        raise RunError(f"{path} holds a line that is not JSON.") from None


def truncate_metrics(directory: Path, num_iterations: int) -> list[dict[str, Any]]:
    """The rows of the first iterations, which alone stay in the file: the rest is run again."""
    rows = read_metrics(directory)[:num_iterations]
    _replace(directory / METRICS, "".join(json.dumps(row) + "\n" for row in rows))
    return rows


def write_json(path: Path, content: dict[str, Any]) -> None:
    """A JSON file, whole or not at all. What is not finite becomes null."""
    _replace(path, json.dumps(_jsonable(content), indent=2) + "\n")


def _jsonable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list):
        return [_jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _replace(path: Path, text: str) -> None:
    temporary = path.with_suffix(path.suffix + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
