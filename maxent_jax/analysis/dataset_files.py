"""Writes datasets of any size to disk, a few episodes at a time, in three formats.

    npz      part-00000.npz ...: the arrays of `dataset.collect`
    exorl    buffer/*.npz: an episode each, as in ExORL (github.com/denisyarats/exorl) and URLB
    minari   a dataset of Minari's, in the controls of Gymnasium's environment

dataset.json says what the directory holds, and whether it is complete. A dataset that was stopped
is continued where it ended.
"""

import contextlib
import json
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import components, envs
from maxent_jax.analysis import dataset, gymnasium_play
from maxent_jax.analysis.run import Run
from maxent_jax.checks import check_seed
from maxent_jax.config import tasks
from maxent_jax.config.registry import MUJOCO_ENVS
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.errors import UsageError
from maxent_jax.precision import in_32_bits
from maxent_jax.runs import atomic, files, locks

MANIFEST = "dataset.json"
VERSION = 1  # of the layout
EPISODES = "buffer"  # the folder of exorl

Rows = dict[str, np.ndarray]


class Written(NamedTuple):
    """What is on disk."""

    rounds: int  # of EPISODES_AT_ONCE episodes
    episodes: int
    transitions: int


class Writer(Protocol):
    """Writes the transitions of one round; a file of it is complete or absent."""

    def __call__(self, rows: Rows, written: Written, /) -> None:
        """Writes rows [n, ...], after those that are on disk."""


@in_32_bits
def write(
    run: Run,
    directory: Path,
    form: str,
    num: int,
    task: str = tasks.NONE,
    seed: int = 0,
    report: Callable[[int], None] = lambda transitions: None,
) -> None:
    """Writes a dataset of the mixture's fresh episodes, or the rest of one that was stopped.

    Args:
      run: the run.
      directory: of the dataset; for minari, the root of its datasets.
      form: npz, exorl or minari.
      num: transitions.
      task: adds the rewards of this task; without one they are 0 in exorl and minari.
      seed: of the episodes.
      report: called with the number of transitions on disk.
    Raises:
      UsageError: the directory holds something else, or the format cannot hold the environment.
      ConfigError: the seed is out of range.
      SaveError: a file cannot be written; what is complete stays.
    """
    key = jax.random.key(check_seed("seed", seed))
    content = {
        "version": VERSION,
        "format": form,
        "transitions": num,
        "task": task,
        "seed": seed,
        "run": {
            "id": files.read_id(run.path),
            "checkpoint": run.checkpoint,
            "seed": run.seed,
            "config": run.config.flat(),
        },
    }
    append = WRITERS[form](run, directory)
    with locks.holding(directory, wait=False):
        written = _on_disk(directory, atomic.jsonable(content))
        if form != "minari":  # a reader would take half an episode for one
            atomic.clear(directory, ".npz")
            atomic.clear(directory / EPISODES, ".npz")
        if written.transitions == num:
            return
        atomic.write_json(directory / MANIFEST, _manifest(content, written))
        on_task = components.with_task(run.components, task)
        rounds = dataset.stream(
            on_task,
            run.mixture,
            jnp.asarray(run.weights),
            key,
            first=written.rounds,
            physics=form == "exorl",
        )
        while written.transitions < num:
            rows = _at_most(next(rounds), num - written.transitions)
            append(rows, written)
            written = Written(
                rounds=written.rounds + 1,
                episodes=written.episodes + len(_ends(rows)),
                transitions=written.transitions + len(rows["policy"]),
            )
            atomic.write_json(directory / MANIFEST, _manifest(content, written))
            report(written.transitions)


def _manifest(content: dict[str, Any], written: Written) -> dict[str, Any]:
    complete = written.transitions == content["transitions"]
    return content | {"complete": complete, "written": written._asdict()}


def _on_disk(directory: Path, content: dict[str, Any]) -> Written:
    """What a dataset with the same settings has on disk.

    Raises:
      UsageError: the directory holds something else.
    """
    path = directory / MANIFEST
    if not path.exists():
        if not locks.is_free(directory, MANIFEST):
            raise UsageError(f"{directory} is not empty: choose another --out.")
        return Written(0, 0, 0)
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        differs = [name for name, value in content.items() if held[name] != value]
        written = Written(**held["written"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{path} cannot be read: choose another --out.") from None
    if differs:
        raise UsageError(
            f"{directory} holds another dataset, with another {' and '.join(differs)}: choose "
            f"another --out."
        )
    return written


def _at_most(rows: Rows, num: int) -> Rows:
    """The first `num` rows; the last one ends its episode."""
    rows = {name: np.array(x[:num]) for name, x in rows.items()}
    rows["timeouts"][-1] = not rows["terminals"][-1]
    return rows


def _ends(rows: Rows) -> np.ndarray:
    """The rows after the last of each episode, [E]."""
    return np.flatnonzero(rows["terminals"] | rows["timeouts"]) + 1


def _episodes(rows: Rows) -> Iterator[Rows]:
    begin = 0
    for end in _ends(rows):
        yield {name: x[begin:end] for name, x in rows.items()}
        begin = end


def _rewards(rows: Rows) -> np.ndarray:
    return rows.get("rewards", np.zeros(len(rows["policy"]), np.float32))


def _to_npz(run: Run, directory: Path) -> Writer:
    del run

    def append(rows: Rows, written: Written) -> None:
        with atomic.whole_file(directory / f"part-{written.rounds:05d}.npz") as path:
            np.savez(path, **rows)  # type: ignore[arg-type]

    return append


def _to_exorl(run: Run, directory: Path) -> Writer:
    """An episode has T + 1 rows: row 0 holds the start, and no action or reward."""
    del run

    def after_start(x: np.ndarray) -> np.ndarray:
        return np.concatenate([np.zeros_like(x[:1]), x])

    def append(rows: Rows, written: Written) -> None:
        for i, episode in enumerate(_episodes(rows), written.episodes):
            discount = 1 - episode["terminals"].astype(np.float32)
            arrays = {
                "observation": np.concatenate(
                    [episode["observations"][:1], episode["next_observations"]]
                ),
                "action": after_start(episode["actions"]),
                "reward": after_start(_rewards(episode))[:, None],
                "discount": np.concatenate([np.ones(1, np.float32), discount])[:, None],
                "physics": np.concatenate([episode["physics"][:1], episode["next_physics"]]),
            }
            length = len(episode["policy"])
            # ExORL's reader takes number and length from the name; the time is the same for all.
            name = f"00000000T000000_{i}_{length}.npz"
            with atomic.whole_file(directory / EPISODES / name) as path:
                np.savez(path, **arrays)  # type: ignore[arg-type]

    return append


def _to_minari(run: Run, directory: Path) -> Writer:
    """In Gymnasium's observations and controls, so that Minari can recover the environment."""
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError:
        raise UsageError(
            "format minari needs the package minari, which is in the extra 'minari': install it."
        ) from None
    import gymnasium

    name = run.config.env
    if name not in MUJOCO_ENVS:
        raise UsageError(f"format minari holds {', '.join(MUJOCO_ENVS)}, but the run is on {name}.")
    if run.config.environment.skill_size:
        raise UsageError(
            "format minari holds Gymnasium's observations, but the run's end with a skill: choose "
            "npz or exorl."
        )
    identifier = f"maxent/{name}/{files.read_id(run.path)}-v0"
    env = envs.make(name, "mujoco", torque_limit=run.config.environment.torque_limit)
    assert isinstance(env, MujocoEnv)
    control = jax.jit(env.control)
    spec = gymnasium.spec(gymnasium_play.IDS[name])
    spec.kwargs["exclude_current_positions_from_observation"] = False

    def append(rows: Rows, written: Written) -> None:
        buffers = [
            EpisodeBuffer(
                observations=np.concatenate(
                    [episode["observations"][:1], episode["next_observations"]]
                ).astype(np.float64),
                actions=np.asarray(control(episode["actions"])),
                rewards=list(_rewards(episode)),
                terminations=list(episode["terminals"]),
                truncations=list(episode["timeouts"]),
            )
            for episode in _episodes(rows)
        ]
        with _root(directory), atomic.writing(directory), warnings.catch_warnings():
            # It asks for author and link, which only whoever publishes the dataset can name.
            warnings.filterwarnings("ignore", ".*is set to None|.*is out of date")
            if written.episodes == 0:
                minari.create_dataset_from_buffers(
                    identifier,
                    buffers,
                    env=spec,
                    algorithm_name=run.config.title,
                    description=f"Mixture of {run.num_policies} policies, maxent_jax.",
                )
                return
            held = minari.load_dataset(identifier)
            if held.total_episodes != written.episodes:
                raise UsageError(
                    f"{directory} holds {held.total_episodes} episodes, but {MANIFEST} says "
                    f"{written.episodes}: it was stopped while writing; remove it, and start again."
                )
            held.update_dataset_from_buffer(buffers)

    return append


@contextlib.contextmanager
def _root(directory: Path) -> Iterator[None]:
    """Context manager: Minari's datasets lie in the directory."""
    name = "MINARI_DATASETS_PATH"
    before = os.environ.get(name)
    os.environ[name] = str(directory)
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


WRITERS: dict[str, Callable[[Run, Path], Writer]] = {
    "npz": _to_npz,
    "exorl": _to_exorl,
    "minari": _to_minari,
}
