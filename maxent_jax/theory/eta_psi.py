"""ηψ-learning (Jain et al. 2023), with a table over histories instead of a recurrent network.

One policy sees the episode so far, and seeks a large entropy of that single trajectory:

    η(h_t) = η(h_{t-1}) + e(s_t)                          visits so far: Histories.counts
    ψ(h_t, a_t) += α [e(s_{t+1}) + ψ(h_{t+1}, a*) - ψ(h_t, a_t)]       visits still to come
    a* = argmax_a u(h_{t+1}, a),   u(h, a) = H[η(h) + ψ(h, a)]         H of normalised visits

u is the entropy of the expected visits. In a deterministic MDP that is the entropy of the
trajectory, so the fixed point is optimal. Elsewhere u exceeds the expected entropy, as H is
concave, and the fixed point need not be optimal.

Source: the formulas are those of the official code (arnavkj1995/Eta_Psi_Learning), but for three
things. It decays η and ψ by γ = 0.95 a step, and in its chain and grids ψ looks beyond the time
limit; here γ = 1 and ψ ends at the horizon, so that η + ψ are the visits of one trajectory. It
counts s_t in η and in ψ(h_t, a_t), unlike its comment; here s_t is in η alone. Its ψ is a GRU,
trained by Adam on replayed sequences.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax.theory import tabular
from maxent_jax.theory.histories import Histories, entropy


class Settings(NamedTuple):
    """Settings of learning; ε and the random share are those of the official code's chain."""

    num_episodes: int = 10_000
    random_share: float = 0.025  # of the episodes, the first ones: they act uniformly at random
    exploration: float = 0.05  # ε: probability of a random action afterwards
    step_size: float = 0.1  # α


def greedy_policy(histories: Histories, psi: np.ndarray) -> np.ndarray:
    """Returns the policy [..., X, A] that is greedy for ψ [..., X, A, S]; the first if equal."""
    utility = entropy(histories.counts[:, None] + psi)
    return np.eye(psi.shape[-2])[utility.argmax(-1)]


def fixed_point(histories: Histories) -> np.ndarray:
    """Returns the fixed point of learning, ψ [X, A, S], by backward induction."""
    num_actions, num_states = histories.following.shape[1], histories.counts.shape[1]
    psi = np.zeros((len(histories.state), num_actions, num_states))
    still = np.eye(num_states)[histories.state]  # visits from now on under the greedy policy
    for now in reversed(histories.times[:-1]):
        chances = histories.probabilities[now][..., None]
        psi[now] = (chances * still[histories.following[now]]).sum(axis=2)
        some = histories._replace(counts=histories.counts[now])
        still[now] += (greedy_policy(some, psi[now])[..., None] * psi[now]).sum(axis=1)
    return psi


def learn(histories: Histories, settings: Settings, keys: jax.Array) -> np.ndarray:
    """Learns ψ from episodes.

    Args:
      histories: of the MDP.
      settings: of learning.
      keys: [K] typed keys, one per run.
    Returns:
      [K, X, A, S] ψ, 0 at first.
    """
    with tabular.float64():
        arrays = jax.tree.map(jnp.asarray, histories._replace(times=[]))
        return np.asarray(_runs(arrays, keys, settings, len(histories.times)))


@functools.partial(jax.jit, static_argnames=("settings", "horizon"))
def _runs(histories, keys, settings, horizon):
    return jax.vmap(lambda key: _run(histories, key, settings, horizon))(keys)


def _run(histories, key, settings, horizon):
    shape = (*histories.following.shape[:2], histories.counts.shape[1])

    def episode(psi, t):
        key_start, key_steps = jax.random.split(jax.random.fold_in(key, t))
        start = jax.random.categorical(key_start, jnp.log(histories.start))
        random = t < settings.random_share * settings.num_episodes
        step = functools.partial(
            _step, histories, settings, jnp.where(random, 1, settings.exploration)
        )
        (psi, _), _ = jax.lax.scan(step, (psi, start), jax.random.split(key_steps, horizon - 1))
        return psi, None

    return jax.lax.scan(episode, jnp.zeros(shape), jnp.arange(settings.num_episodes))[0]


def _step(histories, settings, exploration, now, key):
    psi, h = now
    key_explore, key_action, key_next = jax.random.split(key, 3)
    random = jax.random.randint(key_action, (), 0, psi.shape[1])
    action = jnp.where(
        jax.random.bernoulli(key_explore, exploration), random, _best(histories, psi, h)
    )
    chosen = jax.random.categorical(key_next, jnp.log(histories.probabilities[h, action]))
    following = histories.following[h, action, chosen]
    target = psi[following, _best(histories, psi, following)].at[histories.state[following]].add(1)
    change = settings.step_size * (target - psi[h, action])
    return (psi.at[h, action].add(change), following), None


def _best(histories, psi, h):
    visits = histories.counts[h][None] + psi[h]
    return tabular.objective(visits / visits.sum(axis=-1, keepdims=True), 0.0).argmax()
