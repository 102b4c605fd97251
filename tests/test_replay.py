"""The ring against a deque of bounded length, and its draws against the uniform distribution."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from maxent_jax.sac import replay

add = jax.jit(replay.add)
ITEM = {"id": jax.ShapeDtypeStruct((), jnp.int32), "row": jax.ShapeDtypeStruct((2,), jnp.float32)}


def items(ids):
    """Rows that carry their id in both leaves; ids start at 1, since an unfilled row holds 0."""
    ids = np.asarray(ids, np.int32)
    return {"id": jnp.asarray(ids), "row": jnp.asarray(ids[:, None] * [1.0, -1.0], jnp.float32)}


def filled(capacity, num):
    """A ring into which the ids 1 .. num went one after another."""
    return add(replay.init(ITEM, capacity), items(1 + np.arange(num)), jnp.ones(num, bool))


def oldest_first(ring):
    """The ids of the filled rows; once the ring is full the oldest lies at the cursor."""
    ids, size = np.asarray(ring.items["id"]), int(ring.size)
    return np.roll(ids, -int(ring.cursor))[:size] if size == len(ids) else ids[:size]


@pytest.mark.parametrize(
    "capacity, num_rows",
    [(16, 5), (16, 16), (7, 3), (1, 1), pytest.param(5, 12, id="5-12: more rows than places")],
)
def test_ring_holds_what_a_bounded_deque_holds(capacity, num_rows):
    rng = np.random.default_rng(0)
    ring, model, last_id = replay.init(ITEM, capacity), collections.deque(maxlen=capacity), 0
    for share in rng.choice([0.0, 0.3, 0.7, 1.0], 40):  # about 20 * num_rows valid rows
        valid = rng.random(num_rows) < share
        ids = last_id + 1 + np.arange(num_rows)
        last_id = ids[-1]
        ring = add(ring, items(ids), jnp.asarray(valid))
        model.extend(ids[valid])
        assert int(ring.size) == len(model)
        assert 0 <= int(ring.cursor) < capacity  # for any number of rows: no overflow
        np.testing.assert_array_equal(oldest_first(ring), list(model))
        np.testing.assert_array_equal(ring.items["row"], items(ring.items["id"])["row"])
    assert len(model) == capacity  # so that it went round


@pytest.mark.parametrize("num", [0, 3, 8, 11], ids=["empty", "part full", "full", "gone round"])
def test_adding_no_valid_row_changes_nothing(num):
    before = filled(8, num)
    after = add(before, items([101, 102, 103]), jnp.zeros(3, bool))
    jax.tree.map(np.testing.assert_array_equal, after, before)


def test_adding_keeps_every_type_so_that_a_scan_can_carry_the_ring():
    ring = replay.init(ITEM, 8)
    after = jax.eval_shape(replay.add, ring, items([1, 2, 3]), jnp.ones(3, bool))
    kinds = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)
    assert kinds(after) == kinds(jax.eval_shape(lambda: ring))


def test_rings_side_by_side_are_each_what_they_are_alone():
    rng = np.random.default_rng(0)
    valid = jnp.asarray(rng.random((3, 6)) < 0.5)
    ids = [items(1 + 10 * seed + np.arange(6)) for seed in range(3)]
    stack = lambda trees: jax.tree.map(lambda *x: jnp.stack(x), *trees)
    rings = [filled(4, seed) for seed in range(3)]
    together = jax.vmap(add)(stack(rings), stack(ids), valid)
    alone = stack([add(*each) for each in zip(rings, ids, valid, strict=True)])
    jax.tree.map(np.testing.assert_array_equal, together, alone)


@pytest.mark.parametrize("num, held", [(7, range(1, 8)), (16, range(1, 17)), (20, range(5, 21))])
def test_sampling_is_uniform_over_the_filled_rows_and_draws_no_other(num, held, key):
    drawn = replay.sample(filled(16, num), (100, 40), key)
    assert drawn["id"].shape == (100, 40) and drawn["row"].shape == (100, 40, 2)
    np.testing.assert_array_equal(drawn["row"][..., 0], drawn["id"])
    ids, counts = np.unique(np.asarray(drawn["id"]), return_counts=True)
    np.testing.assert_array_equal(ids, list(held))
    assert scipy.stats.chisquare(counts).pvalue > 0.01  # one fixed seed


def test_sampling_an_empty_ring_gives_zeros(key):
    drawn = replay.sample(replay.init(ITEM, 4), (9,), key)
    np.testing.assert_array_equal(drawn["id"], np.zeros(9))
    np.testing.assert_array_equal(drawn["row"], np.zeros((9, 2)))
