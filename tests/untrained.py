"""Runs that nobody trained, for tests that need policies and no learning."""

from pathlib import Path

import jax
import numpy as np

from maxent_jax import components, mixture
from maxent_jax.analysis import Run
from maxent_jax.config import preset
from maxent_jax.sac import agent


def make_run(**changes):
    """A run of preset smoke, with changes, whose policies are all fresh agents."""
    config = preset("smoke", **changes)
    sac = components.make(config).sac
    keys = jax.random.split(jax.random.key(2), config.archive_size)
    agents = [agent.init(sac, key).parameters for key in keys]
    archive = mixture.init(agents[0], config.archive_size)
    for parameters in agents:
        archive = mixture.append(archive, parameters)
    none = np.zeros(components.make(config).grid.bins, np.int32)
    return Run(Path(), config, {}, config.seed, archive, none, none)
