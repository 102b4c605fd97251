"""MaxEnt-H in the two classic environments, step by step as in its authors' code.

    reinforce  a policy of three actions, its trajectories, its training
    rounds     policies from scratch, one after another; each is rewarded for states that the
               mixture of the earlier ones visits rarely
    run        many runs in parallel

One thing is more general than in the code: the policies of the mixture have weights. They are data,
so one program runs all weightings and seeds. Where the code does something unexpected, this follows
the code:

- The density of the runs is their visits divided by the horizon, even if the goal cuts a run short.
  In the first round it is the density of the random policy, and the round's policy is untrained.
- The reward is 1/(density + σ), with σ = 1/sqrt(12 · 11) for the pendulum too, which has 64 cells.
- All runs of a mixture start in one state: the state of the previous round's last run at a random
  time. If that run had ended by then, they start from a plain reset, and training starts at rest.
- Every second episode of training begins in that state, the others with a plain reset. (This is
  maxent_base; in the copy abbyvansoest/maxent it is every fifth episode.)
- At the goal, training resets the car and continues. The next action is still chosen for the state
  at the goal, and returns accumulate through the reset.

The plain reset is that of the authors' patch of gym (abbyvansoest/maxent, `gym_patch`): a given
state is used for one reset only. All other resets are gym's; the car starts at rest in
[-0.6, -0.4]. To reset to any state, use
`_replace(reset_low=(-1.2, -0.07), reset_high=(0.6, 0.07))`.

One thing does not follow the code: the pendulum's speed has eight cells over ±8 rad/s. The code
makes such cells, but sorts speeds into those of the angle, [0, π]: all speeds below π/8 share one.

Left out are the online variant, and a run that plays at random but is printed as a policy's. The
physics of `envs` differ from gym's of 2018: its pendulum turned by its speed before the limit of
8 rad/s applied, and its car reached the goal at any velocity.

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
    """The measures of R runs, with an entry for each of P rounds; entropies in nats.

    The official figure plots `running_entropy` and `random_running_entropy`. These two are not
    comparable: one run has a lower entropy than several runs together, and the random policy plays
    from rest, but the mixture from `start`. Two pairs are comparable: `density_entropy` with
    `random_from_start_entropy` (both of few runs, so both too low), and `fresh_entropy` with
    `random_fresh_entropy` (both from rest).
    """

    pooled_entropy: np.ndarray  # [R, P] of the first k runs together, mean over k; official:
    # round_avg_ent. In the first round it is random_single_entropy
    random_pooled_entropy: np.ndarray  # [R, P]
    random_single_entropy: np.ndarray  # [R, P] of one run, mean; official: round_entropy_baseline
    running_entropy: np.ndarray  # [R, P] mean of pooled_entropy so far
    random_running_entropy: np.ndarray  # [R, P] mean of random_single_entropy so far
    density: np.ndarray  # [R, P, cells] defines the next reward
    random_density: np.ndarray  # [R, P, cells] from rest
    running_density: np.ndarray  # [R, P, cells] mean of density so far
    random_running_density: np.ndarray  # [R, P, cells]
    density_entropy: np.ndarray  # [R, P]
    random_density_entropy: np.ndarray  # [R, P]
    random_from_start_entropy: np.ndarray  # [R, P] as random_density_entropy, but from `start`
    fresh_entropy: np.ndarray  # [R, P] of the mixture's fresh runs together, first round included
    random_fresh_entropy: np.ndarray  # [R, P]
    coverage: np.ndarray  # [R, P] cells that training has visited so far
    start: np.ndarray  # [R, P, 2] physics state in which the reward's runs began
    rollout_steps: np.ndarray  # [R, P] in the reward's runs so far
    env_steps: np.ndarray  # [P] in training so far
    gradient_steps: np.ndarray  # [P] so far


def run(settings: Settings, weights: np.ndarray, keys: jax.Array, block: int = 10) -> Trace:
    """Runs R independent runs in parallel.

    Args:
      settings: the same for all runs.
      weights: [R, P, P]: row n - 1 weighs the first n policies, as in `mixture.weight_table`.
        The official code uses uniform weights.
      keys: [R] typed keys.
      block: number of runs that one program steps together; each core runs one block at a time.
        The networks of ten runs fit into a core's cache. On an accelerator, set it to R.
    Returns:
      The trace of all runs.
    Raises:
      ValueError: the settings are invalid, shapes do not match, or a row holds no weights.
    """
    check(settings)
    _check_weights(settings, weights, keys)
    if block < 1:
        raise ValueError(f"block is {block}, but must be at least 1")
    number, block = len(keys), min(block, len(keys))
    # Runs of the first block fill up the last one; they are dropped.
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
        raise ValueError("there are no keys, but each run needs one")
    if np.shape(weights) != expected:
        raise ValueError(f"weights have shape {np.shape(weights)}, but must have {expected}")
    mixed = np.tril(weights)
    if np.min(mixed) < 0 or np.max(np.abs(mixed.sum(-1) - 1)) > 1e-4:
        raise ValueError("row n - 1 of weights must be at least 0, and its first n must sum to 1")
