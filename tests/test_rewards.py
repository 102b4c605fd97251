"""Rewards by hand, Prop. 1, and what shaping leaves unchanged."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import gammaln

from maxent_jax import rewards

E = np.e


@pytest.mark.parametrize("dims", [2, 7])
@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("excluding", [False, True])
def test_the_reward_of_hazan_is_that_of_liu_and_abbeel_plus_the_intercept_of_prop_1(
    dims, k, excluding
):
    rng = np.random.default_rng(0)
    reference = rng.normal(0, 3, (400, dims)).astype(np.float32)
    features = reference[:100] if excluding else rng.normal(0, 3, (100, dims)).astype(np.float32)
    exclude = np.arange(100, dtype=np.int32) if excluding else None
    num_others = 399 if excluding else 400
    p_log_r = rewards.knn_reward(features, reference, k, form="paper", exclude=exclude)
    hazan = rewards.hazan_reward(features, reference, k, exclude)
    slope, intercept = np.polyfit(np.float64(p_log_r), np.float64(hazan), 1)
    expected = np.log(num_others / k) + dims / 2 * np.log(np.pi) - gammaln(dims / 2 + 1) - 1
    assert abs(slope - 1) < 1e-5
    assert abs(intercept / expected - 1) < 1e-5
    # Derived: three float32 roundings of numbers of that size.
    size = np.abs([p_log_r, hazan]).max()
    np.testing.assert_allclose(hazan, p_log_r + expected, rtol=0, atol=1e-6 * size)


@pytest.mark.parametrize(
    ("form", "distance", "expected"),
    [
        ("log1p", 0, 0),
        ("log1p", 2 * (E - 1), 1),
        ("log1p", 14, np.log(8)),
        ("linear", 0, 0),
        ("linear", 3, 1.5),
        ("log", 2, 0),
        ("log", 2 * E, 1),
        ("log", 0, np.log(0.5e-3)),
        ("log", 0.5e-3, np.log(0.5e-3)),
        ("paper", 1, 0),
        ("paper", E, 7),
        ("paper", 0, 7 * np.log(1e-3)),
        ("paper", 0.5e-3, 7 * np.log(1e-3)),
    ],
)
def test_a_form_is_what_one_computes_by_hand(form, distance, expected):
    found = rewards.of_distance(jnp.float32(distance), form, scale=2.0, dims=7)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)  # a few float32 roundings


def test_rewards_take_lists_as_the_search_does():
    states, others = [[0.0], [2.0], [5.0]], [1, -1, -1]
    arrays = np.array(states, np.float32), np.array(states, np.float32), 1
    for reward in (rewards.knn_reward, rewards.hazan_reward):
        found = reward(states, states, 1, exclude=others)
        np.testing.assert_array_equal(found, reward(*arrays, exclude=np.array(others)))
    found = rewards.renyi_reward(states, states, 1, 0.5, others)
    np.testing.assert_array_equal(found, rewards.renyi_reward(*arrays, 0.5, np.array(others)))


def test_the_reward_of_a_state_is_the_form_of_the_distance_to_its_kth_neighbour():
    reference = np.array([[0.0], [1.0], [4.0], [9.0]], np.float32)
    features = np.array([[0.0], [3.0]], np.float32)
    found = rewards.knn_reward(features, reference, 2, scale=0.5, form="linear")
    np.testing.assert_array_equal(found, [2, 4])  # R = 1, 2
    exclude = np.array([0, -1], np.int32)
    found = rewards.knn_reward(features, reference, 2, 0.5, "linear", exclude)
    np.testing.assert_array_equal(found, [8, 4])  # R = 4, 2
    found = rewards.knn_reward(features, reference, 2, 0.5, "linear", exclude, count=3)
    np.testing.assert_array_equal(found, [8, 4])
    found = rewards.knn_reward(features, reference, 2)
    np.testing.assert_allclose(found, [np.log(2), np.log(3)], rtol=1e-6)  # log1p, c = 1


@pytest.mark.parametrize(("k", "exclude", "expected"), [(1, None, 8), (2, None, 16), (2, 0, 24)])
def test_the_reward_of_hazan_is_what_one_computes_by_hand(k, exclude, expected):
    # On a line 1/density = N · 2R / k.
    reference = np.array([[1.0], [-4.0], [8.0], [99.0]], np.float32)
    exclude = None if exclude is None else np.array([exclude], np.int32)
    found = rewards.hazan_reward(np.zeros((1, 1), np.float32), reference, k, exclude)
    np.testing.assert_allclose(found, [np.log(expected) - 1], rtol=1e-6)


@pytest.mark.parametrize("alpha", [0.1, 0.9])
@pytest.mark.parametrize(("k", "exclude", "expected"), [(1, None, 8), (2, None, 16), (2, 0, 24)])
def test_the_reward_of_renyi_is_what_one_computes_by_hand(alpha, k, exclude, expected):
    reference = np.array([[1.0], [-4.0], [8.0], [99.0]], np.float32)
    exclude = None if exclude is None else np.array([exclude], np.int32)
    found = rewards.renyi_reward(np.zeros((1, 1), np.float32), reference, k, alpha, exclude)
    np.testing.assert_allclose(found, [(1 - alpha) * np.log(expected)], rtol=1e-6)


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.5, np.nan])
def test_an_order_without_a_renyi_entropy_of_its_own_is_refused(alpha):
    with pytest.raises(ValueError, match="between 0 and 1"):
        rewards.renyi_reward(np.zeros((2, 1), np.float32), np.ones((5, 1), np.float32), 1, alpha)


@pytest.mark.parametrize("form", rewards.FORMS)
@pytest.mark.parametrize("scale", [0.01, 0.3, 1.0, 5.0])
def test_no_reward_is_infinite(form, scale):
    distance = jnp.array([0.0, 1e-30, 1.0, 1e30, jnp.inf])
    found = rewards.of_distance(distance, form, scale, 7)
    assert np.isfinite(found).all()
    assert (np.diff(found) >= 0).all()
    assert found[-1] > found[2]


def test_a_form_that_does_not_exist_and_a_reference_too_small_are_refused():
    features = np.zeros((2, 3), np.float32)
    with pytest.raises(ValueError, match="log1p, linear, log, paper"):
        rewards.knn_reward(features, features, 1, form="cubic")
    with pytest.raises(ValueError, match="k is 3"):
        rewards.knn_reward(features, features, 3)


@pytest.mark.parametrize(
    ("dies", "survives_death", "keeps"),
    [(False, False, True), (False, True, True), (True, False, False), (True, True, True)],
)
def test_shaping_telescopes_to_the_potentials_at_both_ends(dies, survives_death, keeps):
    rng = np.random.default_rng(1)
    steps, discount = 30, 0.97
    reward = rng.standard_normal(steps).astype(np.float32)
    potential = rng.uniform(1, 5, steps + 1).astype(np.float32)
    alive = np.ones(steps, np.float32)
    alive[-1] = 0 if dies else 1
    paid = rewards.shaped(reward, potential[:-1], potential[1:], discount, alive, survives_death)
    powers = discount ** np.arange(steps)
    difference = powers @ np.float64(paid) - powers @ np.float64(reward)
    expected = -np.float64(potential[0]) + keeps * discount**steps * np.float64(potential[-1])
    # Derived: 30 rewards of size up to 10, each off by three roundings.
    np.testing.assert_allclose(difference, expected, rtol=0, atol=30 * 3 * 10 * 2**-24)
    assert discount**steps * potential[-1] > 0.3  # what the case decides about is not lost in that


def test_a_death_is_paid_no_potential_and_a_survivor_its_own():
    paid = rewards.shaped(*map(jnp.float32, (1.0, 2.0, 8.0, 0.5)), jnp.array([0.0, 1.0]), False)
    np.testing.assert_array_equal(paid, [1 - 2, 1 + 0.5 * 8 - 2])
    paid = rewards.shaped(*map(jnp.float32, (1.0, 2.0, 8.0, 0.5)), jnp.array([0.0, 1.0]), True)
    np.testing.assert_array_equal(paid, [3, 3])


@pytest.mark.parametrize(
    ("count", "expected"),
    [(0, 0), (1, 3 * 5), (2, 3 * (5 + 10) / 2), (3, 5 + 10 + 1), (4, 5 + 2 + 1)],
)
def test_the_episodic_bonus_is_what_one_computes_by_hand(count, expected):
    earlier = jnp.array([[3.0, 4.0], [6.0, 8.0], [0.0, 1.0], [2.0, 0.0]])
    found = rewards.episodic_bonus(jnp.zeros(2), earlier, jnp.array(count), 3)
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # a few float32 roundings


@pytest.mark.parametrize("length", [1, 2, 12])
@pytest.mark.parametrize("k", [1, 3])
def test_the_episodic_bonus_is_that_of_numpy_whatever_lies_beyond_the_count(length, k):
    rng = np.random.default_rng(2)
    features = rng.standard_normal((2, 13, 7)).astype(np.float32)
    earlier = rng.standard_normal((2, 13, length, 7)).astype(np.float32)
    count = np.stack([rng.permutation(13) % (length + 1) for _ in range(2)]).astype(np.int32)
    expected = np.zeros((2, 13))
    for i, j in np.ndindex(2, 13):
        earlier[i, j, count[i, j] :] = np.nan
        apart = np.linalg.norm(
            np.float64(earlier[i, j, : count[i, j]]) - np.float64(features[i, j]), axis=-1
        )
        expected[i, j] = k * np.mean(np.sort(apart)[:k]) if len(apart) else 0
    found = jax.jit(rewards.episodic_bonus, static_argnums=3)(features, earlier, count, k)
    np.testing.assert_allclose(found, expected, rtol=2e-6)  # as for knn_distances, and a sum
