"""Occupancies, planning and the smoothed entropy of a tabular MDP, exactly, in float64.

The functions here are kernels: call them inside `float64()`, with an Mdp from `on_device`, under
jit, vmap and scan as you like. Axes: S states, A actions, L layers of an Mdp; see mdps.Mdp.
"""

import functools
import math
from contextlib import AbstractContextManager

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.theory.mdps import Mdp

# Measured on two cores, 20 seeds side by side: a sum over so many successors is 2 to 10 times as
# fast written out; and where there are more states than so many, it is faster to follow the flow of
# an occupancy until it no longer changes than to solve for it.
UNROLLED, SOLVED = 8, 100
ROUNDING = 1e-14  # a smaller change of an occupancy, in the 1-norm, may be rounding alone
CONVERGED = 1e-10  # what is left of the first error of the values once planning has converged


def float64() -> AbstractContextManager:
    """A context in which jax computes in float64; the rest of the package keeps float32."""
    return jax.enable_x64(True)


def on_device(mdp: Mdp) -> Mdp:
    """The same with arrays of jax."""
    return Mdp(*(jnp.asarray(field) for field in mdp))


def action_values(mdp: Mdp, reward: jax.Array, values: jax.Array) -> jax.Array:
    """The reward now and the expected values after it.

    Args:
      reward: [S], of the state that an action is taken in.
      values: [L, S].
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
    """[L, S] values after so many steps of value iteration, each a backup of all states."""
    return jax.lax.fori_loop(
        0, num_steps, lambda _, v: action_values(mdp, reward, v).max(axis=-1), values
    )


def converged_steps(mdp: Mdp) -> int:
    """Planning steps after which values have converged."""
    if mdp.discount.shape[-1] > 1:  # a finite horizon is exact after as many
        return mdp.discount.shape[-1]
    discount = float(np.max(mdp.discount))
    return 1 if discount == 0 else max(1, math.ceil(math.log(CONVERGED) / math.log(discount)))


def planning_loss(mdp: Mdp, reward: jax.Array, values: jax.Array) -> jax.Array:
    """[] at most how much normalised value the greedy policy of these values loses, nats.

    One more backup changes the values by something between m and M. Then no policy's normalised
    value exceeds that of the values by more than M, and the greedy policy's exceeds it by at least
    m (Puterman 1994, 6.6): the loss is at most M - m.
    """
    change = action_values(mdp, reward, values).max(axis=-1) - values
    return change.max() - change.min()


def best_value(mdp: Mdp, reward: jax.Array, num_steps: jax.Array | int) -> jax.Array:
    """[] an upper bound of <d, r> over all occupancies d, tight once planning has converged."""
    values = plan(mdp, reward, jnp.zeros((mdp.discount.shape[0], reward.shape[0])), num_steps)
    change = action_values(mdp, reward, values).max(axis=-1) - values
    return jnp.dot(mdp.start, values[0]) / episode_length(mdp) + change.max()


def episode_length(mdp: Mdp) -> jax.Array:
    """[] expected steps in an episode: 1/(1 - γ), or the horizon."""
    return jnp.where(len(mdp.discount) > 1, len(mdp.discount), 1 / (1 - mdp.discount[0]))


def greedy(values: jax.Array) -> jax.Array:
    """[..., A] values to the policy [..., A] that takes the best, the first of equals."""
    return jax.nn.one_hot(values.argmax(axis=-1), values.shape[-1], dtype=values.dtype)


def occupancy(mdp: Mdp, policy: jax.Array) -> jax.Array:
    """[S] how an episode's steps are shared out over the states, of sum 1.

    Args:
      policy: [L, S, A] probabilities.
    """
    chances = policy[..., None] * mdp.probabilities[None]
    shape = (*policy.shape[:2], -1)
    reached = jnp.broadcast_to(mdp.successors, chances.shape)
    return _occupancy(mdp, reached.reshape(shape), chances.reshape(shape))


def greedy_occupancy(mdp: Mdp, reward: jax.Array, values: jax.Array) -> jax.Array:
    """[S] of the policy that is greedy for these values, `greedy`'s."""
    actions = action_values(mdp, reward, values).argmax(axis=-1)
    states = jnp.arange(len(reward))
    return _occupancy(mdp, mdp.successors[states, actions], mdp.probabilities[states, actions])


def _occupancy(mdp, reached, chances):
    """[S] where each layer's states lead to others, [L, S, M], with these chances."""
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
    """[L, S, A] drawn uniformly from all probabilities, in each layer and state by itself."""
    shape = (mdp.discount.shape[0], *mdp.successors.shape[:2])
    return jax.random.dirichlet(key, jnp.ones(shape[-1]), shape[:2])


def objective(occupancy: jax.Array, smoothing: jax.Array | float) -> jax.Array:
    """H_σ(d) = -Σ d(s) log(d(s) + σ), [..., S] -> [...] nats; the entropy at σ = 0."""
    return -jax.scipy.special.xlogy(occupancy, occupancy + smoothing).sum(axis=-1)


def gradient(occupancy: jax.Array, smoothing: jax.Array | float) -> jax.Array:
    """Its gradient, -log(d(s) + σ) - d(s)/(d(s) + σ), [..., S] -> [..., S]: the reward."""
    total = occupancy + smoothing
    return -jnp.log(total) - occupancy / total


def sample_visits(mdp: Mdp, policy: jax.Array, max_steps: int, key: jax.Array) -> jax.Array:
    """[S] how often one episode visits each state.

    Args:
      policy: [L, S, A].
      max_steps: where an episode is cut that has not ended by then.
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
