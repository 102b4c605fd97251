"""How many distances per second does the exact k-nearest-neighbour search make, and its peers?

A tree visits only few of the pairs, but its rate counts all of them. Queries and points are
Gaussian; --run adds states that the mixture of a run visits. Our search includes all its
preparation. A peer's index is timed separately, and a second rate includes it.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from maxent_jax import analysis, errors, native
from maxent_jax.density.knn import by_blocks, knn_distances
from maxent_jax.density.knn import in_cuda as search_in_cuda
from maxent_jax.runs import files

NUM_NEIGHBORS, NUM_FEATURES = 3, 7  # k and p of the paper
SIZES = ((64, 16_384), (4096, 65_536), (4096, 1_000_000))  # queries, points
SCAN_PAIRS = 100_000_000  # pairs in a scan, roughly; it has at least two steps
MAX_SETS = 50  # of queries
MATRIX_PAIRS = 300_000_000  # the limit for searches that store all distances: 1.2 GB
NUM_CHECKED = 64  # queries whose distances are compared with float64
NUM_SEEDS = 4
EPISODES = 20  # of each policy of a run, at a time

Search = Callable[[jax.Array, jax.Array], jax.Array]  # [B, F], [M, F] -> [B, k]


class Problem(NamedTuple):
    """Float32 arrays on the host, from which all peers but one take them."""

    data: str
    queries: np.ndarray  # [L, B, F]: a scan searches for another set in each of its L steps
    points: np.ndarray  # [M, F]

    @property
    def num_pairs(self) -> int:
        """Pairs of one set of queries and all points."""
        return self.queries.shape[1] * self.points.shape[0]


class Measurement(NamedTuple):
    """The measurement of one set of queries."""

    seconds: float
    distances: np.ndarray  # [B, k]
    extra: dict[str, float]  # further columns


def num_rows(num_queries: int, num_points: int) -> int:
    return num_sets(num_queries, num_points) * num_queries + num_points


def num_sets(num_queries: int, num_points: int) -> int:
    return min(MAX_SETS, max(2, SCAN_PAIRS // (num_queries * num_points)))


def make_problem(data: str, rows: np.ndarray, num_queries: int, num_points: int) -> Problem:
    """Makes a problem from rows [L, F] in random order: the first are queries, the last points."""
    sets = num_sets(num_queries, num_points)
    queries = rows[: sets * num_queries].reshape(sets, num_queries, NUM_FEATURES)
    return Problem(data, queries, rows[-num_points:])


def gaussian(num: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((num, NUM_FEATURES), np.float32)


def visited(directory: Path, num: int) -> np.ndarray:
    """Returns features [num, F] of states that a run's mixture visits, in random order."""
    run = analysis.load_run(directory)
    found: list[np.ndarray] = []
    while sum(map(len, found)) < num:
        occupancy = run.occupancy(EPISODES, seed=len(found))
        found.append(np.asarray(occupancy.features)[np.asarray(occupancy.alive)])
    rows = np.concatenate(found)
    return np.random.default_rng(0).permutation(rows)[:num].astype(np.float32)


def ours(queries: jax.Array, points: jax.Array) -> jax.Array:
    return knn_distances(queries, points, NUM_NEIGHBORS)


def in_xla(queries: jax.Array, points: jax.Array) -> jax.Array:
    """Our search on machines without a compiler."""
    return by_blocks(NUM_NEIGHBORS, *_everyone(queries, points))


def in_cuda(queries: jax.Array, points: jax.Array) -> jax.Array:
    """Our search in CUDA, if it was built."""
    return search_in_cuda(NUM_NEIGHBORS, *_everyone(queries, points))


def top_k(queries: jax.Array, points: jax.Array) -> jax.Array:
    """The obvious search: all expanded squares at once, then `lax.top_k`."""
    query_squares = jnp.sum(queries**2, axis=1)[:, None]
    squared = query_squares - 2 * queries @ points.T + jnp.sum(points**2, axis=1)[None, :]
    nearest, _ = jax.lax.top_k(-squared, NUM_NEIGHBORS)
    return jnp.sqrt(jnp.maximum(-nearest, 0))


def _everyone(queries, points):
    """The arguments of a search that excludes no point."""
    exclude = jnp.full(len(queries), -1, jnp.int32)
    labels = jnp.arange(len(points), dtype=jnp.int32)
    return queries, points, exclude, labels, jnp.int32(len(points))


def scan(search: Search, queries: jax.Array, points: jax.Array) -> jax.Array:
    """Searches for each set of queries in turn, [L, B, F] and [M, F] -> [L, B, k]."""
    step = lambda carry, queries: (carry, search(queries, points))
    return jax.lax.scan(step, None, queries)[1]


def alone(search: Search, problem: Problem, repeats: int) -> Measurement:
    queries, points = jnp.asarray(problem.queries[0]), jnp.asarray(problem.points)
    program, compile_seconds = common.compiled(search, queries, points)
    seconds = common.median_seconds(lambda: program(queries, points), repeats)
    found = np.asarray(program(queries, points))
    return Measurement(seconds, found, {"compile_seconds": compile_seconds})


def in_scan(search: Search, problem: Problem, repeats: int) -> Measurement:
    """Measures a search as in training: in a larger program, with other queries at each step."""
    queries, points = jnp.asarray(problem.queries), jnp.asarray(problem.points)
    program, compile_seconds = common.compiled(functools.partial(scan, search), queries, points)
    seconds = common.median_seconds(lambda: program(queries, points), repeats) / len(queries)
    found = np.asarray(program(queries, points)[0])
    return Measurement(seconds, found, {"compile_seconds": compile_seconds})


def vmapped(search: Search, problem: Problem, repeats: int) -> Measurement:
    """Measures searches of several seeds in parallel, compared with as many single searches."""
    shift = jnp.arange(NUM_SEEDS, dtype=jnp.float32)[:, None, None]
    queries, points = (jnp.asarray(x) + shift for x in (problem.queries[0], problem.points))
    together, _ = common.compiled(jax.vmap(search), queries, points)
    single, _ = common.compiled(search, queries[0], points[0])
    pairs = [(queries[i], points[i]) for i in range(NUM_SEEDS)]
    one_by_one = common.median_seconds(lambda: [single(*pair) for pair in pairs], repeats)
    seconds = common.median_seconds(lambda: together(queries, points), repeats)
    found = np.asarray(together(queries, points)[0])
    extra = {"seeds": NUM_SEEDS, "over_single_searches": seconds / one_by_one}
    return Measurement(seconds / NUM_SEEDS, found, extra)


def prebuilt(
    build: Callable[[], Any], search: Callable[[Any], np.ndarray], problem: Problem, repeats: int
) -> Measurement:
    """Measures a peer that first builds an index of the points; times both separately."""
    build_seconds = common.median_seconds(build, repeats)
    index = build()
    seconds = common.median_seconds(lambda: search(index), repeats)
    with_build = problem.num_pairs / (seconds + build_seconds) / 1e9
    extra = {"build_seconds": build_seconds, "gpair_per_second_with_build": with_build}
    return Measurement(seconds, search(index), extra)


def scipy_tree(spatial, problem: Problem, repeats: int) -> Measurement:
    return prebuilt(
        lambda: spatial.cKDTree(problem.points),
        lambda tree: tree.query(problem.queries[0], NUM_NEIGHBORS, workers=common.CORES)[0],
        *(problem, repeats),
    )


def faiss_flat(faiss, problem: Problem, repeats: int) -> Measurement:
    faiss.omp_set_num_threads(common.CORES)

    def build():
        index = faiss.IndexFlatL2(NUM_FEATURES)
        index.add(problem.points)
        return index

    def search(index):
        squared, _ = index.search(problem.queries[0], NUM_NEIGHBORS)
        return np.sqrt(np.maximum(squared, 0))

    return prebuilt(build, search, problem, repeats)


def jax_tree(jaxkd, problem: Problem, repeats: int) -> Measurement:
    queries, points = jnp.asarray(problem.queries[0]), jnp.asarray(problem.points)
    build = jax.jit(jaxkd.build_tree)
    search = jax.jit(lambda tree: jaxkd.query_neighbors(tree, queries, k=NUM_NEIGHBORS)[1])
    return prebuilt(lambda: build(points), search, problem, repeats)


def sklearn_brute(neighbors, problem: Problem, repeats: int) -> Measurement:
    settings = {"n_neighbors": NUM_NEIGHBORS, "algorithm": "brute", "n_jobs": common.CORES}
    return prebuilt(
        lambda: neighbors.NearestNeighbors(**settings).fit(problem.points),
        lambda index: index.kneighbors(problem.queries[0])[0],
        *(problem, repeats),
    )


PEERS = (
    common.Peer("scipy", "scipy.spatial", scipy_tree),
    common.Peer("faiss-cpu", "faiss", faiss_flat),
    common.Peer("scikit-learn", "sklearn.neighbors", sklearn_brute),
    common.Peer("jaxkd", "jaxkd", jax_tree),
)


def exact(problem: Problem) -> np.ndarray:
    """Returns the distances [NUM_CHECKED, k] in float64."""
    points = problem.points.astype(np.float64)
    queries = problem.queries[0, :NUM_CHECKED].astype(np.float64)
    squared = np.stack([np.sum((points - query) ** 2, axis=1) for query in queries])
    return np.sqrt(np.sort(np.partition(squared, NUM_NEIGHBORS - 1)[:, :NUM_NEIGHBORS]))


def measure(problem: Problem, peers, repeats: int) -> Iterator[dict[str, Any]]:
    """Yields a row for each search and form; peers on the host are compared with ours alone."""
    truth = exact(problem)
    our_seconds: dict[str, float] = {}  # by form

    def row(who: str, form: str, found: Measurement) -> dict[str, Any]:
        our_seconds.setdefault(form, found.seconds)
        # The distance is 0 if the query is also one of the points.
        error = np.abs(found.distances[:NUM_CHECKED] - truth) / np.maximum(truth, 1e-6)
        with_build = {}
        if "build_seconds" in found.extra:
            total = found.seconds + found.extra["build_seconds"]
            with_build = {"ours_over_this_with_build": total / our_seconds[form]}
        return {
            "benchmark": "knn",
            "data": problem.data,
            "who": who,
            "form": form,
            "queries": problem.queries.shape[1],
            "points": len(problem.points),
            "gpair_per_second": problem.num_pairs / found.seconds / 1e9,
            "ours_over_this": found.seconds / our_seconds[form],
            **with_build,
            "max_relative_error": float(np.max(error)),
            **found.extra,
        }

    searches = {"maxent_jax": ours}
    if native.library():
        searches["maxent_jax in XLA"] = in_xla
    if problem.num_pairs <= MATRIX_PAIRS:
        searches["jax.lax.top_k"] = top_k
    for who, search in searches.items():
        yield row(who, "alone", alone(search, problem, repeats))
        yield row(who, "scan", in_scan(search, problem, repeats))
    yield row("maxent_jax", "vmap", vmapped(ours, problem, repeats))
    for peer, module in peers:
        found = common.measured(peer, peer.measure, module, problem, repeats)
        if found is not None:
            yield row(peer.distribution, "alone", found)


def main() -> None:
    flags = common.parser(__doc__)
    flags.add_argument("--run", type=Path, help="a run's directory: also search its states")
    args = flags.parse_args()
    try:
        if args.run is not None:
            files.read_config(args.run)
    except errors.RunError as mistake:
        flags.error(str(mistake))
    common.print_versions(PEERS)
    peers = common.importable(PEERS)
    sizes = [(8, 512)] if args.toy else SIZES
    most = max(num_rows(*size) for size in sizes)
    clouds = {"gaussian": gaussian(most)}
    if args.run is not None:
        clouds["run"] = visited(args.run, most)
    for data, size in itertools.product(clouds, sizes):
        for row in measure(make_problem(data, clouds[data], *size), peers, args.repeats):
            common.emit(row)


if __name__ == "__main__":
    main()
