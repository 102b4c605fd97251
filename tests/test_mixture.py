"""The mixture's weights against the literature and a QP solver; its draws against their shares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from maxent_jax import mixture
from maxent_jax.mixture.weights import CORRECTIVE_ROUNDS
from maxent_jax.sac.agent import Parameters


def parameters(i):
    return Parameters(
        actor={"kernel": jnp.full((2, 3), i, jnp.float32)},
        critic={"kernel": jnp.full((4,), 10 * i, jnp.float32)},
        target_critic={"steps": jnp.asarray(i, jnp.int32)},
        log_temperature=jnp.asarray(-i, jnp.float32),
    )


def assert_same(found, expected):
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    dtypes = [[leaf.dtype for leaf in jax.tree.leaves(tree)] for tree in (found, expected)]
    assert dtypes[0] == dtypes[1]


@pytest.mark.parametrize("append", [mixture.append, jax.jit(mixture.append)], ids=["eager", "jit"])
def test_the_archive_holds_what_was_appended_and_nothing_beyond_its_last_slot(append):
    archive = mixture.init(parameters(9), capacity=3)
    assert archive.size == 0
    for i in range(1, 6):
        archive = append(archive, parameters(i))
        assert archive.size == min(i, 3)
        for j in range(1, min(i, 3) + 1):
            assert_same(mixture.policy(archive, jnp.asarray(j - 1)), parameters(j))


def test_several_policies_are_taken_at_once():
    archive = mixture.init(parameters(0), capacity=4)
    for i in range(4):
        archive = mixture.append(archive, parameters(i))
    index = jnp.array([[3, 1, 1], [0, 2, 3]])
    taken = jax.jit(mixture.policy)(archive, index)
    assert taken.actor["kernel"].shape == (2, 3, 2, 3)
    for place in np.ndindex(2, 3):
        one = jax.tree.map(lambda leaf, place=place: leaf[place], taken)
        assert_same(one, parameters(int(index[place])))


@pytest.mark.parametrize("n", [1, 2, 7])
def test_uniform_weights_are_equal(n):
    np.testing.assert_array_equal(mixture.uniform_weights(n), [1 / n] * n)


def test_geometric_weights_are_those_of_the_official_code():
    # DESIGN.md, section 1; printed with four digits.
    expected = [0.0534, 0.1190, 0.1919, 0.2729, 0.3629]
    np.testing.assert_allclose(mixture.geometric_weights(5, 0.1), expected, rtol=0, atol=5e-5)


def nearest_on_simplex(values):
    n = len(values)
    solved = minimize(
        lambda x: 0.5 * np.sum((x - values) ** 2),
        np.full(n, 1 / n),
        jac=lambda x: x - values,
        bounds=[(0, None)] * n,
        constraints={"type": "eq", "fun": lambda x: x.sum() - 1, "jac": np.ones_like},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 1000},
    )
    assert solved.success
    return solved.x


@pytest.mark.parametrize("seed", range(50))
def test_geometric_weights_solve_the_projection_as_a_quadratic_program(seed):
    rng = np.random.default_rng(seed)
    n, eta = int(rng.integers(1, 30)), float(10 ** rng.uniform(-3, 0))
    values = np.array([(1 - eta) ** (n - i) for i in range(n)])
    # SLSQP stops at a change of the objective of 1e-15, whose root is a distance of 3e-8.
    found = mixture.geometric_weights(n, eta)
    np.testing.assert_allclose(found, nearest_on_simplex(values), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.2, 0.8], [0.2, 0.8]),
        ([2.0, 0.0], [1.0, 0.0]),
        ([1.2, 0.4], [0.9, 0.1]),
        ([-1.0, -1.0, -1.0, -1.0], [0.25, 0.25, 0.25, 0.25]),
        ([0.0, 5.0, 5.0], [0.0, 0.5, 0.5]),
        ([7.0], [1.0]),
    ],
)
def test_the_projection_on_the_simplex_is_what_one_computes_by_hand(values, expected):
    found = mixture.project_to_simplex(np.array(values))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("n", [1, 4, 20])
def test_geometric_weights_with_eta_one_are_uniform(n):
    np.testing.assert_allclose(mixture.geometric_weights(n, 1.0), np.full(n, 1 / n), rtol=1e-15)


@pytest.mark.parametrize("n", [0, -1])
def test_a_mixture_of_no_policies_is_refused(n):
    with pytest.raises(ValueError, match="at least 1 policy"):
        mixture.uniform_weights(n)
    with pytest.raises(ValueError, match="at least 1 policy"):
        mixture.geometric_weights(n, 0.1)


@pytest.mark.parametrize("eta", [0.0, -0.1, 1.1, float("nan")])
def test_an_eta_outside_its_range_is_refused(eta):
    with pytest.raises(ValueError, match="eta is"):
        mixture.geometric_weights(3, eta)


@pytest.mark.parametrize("kind", ["uniform", "geometric"])
def test_a_row_of_the_table_weighs_the_first_policies_and_no_others(kind):
    table = mixture.weight_table(kind, 12, 0.1)
    assert table.shape == (12, 12)
    assert table.dtype == np.float32
    np.testing.assert_allclose(table.sum(1), 1, rtol=12 * 2**-24)  # each entry is rounded once
    assert (table[np.triu_indices(12, 1)] == 0).all()
    assert (np.diff(table[4, :5]) > 0).all() == (kind == "geometric")
    row = [0.2] * 5 if kind == "uniform" else [0.0534, 0.1190, 0.1919, 0.2729, 0.3629]
    np.testing.assert_allclose(table[4, :5], row, rtol=0, atol=5e-5)


def random_weights(rng, num, zero_share):
    weights = rng.random(num) * (rng.random(num) >= zero_share)
    weights[rng.integers(num)] = 1  # never all zero
    return (weights / weights.sum()).astype(np.float32)


def rounding(num_weights, num_drawn):
    # Derived: a prefix of the weights, summed as a tree, is off by about log2(R) roundings, a tick
    # by two; either is a share of one row in num_drawn.
    return 2 * (np.log2(num_weights) + 2) * 2**-24 * num_drawn


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 1 - 2**-24])  # the last tick rounds to 1
@pytest.mark.parametrize(("num_policies", "num_episodes"), [(1, 5), (7, 32), (21, 64), (40, 8)])
def test_shares_of_the_episodes_are_off_by_less_than_one(num_policies, num_episodes, offset):
    rng = np.random.default_rng(num_policies)
    assign = jax.jit(mixture.assign_episodes, static_argnums=1)
    for _ in range(20):
        weights = random_weights(rng, num_policies, zero_share=0.3)
        plays = np.asarray(assign(weights, num_episodes, jnp.asarray(offset)))
        assert plays.dtype == np.int32
        assert (np.diff(plays) >= 0).all()
        counts = np.bincount(plays, minlength=num_policies)
        assert len(plays) == counts.sum() == num_episodes
        off = np.abs(counts - np.float64(weights) * num_episodes)
        assert off.max() < 1 + rounding(num_policies, num_episodes)
        assert (counts[weights == 0] == 0).all()


@pytest.mark.parametrize("num_policies", [1, 2, 3, 5, 6, 7, 20, 21])
@pytest.mark.parametrize("num_episodes", [21, 32, 64])
def test_equal_weights_get_equal_shares_up_to_one_episode(num_policies, num_episodes):
    weights = np.zeros(21, np.float32)
    weights[:num_policies] = 1 / num_policies
    plays = mixture.assign_episodes(jnp.asarray(weights), num_episodes, jnp.asarray(0.5))
    counts = np.bincount(plays, minlength=21)
    assert counts[num_policies:].sum() == 0
    assert counts[:num_policies].min() == num_episodes // num_policies
    assert counts[:num_policies].max() == -(-num_episodes // num_policies)


def test_a_random_offset_gives_each_policy_its_weight_on_average():
    weights = mixture.geometric_weights(5, 0.1).astype(np.float32)
    offsets = jnp.asarray((np.arange(1000) + 0.5) / 1000, jnp.float32)
    plays = jax.vmap(lambda offset: mixture.assign_episodes(weights, 7, offset))(offsets)
    share = np.bincount(np.asarray(plays).ravel(), minlength=5) / 1000
    # Derived: a count jumps at two offsets, and each jump is placed to within half of 1/1000.
    np.testing.assert_allclose(share, 7 * np.float64(weights), rtol=0, atol=1.1e-3)


@pytest.mark.parametrize(
    ("num_rows", "num_drawn"), [(6, 10), (1000, 500), (32_000, 8_192), (256_000, 131_072)]
)
def test_rows_are_drawn_by_their_share_and_never_with_weight_zero(num_rows, num_drawn):
    rng = np.random.default_rng(0)
    draw = jax.jit(mixture.draw_rows, static_argnums=1)
    tolerance = rounding(num_rows, num_drawn)
    for seed in range(5):
        weights = random_weights(rng, num_rows, zero_share=0.7)
        rows = np.asarray(draw(weights, num_drawn, jax.random.key(seed)))
        assert rows.shape == (num_drawn,)
        assert rows.dtype == np.int32
        counts = np.bincount(rows, minlength=num_rows)
        shares = np.float64(weights) / np.float64(weights).sum() * num_drawn
        assert (counts[weights == 0] == 0).all()
        assert np.abs(counts - shares).max() < 1 + tolerance
        assert (counts[shares <= 1 - tolerance] <= 1).all()
        assert (shares <= 1 - tolerance).any()


@pytest.mark.parametrize(("num_drawn", "times"), [(64, 1), (128, 2), (16, 0.25)])
def test_rows_of_equal_weight_are_drawn_equally_often(num_drawn, times):
    # Powers of two: no prefix is rounded, so that a share of one is exactly one.
    for seed in range(20):
        rows = mixture.draw_rows(jnp.full(64, 0.5), num_drawn, jax.random.key(seed))
        counts = np.bincount(rows, minlength=64)
        assert counts.min() == np.floor(times)
        assert counts.max() == np.ceil(times)


@pytest.mark.parametrize("num_drawn", [8000, 4000, 8192])
def test_every_episode_gets_its_share_of_rows(num_drawn):
    weights = jnp.ones(1000 * 32)  # 1,000 steps of 32 episodes
    rows = mixture.draw_rows(weights, num_drawn, jax.random.key(0), num_episodes=32)
    counts = np.bincount(np.asarray(rows) % 32, minlength=32)
    assert np.abs(counts - num_drawn / 32).max() <= 1
    steps = np.bincount(np.asarray(rows) // 32 // 100, minlength=10)
    assert np.abs(steps - num_drawn / 10).max() <= 32  # less than one for each episode


def test_another_key_draws_other_rows():
    weights = jnp.ones(1000)
    draws = [np.asarray(mixture.draw_rows(weights, 50, jax.random.key(i))) for i in range(2)]
    assert (draws[0] != draws[1]).any()


def test_the_last_policy_alone():
    np.testing.assert_array_equal(mixture.last_weights(4), [0, 0, 0, 1])
    table = mixture.weight_table("last", 3, eta=0.1)
    np.testing.assert_array_equal(table, np.eye(3))


@pytest.mark.parametrize("seed", range(4))
def test_weights_found_within_a_program_are_those_of_a_solver(seed):
    random = np.random.default_rng(seed)
    occupancies = random.dirichlet(np.full(40, 0.1), 6)
    begun = np.append(np.full(6, 1 / 6), 0.0).astype(np.float32)  # and an empty slot
    found = np.asarray(
        jax.jit(mixture.most_entropic_weights)(
            jnp.asarray(np.vstack([occupancies, np.zeros(40)]), jnp.float32), begun
        )
    )
    assert found[6] == 0 and found.min() >= 0
    assert found.sum() == pytest.approx(1, abs=1e-5)

    def entropy(weights):
        mixed = weights @ occupancies
        return -(mixed * np.log(np.maximum(mixed, 1e-300))).sum()

    best = entropy(mixture.fully_corrective_weights(occupancies, 1e-12))
    assert entropy(np.full(6, 1 / 6)) < best - 1e-3  # so that there was something to find
    assert best - entropy(found[:6]) < np.log(6) / CORRECTIVE_ROUNDS  # derived: its bound
