"""Exact neighbours against brute force in float64, from the same float32 inputs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from maxent_jax.density.knn import FEW_QUERIES, LARGE_BLOCK, knn_distances, smallest_k

# Derived, with u = 2^-24: a difference is off by u, its square by 3u, a sum of F = 7 squares by 6u
# more, the root by half of that and u: 5.5u = 3.3e-7.
RELATIVE = 1e-6
DIMS = 7
jitted = jax.jit(knn_distances, static_argnums=2)


def brute_force(queries, points, k, exclude=None, count=None, labels=None):
    queries, points = np.asarray(queries, np.float64), np.asarray(points, np.float64)
    squared = ((queries[:, None] - points[None]) ** 2).sum(-1)
    labels = np.arange(len(points)) if labels is None else labels
    if exclude is not None:
        squared[exclude[:, None] == labels[None]] = np.inf
    if count is not None:
        squared[:, count:] = np.inf
    return np.sqrt(np.sort(squared, axis=1)[:, :k])


def assert_close(found, expected):
    assert found.shape == expected.shape
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=RELATIVE, atol=0)


def gaussian(rng, num):
    return rng.standard_normal((num, DIMS))


def offset(rng, num):
    return 1e3 + rng.standard_normal((num, DIMS))


def duplicated(rng, num):
    return np.random.default_rng(9).standard_normal((8, DIMS))[rng.integers(8, size=num)]


def nearly_duplicated(rng, num):
    return duplicated(rng, num) + 1e-4 * rng.integers(3, size=(num, DIMS))


def lattice(rng, num):
    return rng.integers(3, size=(num, DIMS))


CLOUDS = (gaussian, offset, duplicated, nearly_duplicated, lattice)
SIZES = (  # B, M, k
    (1, 1, 1),
    (1, 100, 3),
    (5, 3, 3),
    (64, 501, 3),
    (FEW_QUERIES, 64, 3),
    (FEW_QUERIES + 1, 64, 3),
    (FEW_QUERIES + 1, LARGE_BLOCK + 5, 3),
    (FEW_QUERIES + 1, 5, 5),
)


@pytest.mark.parametrize(("num_queries", "num_points", "k"), SIZES)
@pytest.mark.parametrize("cloud", CLOUDS)
def test_distances_match_brute_force(cloud, num_queries, num_points, k):
    rng = np.random.default_rng(0)
    queries = cloud(rng, num_queries).astype(np.float32)
    points = cloud(rng, num_points).astype(np.float32)
    assert_close(jitted(queries, points, k), brute_force(queries, points, k))


@pytest.mark.parametrize("k", [1, 2, 12])
def test_any_k_up_to_all_points_is_found_in_ascending_order(k):
    rng = np.random.default_rng(1)
    queries, points = (gaussian(rng, num).astype(np.float32) for num in (6, 12))
    found = jitted(queries, points, k)
    assert_close(found, brute_force(queries, points, k))
    assert (np.diff(found, axis=1) >= 0).all()


@pytest.mark.parametrize("dims", [1, 2, 12])
def test_any_number_of_features_is_accepted(dims):
    rng = np.random.default_rng(2)
    queries, points = (rng.standard_normal((num, dims), np.float32) for num in (9, 30))
    assert_close(jitted(queries, points, 3), brute_force(queries, points, 3))


@pytest.mark.parametrize("num_copies", [FEW_QUERIES // 30, FEW_QUERIES // 30 + 2])
def test_a_point_that_excludes_itself_still_sees_its_duplicates(num_copies):
    rng = np.random.default_rng(3)
    points = np.tile(gaussian(rng, 30), (num_copies, 1)).astype(np.float32)
    itself = np.arange(len(points), dtype=np.int32)
    found = jitted(points, points, 3, itself)
    assert (found == 0).all()
    exclude = np.where(itself % 2 == 0, itself, -1)[:30]
    found = jitted(points[:30], points[:60], 3, exclude)
    assert_close(found, brute_force(points[:30], points[:60], 3, exclude))
    np.testing.assert_array_equal((found == 0).sum(1), np.where(exclude >= 0, 1, 2))


def test_a_query_left_with_fewer_than_k_points_gets_inf_for_the_missing():
    points = np.array([[0.0], [1.0], [3.0]], np.float32)
    found = jitted(points, points, 3, np.array([0, 1, -1], np.int32))
    np.testing.assert_array_equal(found, [[1, 3, np.inf], [1, 2, np.inf], [0, 2, 3]])


@pytest.mark.parametrize("num_queries", [50, FEW_QUERIES + 1])
def test_labels_hide_all_points_of_a_label(num_queries):
    rng = np.random.default_rng(4)
    queries = gaussian(rng, num_queries).astype(np.float32)
    points = gaussian(rng, 70).astype(np.float32)
    labels = rng.integers(4, size=70).astype(np.int32)
    exclude = rng.integers(-1, 6, size=num_queries).astype(np.int32)
    expected = brute_force(queries, points, 3, exclude, labels=labels)
    assert_close(jitted(queries, points, 3, exclude, None, labels), expected)
    assert (expected != brute_force(queries, points, 3)).any()


@pytest.mark.parametrize("traced", [True, False], ids=["traced", "concrete"])
@pytest.mark.parametrize("count", [3, 8, 13, 20])
def test_only_the_first_count_points_are_seen_whatever_the_others_hold(count, traced):
    rng = np.random.default_rng(5)
    queries, points = (gaussian(rng, num).astype(np.float32) for num in (10, 20))
    points[count:] = np.nan
    exclude = np.arange(10, dtype=np.int32)
    found = (jitted if traced else knn_distances)(queries, points, 3, exclude, count)
    points[count:] = 0
    assert_close(found, brute_force(queries, points, 3, exclude, count))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_neighbours_missing_under_a_traced_count_are_inf(count):
    rng = np.random.default_rng(6)
    queries, points = (gaussian(rng, num).astype(np.float32) for num in (4, 20))
    found = jitted(queries, points, 3, None, count)
    assert_close(found, brute_force(queries, points, 3, count=count))
    np.testing.assert_array_equal(np.isinf(found).sum(1), 3 - count)


@pytest.mark.parametrize("batched", [jax.vmap, lambda f: functools.partial(jax.lax.map, f)])
def test_vmap_and_scan_find_the_same_neighbours(batched):
    rng = np.random.default_rng(7)
    queries, points = (rng.standard_normal((4, num, DIMS)).astype(np.float32) for num in (11, 21))
    exclude = rng.integers(-1, 21, size=(4, 11)).astype(np.int32)
    count = np.array([2, 7, 16, 21], np.int32)
    find = lambda batch: knn_distances(batch[0], batch[1], 3, batch[2], batch[3])
    found = jax.jit(batched(find))((queries, points, exclude, count))
    for i in range(4):
        assert_close(found[i], brute_force(queries[i], points[i], 3, exclude[i], count[i]))


def test_points_and_a_count_known_to_the_trace_are_accepted():
    rng = np.random.default_rng(8)
    queries, points = (jnp.asarray(gaussian(rng, num), jnp.float32) for num in (4, 20))
    found = jax.jit(lambda q: knn_distances(q, points, 3, count=15))(queries)
    assert_close(found, brute_force(queries, points, 3, count=15))


@pytest.mark.parametrize(
    ("queries", "points", "k", "count", "message"),
    [
        (np.ones((2, 3)), np.ones((5, 3)), 0, None, "k is 0"),
        (np.ones((2, 3)), np.ones((5, 3)), 6, None, "number of points, 5"),
        (np.ones((2, 3)), np.ones((5, 3)), 3, 2, "number of points, 2"),
        (np.ones((2, 3)), np.ones((5, 4)), 1, None, "must be"),
        (np.ones(3), np.ones((5, 3)), 1, None, "must be"),
        (np.ones((2, 3)), np.ones(3), 1, None, "must be"),
        (np.full((2, 3), np.nan), np.ones((5, 3)), 1, None, "queries hold"),
        (np.full((2, 3), np.inf), np.ones((5, 3)), 1, None, "queries hold"),
        (np.ones((2, 3)), np.full((5, 3), np.nan), 1, None, "points hold"),
        (np.ones((2, 3)), np.full((5, 3), -np.inf), 1, None, "points hold"),
    ],
)
def test_what_has_no_neighbours_is_refused(queries, points, k, count, message):
    with pytest.raises(ValueError, match=message):
        knn_distances(queries.astype(np.float32), points.astype(np.float32), k, count=count)


@pytest.mark.parametrize("shape", [(6,), (5, 9), (2, 3, 8)])
@pytest.mark.parametrize("k", [1, 3, 6])
def test_the_smallest_k_are_those_of_a_sort(shape, k):
    rng = np.random.default_rng(10)
    values = rng.integers(5, size=shape).astype(np.float32)  # ties
    values[rng.random(shape) < 0.3] = np.inf
    expected = np.sort(values, axis=-1)[..., :k]
    np.testing.assert_array_equal(smallest_k(jnp.asarray(values), k), expected)


def test_the_smallest_of_a_row_shorter_than_k_ends_in_inf():
    found = smallest_k(jnp.array([[2.0, 1.0]]), 4)
    np.testing.assert_array_equal(found, [[1, 2, np.inf, np.inf]])
