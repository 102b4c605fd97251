"""Fig. 3: the mixture's weights in MaxEnt-H as published, in the two classic environments."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from maxent_jax import mixture
from maxent_jax.baselines import hazan
from maxent_jax.errors import UsageError
from maxent_jax.runs import atomic, files
from maxent_jax.studies import protocol, statistics
from maxent_jax.studies.values import RANDOM

SEEDS = {"toy": 2, "cpu": 10, "paper": 10}
TOY: dict[str, Any] = dict(
    num_rounds=3, num_episodes=4, train_steps=20, horizon=20, num_runs=2, num_fresh=4
)
RANDOM_BESIDE = {  # by measure of the mixture: the comparable measure of the random policy
    "running_entropy": "random_running_entropy",
    "density_entropy": "random_from_start_entropy",
    "fresh_entropy": "random_fresh_entropy",
}
# Fields of hazan.Trace, each [R, P]: nats, and cells.
KEPT = (*RANDOM_BESIDE, *RANDOM_BESIDE.values(), "coverage")
RESULTS = "classic.json"

Results = dict[str, dict[str, Any]]


def results(directory: Path, scale: str, num_seeds: int | None) -> Results:
    """Returns the results by environment: computes them once, then reads the directory's file.

    One program runs all weightings and seeds of an environment.

    Raises:
      UsageError: as in `held`.
    """
    before = held(directory, scale, num_seeds)
    if before is not None:
        return before
    asked, settings = _asked(scale, num_seeds)
    found = {env: _run(settings[env], asked["seeds"]) for env in settings}
    content = asked | {"versions": files.stack(), "results": found}
    atomic.write_json(directory / RESULTS, content)
    return atomic.jsonable(found)


def held(directory: Path, scale: str, num_seeds: int | None) -> Results | None:
    """Returns the results in the directory's file, or None if there is no file.

    Raises:
      UsageError: the file was made at another scale, or with other seeds or settings.
    """
    path = directory / RESULTS
    if not path.exists():
        return None
    content = _read(path)
    asked, settings = _asked(scale, num_seeds)
    used = {env: of_env.get("settings") for env, of_env in content.get("results", {}).items()}
    wanted = atomic.jsonable({env: s._asdict() for env, s in settings.items()})
    if {name: content.get(name) for name in asked} | used != asked | wanted:
        raise UsageError(
            f"{path} was made at another scale, or with other seeds or settings: choose another "
            f"--out."
        )
    return content["results"]


def _asked(scale: str, num_seeds: int | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Scale and seeds, and the settings by environment."""
    changes = TOY if scale == "toy" else {}
    settings = {env: s._replace(**changes) for env, s in hazan.SETTINGS.items()}
    return {"scale": scale, "seeds": num_seeds or SEEDS[scale]}, settings


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        raise UsageError(f"{path} cannot be read: choose another --out.") from None


def curves(found: Results) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Returns curves [seeds, rounds] by environment, measure and weighting or random policy.

    The random policy plays in the runs of every weighting. The episodes are the same unless they
    start in states of the mixture, so its curve is the mean over the weightings.
    """
    by_env = {env: of_env["weightings"] for env, of_env in found.items()}
    return {
        env: {
            name: {weighting: np.array(of[name]) for weighting, of in weightings.items()}
            | {RANDOM: np.mean([of[random] for of in weightings.values()], axis=0)}
            for name, random in RANDOM_BESIDE.items()
        }
        for env, weightings in by_env.items()
    }


def table(found: Results) -> Mapping[str, Any]:
    """Compares uniform weights with all others in the last round, by environment and measure."""
    return {
        f"{env}, {name}": statistics.compare({who: x[:, -1] for who, x in of.items()}, "uniform")
        for env, measures in curves(found).items()
        for name, of in measures.items()
    }


def _run(settings: hazan.Settings, num_seeds: int) -> dict[str, Any]:
    weightings = {"uniform": ("uniform", 0.1)} | {
        f"η = {eta}": ("geometric", eta) for eta in protocol.ETAS
    }
    tables = [
        mixture.weight_table(kind, settings.num_rounds, eta) for kind, eta in weightings.values()
    ]
    keys = jax.random.split(jax.random.key(0), num_seeds)
    trace = hazan.run(
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
