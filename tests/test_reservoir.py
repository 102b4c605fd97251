"""The reservoir keeps each state that passed by with the same probability."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from maxent_jax.density import reservoir

CAPACITY, DIMS = 8, 3
add = jax.jit(reservoir.add)


def states(first, num):
    """Rows that say, in each feature, when they came."""
    return jnp.broadcast_to(jnp.arange(first, first + num, dtype=jnp.float32)[:, None], (num, DIMS))


def stream(batch_sizes, key, valid_every=1):
    kept = reservoir.init(CAPACITY, DIMS)
    first = 0
    for size, key_add in zip(batch_sizes, jax.random.split(key, len(batch_sizes)), strict=True):
        points = states(first, size)
        valid = points[:, 0] % valid_every == 0
        kept = add(kept, jnp.where(valid[:, None], points, jnp.nan), valid, key_add)
        first += size
    return kept


@pytest.mark.parametrize("batch_sizes", [(1,) * 8, (3, 5), (8,)])
def test_the_first_states_fill_it_in_order(key, batch_sizes):
    kept = stream(batch_sizes, key)
    np.testing.assert_array_equal(kept.points, states(0, CAPACITY))
    assert reservoir.count(kept) == kept.seen == CAPACITY


@pytest.mark.parametrize(
    ("batch_sizes", "seen"), [((), 0), ((1,), 1), ((3, 4), 7), ((5, 5), 10), ((50,), 50)]
)
def test_the_count_is_the_states_seen_or_the_capacity(key, batch_sizes, seen):
    kept = stream(batch_sizes, key) if batch_sizes else reservoir.init(CAPACITY, DIMS)
    assert kept.seen == seen
    assert reservoir.count(kept) == min(seen, CAPACITY)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("batch_sizes", "valid_every"),
    [((40,), 1), ((7, 1, 12, 20), 1), ((1,) * 16, 1), ((30, 50, 40), 3)],
    ids=["one batch", "uneven batches", "one by one", "two thirds invalid"],
)
def test_every_valid_state_is_kept_with_the_same_probability(key, batch_sizes, valid_every):
    num_runs = 10_000
    run = jax.jit(jax.vmap(functools.partial(stream, batch_sizes, valid_every=valid_every)))
    kept = run(jax.random.split(key, num_runs))
    points = np.asarray(kept.points)
    came = np.arange(0, sum(batch_sizes), valid_every)
    assert (np.asarray(kept.seen) == len(came)).all()
    # No invalid state (it would be NaN), none torn, and none twice in one reservoir.
    assert (points == points[..., :1]).all()
    assert (np.diff(np.sort(points[..., 0], axis=1), axis=1) > 0).all()
    times = np.array([(points[..., 0] == i).sum() for i in came])
    assert times.sum() == num_runs * CAPACITY
    # Derived: each count is binomial; that any of them lies beyond is a 1 in 1,000 chance.
    share = CAPACITY / len(came)
    deviation = (times - num_runs * share) / np.sqrt(num_runs * share * (1 - share))
    assert np.abs(deviation).max() < stats.norm.isf(0.5e-3 / len(came))


def test_a_batch_of_invalid_states_changes_nothing(key):
    before = stream((5, 20), key)
    after = add(before, jnp.full((9, DIMS), jnp.nan), jnp.zeros(9, bool), key)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_the_state_that_came_last_wins_a_slot(key):
    # With room for one, what a batch leaves behind is its last accepted state. Row n (from 0) is
    # accepted with probability 1/(n + 1), so the survivor is uniform over the batch.
    run = jax.vmap(lambda k: reservoir.add(reservoir.init(1, 1), states(0, 4)[:, :1], one, k))
    one = jnp.ones(4, bool)
    last = np.asarray(run(jax.random.split(key, 20_000)).points).ravel()
    # Derived: binomial, as above.
    deviation = (np.bincount(last.astype(int), minlength=4) - 5_000) / np.sqrt(20_000 * 3 / 16)
    assert np.abs(deviation).max() < stats.norm.isf(0.5e-3 / 4)
