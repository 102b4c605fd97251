"""MEPOL: its estimators against NumPy and closed forms, its trust region, and what it learns."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats
from scipy.spatial import cKDTree

from maxent_jax import components
from maxent_jax.baselines import mepol
from maxent_jax.baselines.mepol import Settings, ascent, estimates
from maxent_jax.config import preset
from maxent_jax.density.entropy import knn_entropy
from maxent_jax.envs import base, pendulum

LENGTHS = (40, 7, 23, 1, 30)  # of the episodes in a batch of unequal ones
K = 4
TINY = Settings(num_episodes=10, hidden_size=32, learning_rate=1e-3)
NARROW = dict(learning_rate=0.01, kl_threshold=0.05)


class Fragile(pendulum.Pendulum):
    """A pendulum whose episode ends once it moves faster than `limit`, rad/s."""

    def __init__(self, limit):
        self.limit = limit

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(done=(jnp.abs(after.obs[2]) > self.limit).astype(jnp.float32))


@functools.lru_cache
def parts_of(limit):
    config = preset(
        "smoke", env="pendulum", episode_length=100, mixture_episodes=10, reference_size=512
    )
    return components.make(config)._replace(env=Fragile(limit))


STURDY = 4.0  # only those who have learned to swing move faster
FRAIL = 1.2  # the episodes of an untrained policy end one after the other


@functools.lru_cache
def played(p, scale=0.0):
    """A state of which the policy is away from 0 by `scale`, what it played, and the batch."""
    state = mepol.init(p, TINY, jax.random.key(0))
    draw = np.random.default_rng(0).standard_normal
    noise = lambda x: x + np.float32(scale * draw(x.shape))
    state = state._replace(policy=jax.tree.map(noise, state.policy))
    trajectories = compiled(p, mepol.play)(state.policy, starts_of(state), jax.random.key(2))
    return state, trajectories, batch_of(p, state, trajectories)


def batch_of(p, state, trajectories):
    return compiled(p, mepol.batch_of)(starts_of(state), trajectories)


def starts_of(state):
    return base.draw_starts(state.starts, TINY.num_episodes, jax.random.key(1))


@functools.lru_cache
def compiled(p, function):
    return jax.jit(functools.partial(function, p, TINY))


@functools.lru_cache
def log_prob(p):
    return jax.jit(functools.partial(ascent.log_prob, mepol.module(p, TINY)))


@functools.lru_cache
def ascend(p, **changes):
    """(policy, optimizer, batch) -> after its steps, and the entropy before; compiled."""
    settings = dataclasses.replace(TINY, **changes)
    return jax.jit(functools.partial(ascent.ascend, mepol.module(p, TINY), settings))


particles_of = jax.jit(estimates.particles, static_argnums=2)
weights_of = jax.jit(estimates.log_weights)


@jax.jit
def estimate(particles, log_ratio):
    weights = estimates.log_weights(log_ratio, particles.alive)
    return estimates.entropy(particles, weights), estimates.kl(particles, weights)


def padded(episodes):
    """[T, E, ...] of a list of episodes, and what is alive of it; nonsense beyond an end."""
    longest = max(map(len, episodes))
    fill = lambda x: np.concatenate([x, np.full((longest - len(x), *x.shape[1:]), 0.1)])
    alive = np.arange(longest)[:, None] < [len(x) for x in episodes]
    stacked = np.stack([fill(x) for x in episodes], axis=1)
    return jnp.asarray(stacked, jnp.float32), jnp.asarray(alive)


def batch_of_unequal():
    generator = np.random.default_rng(0)
    episodes = [generator.standard_normal((length, 3)) for length in LENGTHS]
    ratios = [0.1 * generator.standard_normal(length) for length in LENGTHS]
    features, alive = padded(episodes)
    return episodes, ratios, particles_of(features, alive, K)


def by_hand(episodes, ratios, k):
    """Entropy and KL in float64, from lists of episodes: the official code's sums, one by one."""
    points = np.concatenate(episodes)
    weights = np.concatenate([np.exp(np.cumsum(ratio)) for ratio in ratios])
    weights = weights / weights.sum()
    dims, count = points.shape[1], len(points)
    entropy, kl = np.log(k) - special.digamma(k), 0.0
    for point in points:
        distance = np.linalg.norm(points - point, axis=1)
        order = np.argsort(distance)  # itself first
        volume = np.pi ** (dims / 2) * distance[order[k]] ** dims / special.gamma(dims / 2 + 1)
        mass = weights[order[:k]].sum()
        entropy -= mass / k * np.log(mass / volume)
        kl += np.log(k / (count * mass)) / count
    return entropy, kl


@pytest.mark.parametrize("count", [255, 300])  # the search takes 256 queries at once
def test_nearest_neighbours_are_scipys_among_the_living(count):
    generator = np.random.default_rng(count)
    points = generator.standard_normal((count, 5)).astype(np.float32)
    alive = generator.random(count) < 0.8
    distance, rows = estimates.nearest(jnp.asarray(points), jnp.asarray(alive), K)
    reference, order = cKDTree(points[alive]).query(points[alive], K + 1)
    np.testing.assert_allclose(distance[alive], reference[:, 1:], rtol=1e-6)
    np.testing.assert_array_equal(rows[alive], np.flatnonzero(alive)[order[:, 1:]])


def test_a_particle_among_copies_of_itself_is_not_its_own_neighbour():
    points = jnp.repeat(jnp.arange(4.0)[:, None], 3, axis=0)
    distance, rows = estimates.nearest(points, jnp.ones(12, bool), 3)
    np.testing.assert_array_equal(distance, np.tile([0.0, 0.0, 1.0], (12, 1)))
    assert not (rows == np.arange(12)[:, None]).any()


def test_equal_weights_give_the_plain_entropy_but_for_n_in_the_place_of_n_minus_1():
    episodes, ratios, particles = batch_of_unequal()
    entropy, kl = estimate(particles, jnp.zeros_like(padded(ratios)[0]))
    samples = np.concatenate(episodes).astype(np.float32)
    count = len(samples)
    plain = knn_entropy(jnp.asarray(samples), K) + np.log(count / (count - 1))
    np.testing.assert_allclose(entropy, plain, rtol=1e-5)  # float32 sums of a hundred terms
    np.testing.assert_allclose(kl, 0.0, atol=1e-5)


def test_weighted_entropy_and_kl_of_unequal_episodes_are_those_by_hand():
    episodes, ratios, particles = batch_of_unequal()
    entropy, kl = by_hand(episodes, ratios, K)
    assert kl > 0.01  # so that what follows says something
    found = estimate(particles, padded(ratios)[0])
    np.testing.assert_allclose(found, (entropy, kl), rtol=1e-5)


def test_the_gradient_is_that_of_finite_differences():
    episodes, ratios, particles = batch_of_unequal()
    log_ratio, alive = padded(ratios)
    gradient = jax.jit(jax.grad(lambda x: estimate(particles, x)[0]))(log_ratio)
    np.testing.assert_array_equal(gradient[~alive], 0)
    for episode, time in ((0, 0), (0, 39), (1, 3), (3, 0), (4, 15)):

        def shifted(step, episode=episode, time=time):
            moved = [ratio.copy() for ratio in ratios]
            moved[episode][time] += step
            return by_hand(episodes, moved, K)[0]

        expected = (shifted(1e-5) - shifted(-1e-5)) / 2e-5
        # rounding of the difference 1e-10, its curvature 1e-10, float32 a millionth of the largest
        np.testing.assert_allclose(gradient[time, episode], expected, rtol=1e-4, atol=1e-6)


def test_estimates_of_a_shifted_gaussian_from_particles_of_a_standard_one():
    shift, count = 0.5, 8000
    points = np.random.default_rng(0).standard_normal((1, count, 2), np.float32)
    particles = particles_of(points, jnp.ones((1, count), bool), K)
    entropy, kl = estimate(particles, shift * points[..., 0] - shift**2 / 2)
    # Over eight keys they are off by -0.006 ± 0.016 and 0.001 ± 0.003.
    np.testing.assert_allclose(entropy, np.log(2 * np.pi * np.e), atol=0.06)
    np.testing.assert_allclose(kl, shift**2 / 2, atol=0.012)


def test_a_thousand_ratios_of_e_do_not_overflow():
    points = np.random.default_rng(0).standard_normal((1000, 2, 3), np.float32)
    alive = jnp.ones((1000, 2), bool)
    particles = particles_of(points, alive, K)
    log_ratio = jnp.stack([jnp.ones(1000), -jnp.ones(1000)], axis=1)
    weights, (entropy, kl) = weights_of(log_ratio, alive), estimate(particles, log_ratio)
    # The last state of the first episode takes 1 - 1/e of the weight, the one before 1/e of that.
    np.testing.assert_allclose(np.exp(weights[-2]), 1 - np.exp(-1), rtol=1e-5)
    np.testing.assert_allclose(weights[-2] - weights[-4], 1.0, rtol=1e-3)
    assert np.isfinite(entropy)
    assert 100 < kl < 2000  # a state's weight is e^-1000 on average


def test_coinciding_particles_have_a_finite_entropy():
    particles = particles_of(jnp.zeros((20, 1, 3)), jnp.ones((20, 1), bool), K)
    entropy, _ = estimate(particles, jnp.zeros((20, 1)))
    np.testing.assert_allclose(entropy, np.log(20 * 1e-15) - special.digamma(K), rtol=1e-5)


@pytest.mark.slow
def test_log_probabilities_differ_as_those_of_scipys_normals():
    p = parts_of(FRAIL)
    state, _, batch = played(p, scale=0.3)
    module = mepol.module(p, TINY)
    other = jax.tree.map(lambda x: 0.9 * x, state.policy)
    found = log_prob(p)(state.policy, batch) - log_prob(p)(other, batch)

    def by_scipy(policy):
        mean, log_std = jax.jit(functools.partial(ascent.gaussian, module))(policy, batch.inputs)
        exact = stats.norm(np.float64(mean), np.exp(np.float64(log_std)))
        return exact.logpdf(np.float64(batch.actions)).sum(-1)

    expected = by_scipy(state.policy) - by_scipy(other)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_new_policy_is_centred_and_its_spread_is_that_of_the_settings():
    _, trajectories, _ = played(parts_of(FRAIL))
    actions = np.asarray(trajectories.actions).ravel()  # 1000 of them; four standard errors
    assert abs(actions.mean()) < 4 * np.exp(-0.5) / np.sqrt(1000)
    np.testing.assert_allclose(actions.std(), np.exp(-0.5), rtol=4 / np.sqrt(2000))


def test_a_batch_pairs_each_action_with_the_state_in_which_it_was_drawn():
    _, trajectories, batch = played(parts_of(FRAIL), scale=0.3)
    assert np.abs(batch.actions).max() > 1.2  # clipping matters
    cos, sin, speed = np.moveaxis(np.float64(batch.inputs), -1, 0)
    torque = 2 * np.clip(np.float64(batch.actions[..., 0]), -1, 1)
    # Gymnasium's Pendulum-v1: g = 10 m/s², m = 1 kg, l = 1 m, 0.05 s a step
    speed = np.clip(speed + (15 * sin + 3 * torque) * 0.05, -8, 8)
    angle = np.arctan2(sin, cos) + 0.05 * speed
    reached = np.stack([np.cos(angle), np.sin(angle), speed], axis=-1)
    alive = trajectories.alive
    np.testing.assert_allclose(trajectories.states[alive], reached[alive], atol=1e-5)


def test_an_environment_that_does_not_clip_its_actions_gets_them_clipped():
    echo = types.SimpleNamespace(step=lambda state, action: action)
    clipped = mepol.Clipped(echo).step(None, jnp.array([-3.0, 0.5, 1.5]))
    np.testing.assert_array_equal(clipped, [-1.0, 0.5, 1.0])


@pytest.mark.slow
def test_states_beyond_an_episodes_end_change_nothing():
    p = parts_of(FRAIL)
    state, trajectories, batch = played(p)
    lived = trajectories.alive.sum(0)
    assert len(np.unique(lived)) > 3 and lived.min() < lived.max() // 2
    dead = ~trajectories.alive[..., None]
    nonsense = trajectories._replace(
        states=jnp.where(dead, 0.123, trajectories.states),
        actions=jnp.where(dead, 50.0, trajectories.actions),
    )
    other = batch_of(p, state, nonsense)
    one, two = (ascend(p)(state.policy, state.optimizer, x)[0] for x in (batch, other))
    assert one.num_accepted == 30
    jax.tree.map(np.testing.assert_array_equal, one.policy, two.policy)


def ascended(scale=1.0, **changes):
    """An ascent on a batch of unequal episodes, and the entropy and KL of its end by hand.

    With inputs `scale` times as large the same step of the weights leads as much farther.
    """
    p = parts_of(FRAIL)
    state, trajectories, batch = played(p)
    batch = batch._replace(inputs=scale * batch.inputs)
    after, before = ascend(p, **changes)(state.policy, state.optimizer, batch)
    log_ratio = np.float64(log_prob(p)(after.policy, batch)) - log_prob(p)(state.policy, batch)
    alive = np.asarray(trajectories.alive)
    features = np.float64(p.phi(trajectories.states))
    lists = [[x[alive[:, e], e] for e in range(alive.shape[1])] for x in (features, log_ratio)]
    return state, after, before, by_hand(*lists, TINY.num_neighbors)


def test_small_steps_go_on_to_the_last_and_raise_the_entropy():
    _, after, before, (entropy, kl) = ascended()
    assert (after.num_accepted, after.num_refused) == (30, 0)
    assert after.entropy > before + 0.01
    np.testing.assert_allclose(after.entropy, entropy, rtol=1e-4)
    np.testing.assert_allclose(after.kl, kl, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_the_trust_region_is_not_left():
    _, after, before, (_, kl) = ascended(**NARROW)
    assert after.num_accepted >= 2 and after.num_refused >= 1  # on the way, and in the end
    assert after.entropy > before
    np.testing.assert_allclose(after.kl, kl, rtol=1e-3, atol=1e-5)
    assert 0 < kl <= 0.05 + 1e-4


def test_after_a_refusal_one_smaller_step_is_the_last():
    state, after, _, (_, kl) = ascended(scale=30.0, **NARROW)
    assert after.num_accepted == 1 and after.num_refused >= 2
    # Adam's steps along one gradient move each parameter by the rate, but where it is near 0.
    moved = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), after.policy, state.policy)
    largest = max(jax.tree.leaves(moved))
    np.testing.assert_allclose(largest, 0.01 / 2 ** int(after.num_refused), rtol=1e-3)
    assert after.optimizer.count == after.num_accepted + after.num_refused
    assert kl <= 0.05 + 1e-4


def test_steps_that_are_all_too_large_leave_the_policy_as_it_was():
    state, after, before, _ = ascended(scale=1e6, **NARROW)
    assert (after.num_accepted, after.num_refused) == (0, 10)
    jax.tree.map(np.testing.assert_array_equal, after.policy, state.policy)
    assert after.kl == 0 and after.entropy == before


def test_too_few_living_particles_teach_nothing():
    p = parts_of(FRAIL)
    state, trajectories, _ = played(p)
    few = jnp.zeros_like(trajectories.alive).at[0, :K].set(True)
    batch = batch_of(p, state, trajectories._replace(alive=few))
    after, before = ascend(p)(state.policy, state.optimizer, batch)
    assert not np.isfinite(before) and after.num_accepted == after.num_refused == 0
    jax.tree.map(np.testing.assert_array_equal, after.policy, state.policy)
    jax.tree.map(np.testing.assert_array_equal, after.optimizer, state.optimizer)


@functools.lru_cache
def run(num_iterations=4):
    """Of three seeds, one after the other: states [iterations + 1, 3, ...], and metrics of each."""
    p, states, metrics = parts_of(STURDY), [], []
    for seed in range(3):
        states.append([mepol.init(p, TINY, jax.random.key(seed))])
        metrics.append([])
        for _ in range(num_iterations):
            state, found = mepol.iterate(p, TINY, states[-1][-1])
            states[-1].append(state)
            metrics[-1].append(found)
    by_seed = [jax.tree.map(lambda *x: jnp.stack(x), *x) for x in states]
    stacked = jax.tree.map(lambda *x: jnp.stack(x, axis=1), *by_seed)
    names = metrics[0][0]
    return stacked, {n: np.array([[m[n] for m in x] for x in metrics]).T for n in names}


@pytest.mark.slow
def test_it_learns_to_visit_more_than_the_untrained_policy():
    states, metrics = run()
    cells = np.asarray(states.visits.cells).reshape(5, 3, -1)
    untrained, trained = cells[1], cells[-1] - cells[-2]  # of a batch, one seed a row
    # Measured: from 1.17 to 1.26 nats, and from 2.23 to 2.45.
    assert stats.entropy(untrained, axis=1).max() < 1.6
    assert stats.entropy(trained, axis=1).min() > 1.9
    for name in ("knn_entropy", "mixture_entropy", "mixture_knn_entropy"):
        assert (metrics[name][-1] > metrics[name][0]).all(), name


def test_cumulative_coverage_never_falls_and_every_step_is_counted():
    states, metrics = run()
    coverage = metrics["cumulative_coverage"]
    assert (np.diff(coverage, axis=0) >= 0).all() and (coverage[0] > 0).all()
    steps = metrics["num_rollout_steps"]
    assert (steps[0] == 1000).all() and (steps[-1] < 1000).all()  # some episodes ended early
    np.testing.assert_array_equal(metrics["env_steps"], np.cumsum(steps, axis=0))
    np.testing.assert_array_equal(metrics["env_steps"], states.visits.cells.sum((-1, -2))[1:])
    np.testing.assert_allclose(metrics["rollout_episode_length"], steps / 10, rtol=1e-6)
    np.testing.assert_array_equal(metrics["num_updates"], 30)
    np.testing.assert_array_equal(metrics["gradient_steps"].T, [30 * np.arange(1, 5)] * 3)
    assert (metrics["kl"] > 0).all() and (metrics["kl"] <= TINY.kl_threshold).all()


def test_iterate_is_compiled_once():
    run()
    assert mepol.iterate._cache_size() == 1


@pytest.mark.slow
def test_seeds_side_by_side_do_as_each_alone():
    states, metrics = run()
    side_by_side = jax.jit(jax.vmap(functools.partial(mepol.epoch, parts_of(STURDY), TINY)))
    state, found = side_by_side(jax.tree.map(lambda x: x[0], states))
    again, _ = side_by_side(state)
    # Measured: 4e-6, last bits that sixty steps of Adam and a hundred of the pendulum let grow.
    for one, two in zip(*map(jax.tree.leaves, (again.policy, states.policy)), strict=True):
        np.testing.assert_allclose(one, two[2], atol=1e-3)
    np.testing.assert_array_equal(again.env_steps, states.env_steps[2])
    for name in ("knn_entropy", "next_knn_entropy", "kl"):
        np.testing.assert_allclose(found[name], metrics[name][0], rtol=1e-3)


@pytest.mark.parametrize("name", ["num_episodes", "kl_threshold", "learning_rate", "max_updates"])
def test_a_setting_that_is_not_positive_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} is 0, but must be a positive number"):
        Settings(**{name: 0})


def test_more_neighbours_than_particles_are_refused(key):
    p, settings = parts_of(STURDY), dataclasses.replace(TINY, num_neighbors=1000)
    with pytest.raises(ValueError, match="1000 particles are too few for 1000 neighbours"):
        mepol.iterate(p, settings, mepol.init(p, settings, key))
