"""Fig. 3: the mixture's weights in MaxEnt-H as published, in the two classic environments."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import protocol, statistics
from experiments.cli import UsageError
from maxent_jax import mixture, official, runs

SEEDS = {"toy": 2, "cpu": 10, "paper": 10}
TOY: dict[str, Any] = dict(
    num_rounds=3, num_episodes=4, train_steps=20, horizon=20, num_runs=2, num_fresh=4
)
# Of official.Trace, each [R, P]: nats, and cells.
KEPT = (
    *("running_entropy", "random_running_entropy", "density_entropy", "random_from_start_entropy"),
    *("fresh_entropy", "random_fresh_entropy", "coverage"),
)
RESULTS = "classic.json"

Results = dict[str, dict[str, Any]]


def results(directory: Path, scale: str, num_seeds: int | None) -> Results:
    """By environment; computed once, and read from the directory's file afterwards.

    All weightings and seeds of an environment are one program.

    Raises:
      UsageError: the directory holds it at another scale, or with other seeds or settings.
    """
    path = directory / RESULTS
    seeds = num_seeds or SEEDS[scale]
    asked = {"scale": scale, "seeds": seeds}
    settings = {env: _settings(env, scale) for env in official.SETTINGS}
    if path.exists():
        held = _read(path)
        used = {env: of_env.get("settings") for env, of_env in held.get("results", {}).items()}
        wanted = runs.jsonable({env: s._asdict() for env, s in settings.items()})
        if {name: held.get(name) for name in asked} | used != asked | wanted:
            raise UsageError(
                f"{path} was made at another scale, or with other seeds or settings: choose "
                f"another --out."
            )
        return held["results"]
    found = {env: _run(settings[env], seeds) for env in settings}
    runs.write_json(path, asked | {"versions": runs.stack(), "results": found})
    return runs.jsonable(found)


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        raise UsageError(f"{path} cannot be read: choose another --out.") from None


def _settings(env: str, scale: str) -> official.Settings:
    return official.SETTINGS[env]._replace(**(TOY if scale == "toy" else {}))


def table(found: Results) -> Mapping[str, Any]:
    """By environment and measure: the last round of each weighting, and uniform weights against
    it.
    """
    summary: dict[str, Any] = {}
    for env, of_env in found.items():
        for name in ("fresh_entropy", "density_entropy", "running_entropy"):
            last = {
                weighting: np.array(values[name])[:, -1]
                for weighting, values in of_env["weightings"].items()
            }
            summary[f"{env}, {name}"] = statistics.compare(last, "uniform")
    return summary


def _run(settings: official.Settings, num_seeds: int) -> dict[str, Any]:
    weightings = {"uniform": ("uniform", 0.1)} | {
        f"η = {eta}": ("geometric", eta) for eta in protocol.ETAS
    }
    tables = [
        mixture.weight_table(kind, settings.num_rounds, eta) for kind, eta in weightings.values()
    ]
    keys = jax.random.split(jax.random.key(0), num_seeds)
    trace = official.run(
        settings,
        np.repeat(np.stack(tables), num_seeds, axis=0),
        jax.numpy.tile(keys, len(tables)),
    )
    of_weighting = {}
    for i, name in enumerate(weightings):
        rows = slice(i * num_seeds, (i + 1) * num_seeds)
        of_weighting[name] = {field: getattr(trace, field)[rows] for field in KEPT}
    return {
        "settings": settings._asdict(),
        "env_steps": trace.env_steps,
        "gradient_steps": trace.gradient_steps,
        "weightings": of_weighting,
    }
