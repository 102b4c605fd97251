"""Exact neighbours against brute force in float64, from the same float32 inputs."""

import ctypes
import functools
import itertools
import shutil
import subprocess
from pathlib import Path

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies
from scipy.spatial import cKDTree

from maxent_jax import native
from maxent_jax.density.knn import (
    CUDA_FEATURES,
    CUDA_NEIGHBORS,
    FEW_QUERIES,
    LARGE_BLOCK,
    QUERIES_AT_ONCE,
    TREE_POINTS,
    TREE_QUERIES,
    by_blocks,
    by_reduction,
    in_cpp,
    knn_distances,
    smallest_k,
)

# Derived, with u = 2^-24: a difference is off by u, its square by 3u, a sum of F = 7 squares by 6u
# more, the root by half of that and u: 5.5u = 3.3e-7.
RELATIVE = 1e-6
DIMS = 7
jitted = jax.jit(knn_distances, static_argnums=2)
FORMS = {"blocks": by_blocks, "reduction": by_reduction}
if native.library():
    FORMS["every point"] = functools.partial(in_cpp, tree=False)
    FORMS["tree"] = functools.partial(in_cpp, tree=True)
JITTED = {name: jax.jit(form, static_argnums=0) for name, form in FORMS.items()}
# What the threads of a GPU do, on a CPU; the points among so many blocks.
THREADS = {"threads": 1, "threads, points in parts": 3} if shutil.which("c++") else {}


@pytest.fixture(scope="session")
def on_host(tmp_path_factory):
    """knn_on_host.cc, compiled."""
    library = tmp_path_factory.mktemp("threads") / "knn_on_host.so"
    source = Path(__file__).parent / "knn_on_host.cc"
    headers = Path(native.__file__).parent
    flags = ("-std=c++17", "-O2", "-shared", "-fPIC", "-Wno-unknown-pragmas")
    subprocess.run(["c++", *flags, "-I", headers, source, "-o", library], check=True)
    return ctypes.CDLL(str(library)).knn_on_host


def by_threads(on_host, parts, k, queries, points, exclude, labels, count):
    """As in_cuda, which leaves to by_reduction what its registers do not hold."""
    if k > CUDA_NEIGHBORS or queries.shape[1] > CUDA_FEATURES:
        return JITTED["reduction"](k, queries, points, exclude, labels, count)
    arrays = [np.ascontiguousarray(x, np.float32) for x in (queries, points)]
    arrays += [np.ascontiguousarray(x, np.int32) for x in (labels, exclude)]
    sizes = [int(count), *np.shape(queries), k, parts]
    found = np.empty((len(queries), k), np.float32)
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in (*arrays, found)]
    on_host(*pointers[:-1], *map(ctypes.c_int32, sizes), pointers[-1])
    return found


@pytest.fixture(params=[*FORMS, *THREADS])
def search(request):
    """Each form of the search, with the arguments of knn_distances."""
    form = JITTED.get(request.param)
    if form is None:
        host = request.getfixturevalue("on_host")
        form = functools.partial(by_threads, host, THREADS[request.param])

    def find(queries, points, k, exclude=None, count=None, labels=None):
        exclude = np.full(len(queries), -1, np.int32) if exclude is None else exclude
        labels = np.arange(len(points), dtype=np.int32) if labels is None else labels
        count = np.int32(len(points) if count is None else count)
        return form(k, queries, points, exclude, labels, count)

    return find


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


def test_distances_between_half_precision_states_are_those_of_their_values():
    queries = np.array([[300.0, -400.0], [1.0, 2.0]], np.float16)
    points = np.array([[0.0, 0.0], [1.0, 2.5], [-300.0, 0.0]], np.float16)
    assert_close(knn_distances(queries, points, 3), brute_force(queries, points, 3))


def gaussian(rng, num):
    return rng.standard_normal((num, DIMS))


def offset(rng, num):
    return 1e3 + rng.standard_normal((num, DIMS))


def far_offset(rng, num):
    return 1e4 + rng.standard_normal((num, DIMS))


def duplicated(rng, num):
    return np.random.default_rng(9).standard_normal((8, DIMS))[rng.integers(8, size=num)]


def nearly_duplicated(rng, num):
    return duplicated(rng, num) + 1e-4 * rng.integers(3, size=(num, DIMS))


def lattice(rng, num):
    return rng.integers(3, size=(num, DIMS))


CLOUDS = (gaussian, offset, far_offset, duplicated, nearly_duplicated, lattice)
SIZES = (  # B, M, k
    (1, 1, 1),
    (1, 100, 3),
    (5, 3, 3),
    (64, 501, 3),
    (17, 5000, 16),
    (FEW_QUERIES, 64, 3),
    (FEW_QUERIES + 1, 64, 3),
    (FEW_QUERIES + 1, LARGE_BLOCK + 5, 3),
    (FEW_QUERIES + 1, 5, 5),
)


@pytest.mark.parametrize(("num_queries", "num_points", "k"), SIZES)
@pytest.mark.parametrize("cloud", CLOUDS)
def test_distances_match_brute_force(search, cloud, num_queries, num_points, k):
    rng = np.random.default_rng(0)
    queries = cloud(rng, num_queries).astype(np.float32)
    points = cloud(rng, num_points).astype(np.float32)
    assert_close(search(queries, points, k), brute_force(queries, points, k))


@pytest.mark.parametrize("k", [1, 2, 12, 40])
def test_any_k_up_to_all_points_is_found_in_ascending_order(search, k):
    rng = np.random.default_rng(1)
    queries, points = (gaussian(rng, num).astype(np.float32) for num in (6, 40))
    found = search(queries, points, k)
    assert_close(found, brute_force(queries, points, k))
    assert (np.diff(found, axis=1) >= 0).all()


@pytest.mark.parametrize("dims", [1, 2, 3, 4, 5, 6, 8, 12, 64])
def test_any_number_of_features_is_accepted(search, dims):
    rng = np.random.default_rng(2)
    queries, points = (rng.standard_normal((num, dims), np.float32) for num in (9, 300))
    # Derived as above: (dims + 4) / 2 rounding errors.
    expected = brute_force(queries, points, 3)
    np.testing.assert_allclose(search(queries, points, 3), expected, rtol=(dims + 4) * 2**-25)


@pytest.mark.parametrize("num_copies", [FEW_QUERIES // 30, FEW_QUERIES // 30 + 2])
def test_a_point_that_excludes_itself_still_sees_its_duplicates(search, num_copies):
    rng = np.random.default_rng(3)
    points = np.tile(gaussian(rng, 30), (num_copies, 1)).astype(np.float32)
    itself = np.arange(len(points), dtype=np.int32)
    found = search(points, points, 3, itself)
    assert (found == 0).all()
    exclude = np.where(itself % 2 == 0, itself, -1)[:30]
    found = search(points[:30], points[:60], 3, exclude)
    assert_close(found, brute_force(points[:30], points[:60], 3, exclude))
    np.testing.assert_array_equal((found == 0).sum(1), np.where(exclude >= 0, 1, 2))


def test_a_query_left_with_fewer_than_k_points_gets_inf_for_the_missing(search):
    points = np.array([[0.0], [1.0], [3.0]], np.float32)
    found = search(points, points, 3, np.array([0, 1, -1], np.int32))
    np.testing.assert_array_equal(found, [[1, 3, np.inf], [1, 2, np.inf], [0, 2, 3]])


def test_a_reduction_takes_many_queries_in_groups():
    rng = np.random.default_rng(0)
    points = gaussian(rng, 5).astype(np.float32)
    queries = gaussian(rng, 2 * QUERIES_AT_ONCE + 1).astype(np.float32)
    exclude = np.arange(len(queries), dtype=np.int32) % 6 - 1
    labels, count = np.arange(5, dtype=np.int32), np.int32(5)
    found = JITTED["reduction"](3, queries, points, exclude, labels, count)
    assert_close(found, brute_force(queries, points, 3, exclude))


@pytest.mark.parametrize("num_queries", [50, FEW_QUERIES + 1])
def test_labels_hide_all_points_of_a_label(search, num_queries):
    rng = np.random.default_rng(4)
    queries = gaussian(rng, num_queries).astype(np.float32)
    points = gaussian(rng, 70).astype(np.float32)
    labels = rng.integers(4, size=70).astype(np.int32)
    exclude = rng.integers(-1, 6, size=num_queries).astype(np.int32)
    expected = brute_force(queries, points, 3, exclude, labels=labels)
    assert_close(search(queries, points, 3, exclude, None, labels), expected)
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
def test_neighbours_missing_under_a_traced_count_are_inf(search, count):
    rng = np.random.default_rng(6)
    queries, points = (gaussian(rng, num).astype(np.float32) for num in (4, 20))
    found = search(queries, points, 3, None, count)
    assert_close(found, brute_force(queries, points, 3, count=count))
    np.testing.assert_array_equal(np.isinf(found).sum(1), 3 - count)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("batched", [jax.vmap, lambda f: functools.partial(jax.lax.map, f)])
def test_vmap_and_scan_find_the_same_neighbours(batched, form):
    rng = np.random.default_rng(7)
    queries, points = (rng.standard_normal((4, num, DIMS)).astype(np.float32) for num in (11, 121))
    exclude = rng.integers(-1, 21, size=(4, 11)).astype(np.int32)
    labels = np.tile(np.arange(121, dtype=np.int32), (4, 1))
    count = np.array([2, 7, 116, 121], np.int32)
    found = jax.jit(batched(lambda batch: FORMS[form](3, *batch)))(
        (queries, points, exclude, labels, count)
    )
    for i in range(4):
        assert_close(found[i], brute_force(queries[i], points[i], 3, exclude[i], count[i]))


@pytest.mark.parametrize("form", FORMS)
def test_nested_vmaps_share_what_they_do_not_map_over(form):
    rng = np.random.default_rng(8)
    queries = rng.standard_normal((2, 3, 5, DIMS)).astype(np.float32)
    points = rng.standard_normal((3, 90, DIMS)).astype(np.float32)
    exclude = rng.integers(-1, 9, size=(2, 5)).astype(np.int32)
    labels = np.arange(90, dtype=np.int32)

    def find(queries, points, exclude):
        return FORMS[form](3, queries, points, exclude, labels, jnp.int32(90))

    of_points = jax.vmap(find, in_axes=(0, 0, None))
    found = jax.jit(jax.vmap(of_points, in_axes=(0, None, 0)))(queries, points, exclude)
    for i, j in np.ndindex(2, 3):
        assert_close(found[i, j], brute_force(queries[i, j], points[j], 3, exclude[i]))


def test_what_is_not_finite_is_nobodys_neighbour_and_has_nan(search):
    rng = np.random.default_rng(9)
    queries, points = (gaussian(rng, num).astype(np.float32) for num in (40, 300))
    not_finite = [3, 70, 299, *range(0, 300, 20)]  # first, last and within a block of four
    clean = np.delete(points, not_finite, axis=0)
    points[not_finite, 0] = np.nan
    points[70, 0], points[299, 6] = np.inf, -np.inf
    queries[5, 1], queries[6, 0], queries[7, 6] = np.nan, np.inf, -np.inf
    found = search(queries, points, 3)
    assert np.isnan(found[5:8]).all()
    kept = np.delete(np.arange(40), [5, 6, 7])
    assert_close(found[kept], brute_force(queries[kept], clean, 3))


def test_points_none_of_which_is_finite_leave_no_neighbour(search):
    found = search(np.zeros((3, 2), np.float32), np.full((70, 2), np.nan, np.float32), 2)
    assert np.isposinf(found).all()


def walk(rng, num):
    """Dense, low-dimensional and unevenly spread, as the states of a run are."""
    return np.cumsum(rng.standard_normal((num, DIMS)), axis=0).astype(np.float32)


def test_what_the_tree_finds_is_what_every_point_gives_to_the_bit():
    rng = np.random.default_rng(10)
    points = walk(rng, 50_000)
    queries = points[::25] + rng.standard_normal((2000, DIMS)).astype(np.float32)
    exclude = np.arange(0, 50_000, 25, dtype=np.int32)
    labels = np.arange(50_000, dtype=np.int32)
    arguments = queries, points, exclude, labels, np.int32(49_990)
    names = [name for name in JITTED if name in ("every point", "tree")]
    found = [np.asarray(JITTED[name](3, *arguments)) for name in names]
    for one, other in itertools.pairwise(found):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("form", FORMS)
def test_no_matrix_of_distances_is_stored(form):
    queries, points = (jax.ShapeDtypeStruct((n, DIMS), jnp.float32) for n in (4096, 16_384))
    labels, exclude = (jax.ShapeDtypeStruct((n,), jnp.int32) for n in (16_384, 4096))
    count = jax.ShapeDtypeStruct((), jnp.int32)
    program = JITTED[form].lower(3, queries, points, exclude, labels, count).compile()
    # Beside the inputs, 0.6 MB: a matrix would be 268 MB.
    assert program.memory_analysis().temp_size_in_bytes < 4e6


def test_a_large_problem_is_solved_exactly():
    """Large enough that the search chooses a tree for itself."""
    rng = np.random.default_rng(11)
    points = walk(rng, TREE_POINTS)
    queries = points[:: TREE_POINTS // TREE_QUERIES] + np.float32(0.5)
    distance, _ = cKDTree(points.astype(np.float64)).query(queries.astype(np.float64), 3)
    assert_close(jitted(queries, points, 3), distance)


@pytest.mark.parametrize("form", FORMS)
@hypothesis.settings(max_examples=40, deadline=None)
@hypothesis.given(data=strategies.data())
def test_any_small_problem_is_solved_exactly(form, data):
    """Multiples of 1/4, whose squares float32 holds: ties, duplicates and zeros, without error."""
    # Few shapes, so that few programs are compiled.
    num_queries, num_points, dims, k = data.draw(
        strategies.sampled_from([(1, 1, 1, 1), (3, 65, 2, 3), (18, 10, 7, 2), (5, 150, 3, 5)])
    )
    coordinate = strategies.integers(-8, 8)
    draw = lambda num: (
        np.array(
            data.draw(strategies.lists(coordinate, min_size=num * dims, max_size=num * dims)),
            np.float32,
        ).reshape(num, dims)
        / np.float32(4)
    )
    queries, points = draw(num_queries), draw(num_points)
    label = strategies.integers(0, 4)
    exclude = np.array([data.draw(strategies.integers(-1, 5)) for _ in range(num_queries)])
    labels = np.array(data.draw(strategies.lists(label, min_size=num_points, max_size=num_points)))
    count = data.draw(strategies.integers(0, num_points))
    found = JITTED[form](k, queries, points, np.int32(exclude), np.int32(labels), np.int32(count))
    expected = brute_force(queries, points, k, exclude, count, labels)
    np.testing.assert_array_equal(found, expected.astype(np.float32))


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
