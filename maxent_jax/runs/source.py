"""The run that another run starts from. Loads no array library before `load` does."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxent_jax.config import DEFAULTS, Config, names, registry, tasks
from maxent_jax.errors import ConfigError
from maxent_jax.runs import files, integrity

if TYPE_CHECKING:
    from maxent_jax.mixture import Archive

# The settings on which the parameters of a policy depend.
NETWORKS = (
    *("env", "hidden_layers", "hidden_size", "critic_layer_norm"),
    *("policy_inputs", "normalize_inputs"),
)
DEFAULT_START = "both"
# 154,000 env steps, after each eighth of which the agent is measured; Ant's first episodes take
# another 43,000.
BUDGET: dict[str, Any] = dict(
    num_iterations=8,
    steps_per_iteration=19_200,
    num_segments=5,
    updates_per_step=1.0,
    actor_average=1e-3,
    mixture_episodes=20,
    discount=0.997,
    return_steps=10,
    first_episodes=4,
)
COPIES = 3  # turned copies of an episode, where the robot has any
CRITIC_STEPS, RESTART_SHARE = 9_600, 0.5
# What only a mixture needs is not taken over.
_OF_A_MIXTURE = {
    name: DEFAULTS[name]
    for name in (
        *("bonus", "mixing", "weights", "eta", "reference", "start", "refresh_period", "pooled"),
        *("plateau_segments", "stale_rewards"),
    )
}


def check(config: Config) -> None:
    """Checks that the config's run can start from its source, if it has one.

    Raises:
      RunError: the source is not the directory of a run.
      CheckpointError: the source has no checkpoint yet.
      ConfigError: its networks differ, or it has no such seed or iteration.
    """
    own = config.downstream
    if own.restart_share and own.start_from not in names.PLAYING:
        raise ConfigError(
            f"restart-share is {own.restart_share}, but must be 0 with start-from "
            f"{own.start_from}, which plays no first episodes: choose one of "
            f"{', '.join(names.PLAYING)}."
        )
    if not own.source:
        return
    directory = Path(own.source)
    of_source = files.read_config(directory)
    integrity.check_any(directory)
    for name in NETWORKS:
        if of_source[name] != config[name]:
            raise ConfigError(
                f"{name.replace('_', '-')} is {config[name]}, but must be {of_source[name]}, as in "
                f"{directory}: the run starts from its policies."
            )
    if not 0 <= own.source_seed < of_source.num_seeds:
        raise ConfigError(
            f"source-seed is {own.source_seed}, but must be below {of_source.num_seeds}, the "
            f"number of seeds of {directory}."
        )
    complete = integrity.complete_iterations(directory)
    if own.source_iterations > complete:
        raise ConfigError(
            f"source-iterations is {own.source_iterations}, but must be at most {complete}, the "
            f"number of complete iterations of {directory}."
        )


def load(config: Config) -> "tuple[Archive, str]":
    """Returns the archive of the config's source, and the name of its checkpoint.

    Raises:
      CheckpointCorruptError: the checkpoint is damaged.
    """
    import jax

    from maxent_jax.runs import checkpoint

    directory = Path(config.downstream.source)
    of_source = files.read_config(directory)
    remedy = (
        "the command train --resume --fallback on that run removes it, and repeats what it held"
    )
    latest = checkpoint.restore_latest(directory, of_source, remedy)
    archive = latest.results.archive
    if of_source.num_seeds > 1:
        archive = jax.tree.map(lambda x: x[config.downstream.source_seed], archive)
    if iterations := config.downstream.source_iterations:
        policies = 1 + iterations * of_source.mixture.snapshots
        archive = archive._replace(size=jax.numpy.minimum(archive.size, policies))
    return archive, latest.name


def on_task(
    of_source: Config, source: str, task: str, start_from: str = DEFAULT_START, **changes: object
) -> Config:
    """Returns the config of a run on a task that starts from another run.

    It has the settings of that run, but those of the method `task` and its own budget.

    Args:
      of_source: config of the run to start from.
      source: directory of that run; may be empty if nothing is taken from it.
      task: the name of the task.
      start_from: what to take from that run.
      **changes: settings by name.
    Raises:
      ConfigError: a setting is invalid.
    """
    of_method = dict(registry.method(registry.TASK).settings)
    of_task = dict(tasks.settings(task, of_source.env))
    own = {
        "method": registry.TASK,
        "task": task,
        "num_seeds": 1,
        "random_baseline": False,
        "cell_restarts": 0.0,
        "source": source,
        "start_from": start_from,
    }
    if start_from in names.PLAYING:
        own["restart_share"] = RESTART_SHARE
    budget: dict[str, Any] = {}
    if of_source.preset != "smoke":
        budget = dict(BUDGET)
        states = BUDGET["mixture_episodes"] * of_source.environment.episode_length
        budget["reference_size"] = min(of_source.mixture.reference_size, states)
        if of_source.learner.yaw_copies:
            budget["yaw_copies"] = COPIES
        if start_from in names.WITH_ITS_AGENT:
            budget["critic_steps"] = CRITIC_STEPS
    return of_source.replace(**(_OF_A_MIXTURE | budget | of_method | of_task | own | changes))
