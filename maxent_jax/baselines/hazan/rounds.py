"""A round of MaxEnt-H: train a policy, play the mixture of all policies, make the next reward.

Source: collect_baseline.py and curiosity.py of github.com/abbyvansoest/maxent_base.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax import envs
from maxent_jax.baselines.hazan import reinforce
from maxent_jax.baselines.hazan.reinforce import Policy, Probabilities
from maxent_jax.baselines.hazan.settings import Settings
from maxent_jax.density import histogram
from maxent_jax.types import Metrics


class State(NamedTuple):
    """What the next round needs from the previous ones."""

    policies: Policy  # [P, ...] zero in future rounds
    reward: jax.Array  # [cells]
    start: jax.Array  # [2] physics state
    has_start: jax.Array  # bool: false if the run had ended before the drawn time
    visits: jax.Array  # [bins, bins] int32, in training
    rollout_steps: jax.Array  # int32


class Runs(NamedTuple):
    """N runs in parallel: the first ones define the reward, the others are fresh."""

    visits: jax.Array  # [N, cells] divided by the horizon: sum below 1 if a run ended early
    state: jax.Array  # [N, T, 2] physics
    alive: jax.Array  # [N, T] bool: steps up to and including the one that reached the end


def mixture_probabilities(
    policies: Policy, weights: jax.Array, size: jax.Array | int, observation: jax.Array
) -> jax.Array:
    """Averages the action probabilities of the first `size` policies.

    Args:
      weights: [P] of the policies.
      size: [] number of policies in the mixture.
      observation: [D] observation.
    Returns:
      [3] probabilities.
    """

    def add(i, total):
        policy = jax.tree.map(lambda slots: slots[i], policies)
        return total + weights[i] * reinforce.probabilities_of(policy)(observation)

    return jax.lax.fori_loop(0, size, add, jnp.zeros(reinforce.NUM_ACTIONS))


def play(
    settings: Settings, probabilities: Probabilities, start: jax.Array, key: jax.Array
) -> Runs:
    """Plays `num_runs` runs from `start` [2], and `num_fresh` runs from rest."""
    grid = envs.entry(settings.env).grid
    number = settings.num_runs + settings.num_fresh
    of_reward = jnp.arange(number)[:, None] < settings.num_runs
    starts = jnp.where(of_reward, start[None], _rest(settings)[None])
    uniform = jax.random.uniform(key, (number, settings.horizon, 3))
    paths = jax.vmap(lambda *run: reinforce.rollout(settings, probabilities, *run))(starts, uniform)
    alive = jnp.cumsum(paths.ended, axis=1) - paths.ended == 0
    count = lambda states, counted: histogram.count(states, grid, counted.astype(jnp.int32))
    visits = jax.vmap(count)(paths.reached, alive).reshape(number, -1)
    return Runs(visits / settings.horizon, paths.state, alive)


def draw_start(settings: Settings, runs: Runs, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draws the next start [2]: the state of the reward's last run at a random time.

    With `stop_probability` the state loses its velocity. The second result [] bool says whether the
    run was alive at that time.
    """
    time, stop = jax.random.uniform(key, (2,))
    moment = jnp.floor(time * settings.horizon).astype(jnp.int32)
    last = settings.num_runs - 1
    position, velocity = runs.state[last, moment]
    velocity = jnp.where(stop < settings.stop_probability, 0.0, velocity)
    return jnp.stack([position, velocity]), runs.alive[last, moment]


def rarity(settings: Settings, density: jax.Array) -> jax.Array:
    """Returns the next reward [cells], 1/(p + σ) of the density p [cells].

    This is the gradient of Σ log(p + σ), a smoothed divergence of p from equal visits. It is not
    the gradient of the entropy, which the official code has behind a flag.
    """
    return 1 / (density + settings.smoothing)


def pooled_entropy(visits: jax.Array) -> jax.Array:
    """Returns the entropy of the first k runs' `visits` [N, cells], mean over k = 1 ... N; nats."""
    return jnp.mean(jax.vmap(histogram.shannon_entropy)(jnp.cumsum(visits, axis=0)))


def play_all(settings: Settings, weights: jax.Array, key: jax.Array) -> Metrics:
    """Plays a run of P rounds, mixed by `weights` [P, P]; returns fields of Trace, [P, ...]."""
    grid = envs.entry(settings.env).grid
    policy = jax.eval_shape(lambda: reinforce.init_policy(settings, key))
    state = State(
        policies=jax.tree.map(lambda x: jnp.zeros((settings.num_rounds, *x.shape)), policy),
        reward=jnp.zeros(grid.num_cells),
        start=_rest(settings),
        has_start=jnp.array(True),
        visits=jnp.zeros(grid.bins, jnp.int32),
        rollout_steps=jnp.zeros((), jnp.int32),
    )
    keys = jax.random.split(key, (settings.num_rounds, 6))
    rounds = (jnp.arange(settings.num_rounds), weights, keys)
    return jax.lax.scan(functools.partial(_round, settings), state, rounds)[1]


def _round(
    settings: Settings, state: State, inputs: tuple[jax.Array, ...]
) -> tuple[State, Metrics]:
    number, weights, keys = inputs
    key_train, key_reset, key_mixture, key_start, *keys_random = keys
    rest, is_first = _rest(settings), number == 0

    trained_from = jnp.where(state.has_start, state.start, rest)
    num_episodes = jnp.where(is_first, 0, settings.num_episodes)
    policy, visits = reinforce.train(settings, state.reward, trained_from, num_episodes, key_train)
    policies = jax.tree.map(lambda slots, x: slots.at[number].set(x), state.policies, policy)

    reset = reinforce.plain_reset(settings, jax.random.uniform(key_reset, (2,)))
    start = jnp.where(state.has_start, state.start, reset)
    mixed = functools.partial(mixture_probabilities, policies, weights, number + 1)
    played = play(settings, mixed, start, key_mixture)
    play_random = functools.partial(play, settings, reinforce.random_probabilities)
    by_chance = jax.vmap(play_random)(jnp.stack([rest, start]), jnp.stack(keys_random))

    measured = _measure(settings, is_first, played.visits, *by_chance.visits)
    next_start, has_start = draw_start(settings, played, key_start)
    num_steps = jnp.sum(played.alive[: settings.num_runs], dtype=jnp.int32)
    state = State(
        policies=policies,
        reward=rarity(settings, measured["density"]),
        start=next_start,
        has_start=has_start,
        visits=state.visits + visits,
        rollout_steps=state.rollout_steps + num_steps,
    )
    return state, measured | {
        "coverage": histogram.coverage(state.visits),
        "start": start,
        "rollout_steps": state.rollout_steps,
    }


def _measure(
    settings: Settings,
    is_first: jax.Array,
    played: jax.Array,
    by_chance: jax.Array,
    by_chance_from_start: jax.Array,
) -> Metrics:
    """Measures of the visits [N, cells] of the mixture and of the random policy."""
    mixture, fresh = jnp.split(played, [settings.num_runs])
    random, random_fresh = jnp.split(by_chance, [settings.num_runs])
    random_density = jnp.mean(random, axis=0)
    random_single = jnp.mean(jax.vmap(histogram.shannon_entropy)(random))
    density = jnp.where(is_first, random_density, jnp.mean(mixture, axis=0))
    return {
        "pooled_entropy": jnp.where(is_first, random_single, pooled_entropy(mixture)),
        "random_pooled_entropy": pooled_entropy(random),
        "random_single_entropy": random_single,
        "density": density,
        "random_density": random_density,
        "density_entropy": histogram.shannon_entropy(density),
        "random_density_entropy": histogram.shannon_entropy(random_density),
        "random_from_start_entropy": _entropy_together(by_chance_from_start[: settings.num_runs]),
        "fresh_entropy": _entropy_together(fresh),
        "random_fresh_entropy": _entropy_together(random_fresh),
    }


def _entropy_together(visits: jax.Array) -> jax.Array:
    return histogram.shannon_entropy(jnp.sum(visits, axis=0))


def _rest(settings: Settings) -> jax.Array:
    return jnp.array(settings.rest)
