"""MEPOL at the env steps of a study; it has its own learner, so `train` does not run it.

It takes as many gradient steps as its trust region allows, far fewer than SAC, each on a whole
batch of episodes.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax

from maxent_jax import components
from maxent_jax.baselines import mepol
from maxent_jax.baselines.mepol import Settings
from maxent_jax.config import Config
from maxent_jax.studies import kept, values
from maxent_jax.studies.values import COLUMNS, Row

METHOD, RESULTS = "MEPOL", "mepol.json"


def rows(directory: Path, config: Config, num_seeds: int) -> list[Row]:
    """Returns a row per seed and iteration: computes them once, then reads the directory's file."""
    asked = {
        "config": config.flat(),
        "seeds": num_seeds,
        "settings": dataclasses.asdict(settings_of(config)),
    }
    train = lambda: {"rows": _train(config, num_seeds)}
    return [values.known(row) for row in kept.once(directory / RESULTS, asked, train)["rows"]]


def settings_of(config: Config) -> Settings:
    """Returns MEPOL's defaults, with batches of about the usual size that fill an iteration."""
    usual = Settings.num_episodes * config.environment.episode_length
    num_epochs = max(1, round(config.budget.steps_per_iteration / usual))
    num_episodes = config.budget.steps_per_iteration // (
        num_epochs * config.environment.episode_length
    )
    return Settings(num_epochs=num_epochs, num_episodes=num_episodes)


def _train(config: Config, num_seeds: int) -> list[dict[str, Any]]:
    p, settings, started = components.make(config), settings_of(config), time.perf_counter()
    keys = jax.vmap(jax.random.key)(config.seed + jax.numpy.arange(num_seeds))
    state = jax.jit(jax.vmap(lambda key: mepol.init(p, settings, key)))(keys)
    iterate = jax.jit(jax.vmap(lambda state: mepol.iterate(p, settings, state)))
    found = []
    for iteration in range(1, config.budget.num_iterations + 1):
        state, metrics = iterate(state)
        measured = {name: metrics[name].tolist() for name in COLUMNS if name in metrics}
        seconds = time.perf_counter() - started
        found += [
            {"env": config.env, "method": METHOD, "seed": config.seed + i}
            | {"iteration": iteration, "wall_seconds": seconds}
            | {name: of_seeds[i] for name, of_seeds in measured.items()}
            for i in range(num_seeds)
        ]
    return found
