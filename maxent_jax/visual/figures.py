"""Draws the figures at the end of a run."""

import multiprocessing
import os
from collections.abc import Sequence
from pathlib import Path

import jax

from maxent_jax.analysis import load_run
from maxent_jax.config import imports
from maxent_jax.visual import plotting

EPISODES = 5  # of each policy
EPISODES_WITH_SKILLS = 16  # of each policy, so that the newest one shows skills all around


def draw_missing(directory: Path) -> None:
    """Rolls out the archived policies and draws the figures of a run, unless they exist.

    With several processes, which cannot reach each other's devices, a new process draws.

    Raises:
      SaveError: a figure cannot be written.
      RuntimeError: the new process failed.
    """
    if plotting.all_saved(directory):
        return
    if jax.process_count() == 1:
        _draw(directory)
        return
    alone = multiprocessing.get_context("spawn").Process(
        target=_draw, args=(directory, imports.imported)
    )
    os.environ["JAX_PLATFORMS"] = "cpu"  # for the child: the accelerator's memory is in use
    alone.start()
    alone.join()
    if alone.exitcode != 0:
        raise RuntimeError(f"drawing the figures of {directory} failed; --resume tries again.")


def _draw(directory: Path, modules: Sequence[str] = ()) -> None:
    imports.import_modules(modules)
    run = load_run(directory)
    with_skills = run.config.environment.skill_size > 0
    episodes = EPISODES_WITH_SKILLS if with_skills else EPISODES
    plotting.save_all(run, *run.occupancies(episodes))
