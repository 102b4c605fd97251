"""Says which settings do not go together. Loads no array library."""

from collections.abc import Iterator
from types import SimpleNamespace

from maxent_jax.checks import NUM_SEEDS
from maxent_jax.config import names, registry, tasks
from maxent_jax.config.registry import CORRECTIVE, EnvironmentRow

MOST = 2**31 - 1  # rows and steps are counted in 32 bits


def problems(settings: SimpleNamespace, row: EnvironmentRow) -> Iterator[str]:
    """Yields a sentence for each pair or group of settings that do not go together.

    Args:
      settings: every setting by name, each valid by itself.
      row: of the environment.
    """
    yield from _budget(settings)
    yield from _downstream(settings)
    yield from _mixture(settings)
    yield from _bonus(settings)
    yield from _robot(settings, row)
    yield from _learner(settings)


def problems_of_new_runs(c: SimpleNamespace) -> Iterator[str]:
    """Yields a sentence for each setting that would have no effect, or not the one it should have.

    A run of an earlier release may have such settings, so it is loaded all the same.

    Args:
      c: every setting by name, of which `problems` finds none.
    """
    of_method = registry.METHODS.get(c.method)  # none: a user's, not registered yet
    weights, start = c.weights, c.start
    if of_method is not None:
        weights = of_method.weights if weights == "method" else weights
        start = of_method.start if start == "method" else start
    if c.mixing == "step" and start == "best":
        yield (
            f"mixing is step, so no state belongs to one policy, and none is the best: start "
            f"{_start_in_words(c)} needs mixing episode, or choose start last or scratch."
        )
    if c.intrinsic_weight == 0 and start == "best":
        yield (
            f"intrinsic-weight is 0, so no policy is scored: start {_start_in_words(c)} needs an "
            f"intrinsic reward, or choose start last or scratch."
        )
    if c.eta != names.ETA and weights not in ("geometric", "method"):
        yield f"eta is {c.eta}, but weights are {weights}: only geometric weights have an eta."
    if c.shaping_survives_death and not c.shaping:
        yield "shaping-survives-death is on, but shaping is 0: set shaping, or leave it out."
    if c.task == tasks.NONE:
        unused = {"intrinsic_weight": 1.0, "intrinsic_decay": 0, "task_scale": 1.0}
        for name, default in unused.items():
            if getattr(c, name) != default:
                yield (
                    f"{name.replace('_', '-')} is {getattr(c, name)}, but task is none: it weighs "
                    f"the intrinsic reward against a task's, so name a task."
                )
    if not c.source:
        for name in ("source_seed", "source_iterations"):
            if getattr(c, name):
                yield (
                    f"{name.replace('_', '-')} is {getattr(c, name)}, but there is no source: name "
                    f"the directory of a run."
                )
    if c.stale_rewards and c.start_from in names.FILLING:
        yield (
            f"stale-rewards is on, but start-from is {c.start_from}: the episodes that fill the "
            f"replay are rewarded only when they are measured again."
        )


def _budget(c: SimpleNamespace) -> Iterator[str]:
    segment = c.num_envs * c.num_segments
    if c.steps_per_iteration % segment:
        yield (
            f"steps-per-iteration is {c.steps_per_iteration}, but must be a multiple of "
            f"num-envs × num-segments = {segment}."
        )
    updates = _updates(c)
    if updates < 0.5 or abs(updates - round(updates)) > 1e-6:
        yield f"updates-per-step × num-envs is {updates:g}, but must be a whole number above 0."
    if c.seed + c.num_seeds > NUM_SEEDS:
        yield f"seed + num-seeds is {c.seed + c.num_seeds}, but must not exceed 2^31."
    env_steps = c.num_iterations * c.steps_per_iteration
    if env_steps > MOST:
        yield (
            f"num-iterations × steps-per-iteration is {env_steps}, but must be at most {MOST}: "
            f"steps are counted in 32 bits."
        )
    if env_steps * c.updates_per_step > MOST:
        yield (
            f"num-iterations × steps-per-iteration × updates-per-step is "
            f"{env_steps * c.updates_per_step:g}, but must be at most {MOST}: gradient steps are "
            f"counted in 32 bits."
        )
    if 2 * c.plateau_segments > c.num_segments:
        yield (
            f"plateau-segments is {c.plateau_segments}, but must be at most half of num-segments = "
            f"{c.num_segments}."
        )
    if c.plateau_segments and c.intrinsic_weight == 0:
        yield (
            f"plateau-segments is {c.plateau_segments}, but must be 0 with intrinsic-weight 0: a "
            f"plateau is judged by the intrinsic reward."
        )
    if c.num_segments % c.snapshots:
        yield f"snapshots is {c.snapshots}, but must divide num-segments = {c.num_segments}."
    if c.snapshots > 1 and c.plateau_segments:
        yield (
            f"snapshots is {c.snapshots}, but must be 1 with plateau-segments above 0: an "
            f"iteration that may end at a plateau archives one policy."
        )


def _mixture(c: SimpleNamespace) -> Iterator[str]:
    if c.mixing == "step" and (c.pooled or c.leave_own_out or c.weights == CORRECTIVE):
        yield (
            "mixing is step, so no state belongs to one policy: pooled, leave-own-out and fully "
            "corrective weights need mixing episode."
        )
    if c.pooled and c.weights == CORRECTIVE:
        yield "pooled needs weights before the rollouts, and fully corrective weights come after."
    policies = 1 + c.num_iterations * c.snapshots
    if c.mixture_episodes < policies:
        yield (
            f"mixture-episodes is {c.mixture_episodes}, but must be at least {policies}, one for "
            f"each policy of the mixture."
        )
    states = c.mixture_episodes * c.episode_length
    if states > MOST:
        yield (
            f"mixture-episodes × episode-length is {states}, but must be at most {MOST}: states "
            f"are counted in 32 bits."
        )
    if c.reference_size > states:
        yield (
            f"reference-size is {c.reference_size}, but must be at most mixture-episodes × "
            f"episode-length = {states}."
        )
    if c.num_neighbors >= c.reference_size:
        yield (
            f"num-neighbors is {c.num_neighbors}, but must be below reference-size = "
            f"{c.reference_size}."
        )


def _bonus(c: SimpleNamespace) -> Iterator[str]:
    if registry.bonus_of(c.method) not in (None, c.bonus):
        yield f"method is {c.method}, but bonus is {c.bonus}: leave bonus out, the method sets it."
    if c.bonus == "none":
        return
    if c.return_steps > 1 or c.shaping or c.episodic_weight:
        yield (
            f"bonus is {c.bonus}, which rewards single steps: return-steps must be 1, and shaping "
            f"and episodic-weight must be 0."
        )
    if c.plateau_segments:
        yield (
            f"plateau-segments is {c.plateau_segments}, but must be 0 with bonus {c.bonus}: a "
            f"plateau is judged by the distance to the reference."
        )
    if c.bonus == registry.METRA and not c.skill_size:
        yield f"bonus is {c.bonus}, which rewards skills: skill-size must be at least 1."
    known = registry.BONUSES.get(c.bonus)
    neighbors = 0 if known is None else known.num_neighbors
    if _updates(c) * c.batch_size <= neighbors:
        yield (
            f"batch-size is {c.batch_size}, but bonus {c.bonus} needs more than {neighbors} "
            f"transitions in the {_updates(c):g} batches of a vector step."
        )


def _robot(c: SimpleNamespace, row: EnvironmentRow) -> Iterator[str]:
    if c.torque_limit < 1 and not row.is_robot:
        yield (
            f"torque-limit is {c.torque_limit}, but must be 1: the action of {c.env} is not scaled."
        )
    if c.end_flipped and not row.has_torso:
        yield f"end-flipped is on, but {c.env} has no floating torso that can be upside down."
    if not c.end_unhealthy and not row.is_robot:
        yield f"end-unhealthy is off, but {c.env} has no health termination."
    if c.policy_inputs == "heading" and not row.has_torso:
        yield f"policy-inputs is heading, but {c.env} has no floating torso with a heading."
    if c.yaw_copies and not row.has_torso:
        yield (
            f"yaw-copies is {c.yaw_copies}, but must be 0: {c.env} cannot turn about the vertical."
        )
    if c.skill_size and (c.policy_inputs != "state" or c.yaw_copies):
        yield (
            f"skill-size is {c.skill_size}, but needs policy-inputs state and yaw-copies 0: a "
            f"skill does not turn with the state."
        )


def _learner(c: SimpleNamespace) -> Iterator[str]:
    if c.policy_lag > 1:
        yield f"policy-lag is {c.policy_lag}, but must be 0 or 1."
    if c.batch_size > c.replay_size:
        yield f"batch-size is {c.batch_size}, but must not exceed replay-size = {c.replay_size}."
    if 4 * c.num_envs > c.replay_size:
        yield (
            f"replay-size is {c.replay_size}, but must be at least 4 × num-envs = {4 * c.num_envs}."
        )
    if c.yaw_copies and c.replay_dtype != "float32":
        yield f"replay-dtype is {c.replay_dtype}, but must be float32 with yaw-copies above 0."


def _downstream(c: SimpleNamespace) -> Iterator[str]:
    if c.intrinsic_decay and c.intrinsic_weight == 0:
        yield f"intrinsic-decay is {c.intrinsic_decay}, but intrinsic-weight is 0: leave one out."
    if c.task == tasks.NONE:
        if c.intrinsic_weight == 0:
            what = "method is task" if c.method == registry.TASK else "intrinsic-weight is 0"
            yield f"{what}, but task is none: name a task."
        if c.start_from in names.PLAYING:
            yield f"start-from is {c.start_from}, but task is none: name the task that is measured."
    if c.start_from != "scratch" and not c.source:
        yield (
            f"start-from is {c.start_from}, but there is no source: name the directory of a run."
        )
    if c.cell_restarts and c.restart_share:
        yield (
            f"cell-restarts is {c.cell_restarts} and restart-share is {c.restart_share}: episodes "
            f"restart at states of cells or of the first episodes, so set one of them to 0."
        )


def _updates(c: SimpleNamespace) -> float:
    """Gradient steps per vector step."""
    return c.updates_per_step * c.num_envs


def _start_in_words(c: SimpleNamespace) -> str:
    return "best" if c.start == "best" else f"best, which method {c.method} has,"
