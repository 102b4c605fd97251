"""MaxEnt-H in the two classic environments, step by step as its authors' code has it.

    reinforce  a policy of three actions, its trajectories, its training
    rounds     policies from scratch, one after another, each rewarded where the mixture of those
               before it is rare
    run        many runs side by side

More general than the code in one place: the policies of the mixture have weights, and these are
data, so that all weightings and seeds are one program. Where the code and what one would expect
part, this follows the code:

- The density of the runs is their visits over the horizon, of which the goal may cut some off. Of
  the first round it is the random policy's, and the round's own policy is untrained.
- The reward is 1/(density + σ), σ = 1/sqrt(12 · 11) for the pendulum too, which has 64 cells.
- All runs of a mixture start in one state. It is drawn from the last run of the round before, at a
  random time; had that run ended by then, they start as a plain reset does, and training at rest.
- Every second episode of training begins in the same state, the others with a plain reset (so
  maxent_base; the copy in abbyvansoest/maxent has every fifth).
- At the goal training resets the car and goes on. The next action is still chosen for the state at
  the goal, and returns run on through the reset.

The plain reset is that of their patch of gym (abbyvansoest/maxent, `gym_patch`): a state to reset
to serves one reset, and others are gym's, the car's at rest in [-0.6, -0.4]. For any state
`_replace(reset_low=(-1.2, -0.07), reset_high=(0.6, 0.07))`.

Left out: the online variant, and a run printed as a policy's that plays at random. The physics of
`envs` differ in that gym's pendulum of 2018 turned by its speed before that was limited to 8 rad/s,
and its car was at the goal at any velocity.

Source: Hazan et al. 2019 (arXiv 1812.02690); github.com/abbyvansoest/maxent_base, whose README has
the settings.
"""

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np

from maxent_jax.baselines.hazan import rounds
from maxent_jax.baselines.hazan.settings import SETTINGS, Settings, check

__all__ = ["SETTINGS", "Settings", "Trace", "run"]


class Trace(NamedTuple):
    """What R runs went through: entropies in nats, an entry for each of P rounds.

    The official figure plots `running_entropy` and `random_running_entropy`. They do not compare:
    the entropy of one run alone is lower than that of several together, and the random policy
    always plays from rest, the mixture from `start`. `density_entropy` compares with
    `random_from_start_entropy`, both of few runs and therefore too low, and `fresh_entropy` with
    `random_fresh_entropy`, both from rest.
    """

    pooled_entropy: np.ndarray  # [R, P] of the first k runs together, mean over k; official:
    # round_avg_ent. Of the first round it is random_single_entropy
    random_pooled_entropy: np.ndarray  # [R, P]
    random_single_entropy: np.ndarray  # [R, P] of one run, mean; official: round_entropy_baseline
    running_entropy: np.ndarray  # [R, P] mean of pooled_entropy so far
    random_running_entropy: np.ndarray  # [R, P] mean of random_single_entropy so far
    density: np.ndarray  # [R, P, cells] which makes the next reward
    random_density: np.ndarray  # [R, P, cells] from rest
    running_density: np.ndarray  # [R, P, cells] mean of density so far
    random_running_density: np.ndarray  # [R, P, cells]
    density_entropy: np.ndarray  # [R, P]
    random_density_entropy: np.ndarray  # [R, P]
    random_from_start_entropy: np.ndarray  # [R, P] as random_density_entropy, but from `start`
    fresh_entropy: np.ndarray  # [R, P] of the mixture's fresh runs together, in the first round too
    random_fresh_entropy: np.ndarray  # [R, P]
    coverage: np.ndarray  # [R, P] cells that training has visited so far
    start: np.ndarray  # [R, P, 2] physics state in which the runs of the reward began
    rollout_steps: np.ndarray  # [R, P] in the runs of the reward so far
    env_steps: np.ndarray  # [P] in training so far
    gradient_steps: np.ndarray  # [P] so far


def run(settings: Settings, weights: np.ndarray, keys: jax.Array, block: int = 10) -> Trace:
    """R runs side by side.

    Args:
      settings: of all of them.
      weights: [R, P, P]: row n - 1 weighs the first n policies, as `mixture.weight_table` has it.
        The official code's are uniform.
      keys: [R].
      block: so many runs keep in step, and as many blocks run at once as there are cores. The
        networks of ten fit a core's cache; on an accelerator let it be R.
    Raises:
      ValueError: unfit settings, shapes that do not match, rows that are not weights.
    """
    check(settings)
    _check_weights(settings, weights, keys)
    if block < 1:
        raise ValueError(f"block is {block}, but must be at least 1")
    number, block = len(keys), min(block, len(keys))
    # The last block is filled up with runs of the first, which are dropped.
    parts = np.resize(np.arange(number), (-(-number // block), block))
    weights = np.asarray(weights, np.float32)
    program = jax.jit(jax.vmap(functools.partial(rounds.play_all, settings)))
    compiled = program.lower(weights[parts[0]], keys[parts[0]]).compile()
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        of_part = lambda part: jax.device_get(compiled(weights[part], keys[part]))
        found = list(threads.map(of_part, parts))
    measured = {name: np.concatenate([x[name] for x in found])[:number] for name in found[0]}
    episodes = settings.num_episodes * np.arange(settings.num_rounds)
    return Trace(
        **measured,
        running_entropy=_running_mean(measured["pooled_entropy"]),
        random_running_entropy=_running_mean(measured["random_single_entropy"]),
        running_density=_running_mean(measured["density"]),
        random_running_density=_running_mean(measured["random_density"]),
        env_steps=episodes * settings.train_steps,
        gradient_steps=episodes,
    )


def _running_mean(of_rounds: np.ndarray) -> np.ndarray:
    counts = np.arange(1, of_rounds.shape[1] + 1)
    return np.cumsum(of_rounds, axis=1) / counts.reshape(-1, *(1,) * (of_rounds.ndim - 2))


def _check_weights(settings: Settings, weights: np.ndarray, keys: jax.Array) -> None:
    expected = (len(keys), settings.num_rounds, settings.num_rounds)
    if not len(keys):
        raise ValueError("there are no keys, but a run needs one")
    if np.shape(weights) != expected:
        raise ValueError(f"weights have the shape {np.shape(weights)}, but must have {expected}")
    mixed = np.tril(weights)
    if np.min(mixed) < 0 or np.max(np.abs(mixed.sum(-1) - 1)) > 1e-4:
        raise ValueError("row n - 1 of the weights must be at least 0, its first n of sum 1")
