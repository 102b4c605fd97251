"""Exact occupancies, planning and smoothed entropy of a tabular MDP, in float64.

Call these functions inside `float64()`, with an Mdp from `on_device`. They work under jit, vmap and
scan. Axes: S states, A actions, L layers of an Mdp; see mdps.Mdp.
"""

import functools
import math
from contextlib import AbstractContextManager

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.theory.mdps import Mdp

# Measured on two cores with 20 seeds in parallel. Up to UNROLLED successors, an unrolled sum is 2
# to 10 times as fast. Above SOLVED states, it is faster to iterate an occupancy until it no longer
# changes than to solve for it.
UNROLLED, SOLVED = 8, 100
ROUNDING = 1e-14  # a smaller change of an occupancy, in the 1-norm, may be rounding alone
CONVERGED = 1e-10  # share of the values' first error that is left when planning has converged


def float64() -> AbstractContextManager:
    """Returns a context in which jax computes in float64; the rest of the package uses float32."""
    return jax.enable_x64(True)


def on_device(mdp: Mdp) -> Mdp:
    """Returns the same MDP with jax arrays."""
    return Mdp(*(jnp.asarray(field) for field in mdp))


def action_values(mdp: Mdp, reward: jax.Array, values: jax.Array) -> jax.Array:
    """Returns the reward plus the expected values after it.

    Args:
      reward: [S] of the state in which an action is taken.
      values: [L, S] of the states.
    Returns:
      [L, S, A], unnormalised: a sum over the rest of the episode.
    """
    following = values[mdp.next_layer] * mdp.discount[:, None]
    most = mdp.successors.shape[-1]
    if most > UNROLLED:
        expected = jnp.sum(mdp.probabilities[None] * following[:, mdp.successors], axis=-1)
    else:
        chances = (mdp.probabilities[None, ..., i] for i in range(most))
        reached = (following[:, mdp.successors[..., i]] for i in range(most))
        expected = functools.reduce(jnp.add, map(jnp.multiply, chances, reached))
    return reward[None, :, None] + expected


def plan(mdp: Mdp, reward: jax.Array, values: jax.Array, num_steps: jax.Array | int) -> jax.Array:
    """Runs value iteration; each step is a backup of all states.

    Args:
      reward: [S] of the states.
      values: [L, S] initial values.
      num_steps: [] number of steps.
    Returns:
      [L, S] values.
    """
    return jax.lax.fori_loop(
        0, num_steps, lambda _, v: action_values(mdp, reward, v).max(axis=-1), values
    )


def converged_steps(mdp: Mdp) -> int:
    """Returns the number of planning steps after which values have converged."""
    if mdp.discount.shape[-1] > 1:  # a finite horizon is exact after that many steps
        return mdp.discount.shape[-1]
    discount = float(np.max(mdp.discount))
    return 1 if discount == 0 else max(1, math.ceil(math.log(CONVERGED) / math.log(discount)))


def planning_loss(mdp: Mdp, reward: jax.Array, values: jax.Array) -> jax.Array:
    """Bounds the normalised value that the greedy policy of these values loses.

    One more backup changes each value by between m and M. Then every policy's normalised value
    exceeds that of the values by at most M, and the greedy policy's exceeds it by at least m. So
    the loss is at most M - m.

    Args:
      reward: [S] of the states.
      values: [L, S] of the states.
    Returns:
      [] nats.
    Source: Puterman 1994, 6.6.
    """
    change = action_values(mdp, reward, values).max(axis=-1) - values
    return change.max() - change.min()


def best_value(mdp: Mdp, reward: jax.Array, num_steps: jax.Array | int) -> jax.Array:
    """Bounds <d, r> over all occupancies d from above; tight if planning has converged.

    Args:
      reward: [S] r of the states.
      num_steps: [] number of planning steps.
    Returns:
      [] the bound.
    """
    values = plan(mdp, reward, jnp.zeros((mdp.discount.shape[0], reward.shape[0])), num_steps)
    change = action_values(mdp, reward, values).max(axis=-1) - values
    return jnp.dot(mdp.start, values[0]) / episode_length(mdp) + change.max()


def episode_length(mdp: Mdp) -> jax.Array:
    """Returns the expected number of steps in an episode, []: 1/(1 - γ), or the horizon."""
    return jnp.where(len(mdp.discount) > 1, len(mdp.discount), 1 / (1 - mdp.discount[0]))


def greedy(values: jax.Array) -> jax.Array:
    """Returns the policy [..., A] that takes the best of `values` [..., A], the first if equal."""
    return jax.nn.one_hot(values.argmax(axis=-1), values.shape[-1], dtype=values.dtype)


def occupancy(mdp: Mdp, policy: jax.Array) -> jax.Array:
    """Returns the occupancy [S]: each state's share of an episode's steps, of sum 1.

    Args:
      policy: [L, S, A] probabilities.
    """
    chances = policy[..., None] * mdp.probabilities[None]
    shape = (*policy.shape[:2], -1)
    reached = jnp.broadcast_to(mdp.successors, chances.shape)
    return _occupancy(mdp, reached.reshape(shape), chances.reshape(shape))


def greedy_occupancy(mdp: Mdp, reward: jax.Array, values: jax.Array) -> jax.Array:
    """Returns the occupancy of the policy that is greedy for these values.

    Args:
      reward: [S] of the states.
      values: [L, S] of the states.
    Returns:
      [S] of sum 1.
    """
    actions = action_values(mdp, reward, values).argmax(axis=-1)
    states = jnp.arange(len(reward))
    return _occupancy(mdp, mdp.successors[states, actions], mdp.probabilities[states, actions])


def _occupancy(mdp, reached, chances):
    """[S] if each layer's states lead to the states `reached` [L, S, M] with these chances."""
    push = lambda d, reached, chances: jnp.zeros_like(d).at[reached].add(d[:, None] * chances)
    if len(reached) > 1:
        _, visits = jax.lax.scan(lambda d, move: (push(d, *move), d), mdp.start, (reached, chances))
        return visits.mean(axis=0)
    discount, begun = mdp.discount[0], (1 - mdp.discount[0]) * mdp.start  # d = begun + γ Pᵀ d
    if len(begun) <= SOLVED:
        rows = jnp.arange(len(begun))[:, None]
        transitions = jnp.zeros((len(begun),) * 2).at[rows, reached[0]].add(chances[0])
        return jnp.linalg.solve(jnp.eye(len(begun)) - discount * transitions.T, begun)
    step = lambda d: begun + discount * push(d, reached[0], chances[0])
    return jax.lax.while_loop(
        lambda now: jnp.abs(now[0] - now[1]).sum() > ROUNDING,
        lambda now: (step(now[0]), now[0]),
        (step(mdp.start), mdp.start),
    )[0]


def random_policy(mdp: Mdp, key: jax.Array) -> jax.Array:
    """Draws a policy [L, S, A] uniformly, independently in each layer and state."""
    shape = (mdp.discount.shape[0], *mdp.successors.shape[:2])
    return jax.random.dirichlet(key, jnp.ones(shape[-1]), shape[:2])


def objective(occupancy: jax.Array, smoothing: jax.Array | float) -> jax.Array:
    """Returns H_σ(d) = -Σ d(s) log(d(s) + σ) in nats; at σ = 0 this is the entropy.

    Args:
      occupancy: [..., S] d.
      smoothing: [] σ.
    Returns:
      [...] nats.
    """
    return -jax.scipy.special.xlogy(occupancy, occupancy + smoothing).sum(axis=-1)


def gradient(occupancy: jax.Array, smoothing: jax.Array | float) -> jax.Array:
    """Returns the reward: the gradient of H_σ, -log(d(s) + σ) - d(s)/(d(s) + σ).

    Args: as `objective`.
    Returns:
      [..., S] nats.
    """
    total = occupancy + smoothing
    return -jnp.log(total) - occupancy / total


def sample_visits(mdp: Mdp, policy: jax.Array, max_steps: int, key: jax.Array) -> jax.Array:
    """Plays one episode and returns how often it visits each state, [S].

    Args:
      policy: [L, S, A] probabilities.
      max_steps: cut the episode after this many steps.
    """
    key_start, key_steps = jax.random.split(key)
    start = jax.random.categorical(key_start, jnp.log(mdp.start))

    def step(now, key):
        layer, state, alive = now
        key_action, key_next, key_end = jax.random.split(key, 3)
        action = jax.random.categorical(key_action, jnp.log(policy[layer, state]))
        chances = mdp.probabilities[state, action]
        following = mdp.successors[state, action]
        goes_on = jax.random.uniform(key_end) < mdp.discount[layer]
        reached = following[jax.random.categorical(key_next, jnp.log(chances))]
        return (mdp.next_layer[layer], reached, alive & goes_on), (state, alive)

    begin = jnp.zeros((), jnp.int32), start.astype(jnp.int32), jnp.ones((), bool)
    _, (states, alive) = jax.lax.scan(step, begin, jax.random.split(key_steps, max_steps))
    return jnp.zeros(len(mdp.start)).at[states].add(alive)
