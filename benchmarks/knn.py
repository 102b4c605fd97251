"""How many distances a second does the exact k-nearest-neighbour search make, and its peers?

A tree looks at few of the pairs: its figure is the rate at which a search of all pairs would take
as long. Queries and points are Gaussian.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from maxent_jax.density.knn import knn_distances

NUM_NEIGHBORS, NUM_FEATURES = 3, 7  # k and p of the paper
QUERIES, POINTS = (64, 4096), (16_384, 65_536)
SCAN_PAIRS = 100_000_000  # roughly how many pairs a scan visits, in at least two steps
NUM_CHECKED = 64  # queries whose distances are held against float64

Search = Callable[[jax.Array, jax.Array], jax.Array]  # [B, F], [M, F] -> [B, k]


class Problem(NamedTuple):
    """Float32 on the host, where all peers but one take it from."""

    queries: np.ndarray  # [L, B, F]: a scan searches for a fresh set in each of its L steps
    points: np.ndarray  # [M, F]

    @property
    def num_pairs(self) -> int:
        """Of one set of queries."""
        return self.queries.shape[1] * self.points.shape[0]


class Measurement(NamedTuple):
    """Of one set of queries."""

    seconds: float
    distances: np.ndarray  # [B, k]
    extra: dict[str, float]  # further columns


def make_problem(num_queries: int, num_points: int) -> Problem:
    rng = np.random.default_rng(0)
    num_sets = max(2, SCAN_PAIRS // (num_queries * num_points))
    queries = rng.standard_normal((min(num_sets, 50), num_queries, NUM_FEATURES), np.float32)
    return Problem(queries, rng.standard_normal((num_points, NUM_FEATURES), np.float32))


def ours(queries: jax.Array, points: jax.Array) -> jax.Array:
    return knn_distances(queries, points, NUM_NEIGHBORS)


def top_k(queries: jax.Array, points: jax.Array) -> jax.Array:
    """What one writes first: all squares at once, expanded, then `lax.top_k`."""
    query_squares = jnp.sum(queries**2, axis=1)[:, None]
    squared = query_squares - 2 * queries @ points.T + jnp.sum(points**2, axis=1)[None, :]
    nearest, _ = jax.lax.top_k(-squared, NUM_NEIGHBORS)
    return jnp.sqrt(jnp.maximum(-nearest, 0))


def alone(search: Search, problem: Problem, repeats: int) -> Measurement:
    queries, points = jnp.asarray(problem.queries[0]), jnp.asarray(problem.points)
    program, compile_seconds = common.compiled(search, queries, points)
    seconds = common.median_seconds(lambda: program(queries, points), repeats)
    found = np.asarray(program(queries, points))
    return Measurement(seconds, found, {"compile_seconds": compile_seconds})


def in_scan(search: Search, problem: Problem, repeats: int) -> Measurement:
    """As training uses it: inside a larger program, for fresh queries at each step."""
    queries, points = jnp.asarray(problem.queries), jnp.asarray(problem.points)

    def scan(queries, points):
        step = lambda carry, queries: (carry, search(queries, points))
        return jax.lax.scan(step, None, queries)[1]

    program, compile_seconds = common.compiled(scan, queries, points)
    seconds = common.median_seconds(lambda: program(queries, points), repeats) / len(queries)
    found = np.asarray(program(queries, points)[0])
    return Measurement(seconds, found, {"compile_seconds": compile_seconds})


def prebuilt(
    build: Callable[[], Any], search: Callable[[Any], np.ndarray], problem: Problem, repeats: int
) -> Measurement:
    """A peer that puts the points into an index first; both parts timed, apart."""
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
)


def exact(problem: Problem) -> np.ndarray:
    """[NUM_CHECKED, k] distances in float64."""
    points = problem.points.astype(np.float64)
    queries = problem.queries[0, :NUM_CHECKED].astype(np.float64)
    squared = np.stack([np.sum((points - query) ** 2, axis=1) for query in queries])
    return np.sqrt(np.sort(np.partition(squared, NUM_NEIGHBORS - 1)[:, :NUM_NEIGHBORS]))


def measure(problem: Problem, peers, repeats: int) -> Iterator[dict[str, Any]]:
    """One row for each searcher and form; a peer on the host is held against ours alone."""
    truth = exact(problem)
    our_seconds: dict[str, float] = {}  # by form

    def row(who: str, form: str, found: Measurement) -> dict[str, Any]:
        our_seconds.setdefault(form, found.seconds)
        return common.progress(
            {
                "benchmark": "knn",
                "who": who,
                "form": form,
                "queries": problem.queries.shape[1],
                "points": len(problem.points),
                "gpair_per_second": problem.num_pairs / found.seconds / 1e9,
                "ours_over_this": found.seconds / our_seconds[form],
                "max_relative_error": float(
                    np.max(np.abs(found.distances[:NUM_CHECKED] / truth - 1))
                ),
                **found.extra,
            }
        )

    for who, search in (("maxent_jax", ours), ("jax.lax.top_k", top_k)):
        yield row(who, "alone", alone(search, problem, repeats))
        yield row(who, "scan", in_scan(search, problem, repeats))
    for peer, module in peers:
        yield row(peer.distribution, "alone", peer.measure(module, problem, repeats))


def main() -> None:
    args = common.parser(__doc__).parse_args()
    common.print_versions(PEERS)
    peers = common.importable(PEERS)
    sizes = [(8, 512)] if args.toy else [(b, m) for m in POINTS for b in QUERIES]
    rows = [row for size in sizes for row in measure(make_problem(*size), peers, args.repeats)]
    for row in rows:
        common.emit(row)


if __name__ == "__main__":
    main()
