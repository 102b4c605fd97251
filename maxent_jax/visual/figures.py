"""The figures that a run leaves at its end."""

import multiprocessing
import os
from pathlib import Path

import jax
import numpy as np

from maxent_jax import plotting
from maxent_jax.analysis import load_run, paths
from maxent_jax.density import histogram


def draw(directory: Path) -> None:
    """In this process or, beside others, whose devices are out of reach, in one of its own."""
    if jax.process_count() == 1:
        draw_here(directory)
        return
    alone = multiprocessing.get_context("spawn").Process(target=draw_here, args=(directory,))
    os.environ["JAX_PLATFORMS"] = "cpu"  # of the child: the accelerator's memory is taken
    alone.start()
    alone.join()
    if alone.exitcode != 0:
        raise RuntimeError(f"drawing the figures of {directory} failed; --resume tries again.")


def draw_here(directory: Path) -> None:
    """Rolls the archived policies out, and draws."""
    run = load_run(directory)
    visited = run.occupancy()
    cells = histogram.count(visited.states, run.parts.grid, visited.weight)
    plotting.save_all(run, np.asarray(cells), paths(visited))
