// What one GPU thread does in the search for nearest neighbours. It keeps a few queries in its
// registers and compares them with all points, in tiles that the threads of a block load together.
// Plain C++, so that a CPU can run the same steps (tests/test_knn.py).

#ifndef MAXENT_JAX_NATIVE_KNN_THREAD_H_
#define MAXENT_JAX_NATIVE_KNN_THREAD_H_

#include <cmath>
#include <cstdint>
#include <limits>

#ifdef __CUDACC__
#define ON_BOTH __host__ __device__ __forceinline__
#define UNROLLED _Pragma("unroll")
#else
#define ON_BOTH inline
#define UNROLLED
#endif

namespace maxent {

constexpr int kThreads = 128;  // of a block
constexpr int kTile = 128;     // points in shared memory at a time

// A point in a tile: its coordinates, filled up with 0, and its label. Eight slots, which are two
// reads of 16 bytes, hold the paper's seven features.
template <int kSlots>
struct alignas(16) Point {
  float coordinates[kSlots - 1];
  int32_t label;
};

struct Problem {
  const float* queries;    // [B, F]
  const float* points;     // [M, F]
  const int32_t* labels;   // [M]
  const int32_t* exclude;  // [B]
  int32_t num_filled;      // the first points, which count
  int32_t num_queries, num_features;
};

ON_BOTH float infinity() { return std::numeric_limits<float>::infinity(); }

// A point that is not finite, or does not exist, lies at infinity: it is never a neighbour.
template <int kSlots>
ON_BOTH Point<kSlots> load_point(const Problem& problem, int32_t index) {
  Point<kSlots> point;
  const bool there = index < problem.num_filled;
  bool is_finite = there;
  UNROLLED
  for (int f = 0; f < kSlots - 1; ++f) {
    const bool has = there && f < problem.num_features;
    point.coordinates[f] = has ? problem.points[int64_t(index) * problem.num_features + f] : 0.0f;
    is_finite = is_finite && fabsf(point.coordinates[f]) < infinity();
  }
  if (!is_finite) point.coordinates[0] = infinity();
  point.label = there ? problem.labels[index] : -2;
  return point;
}

template <int kSlots, int kNeighbors, int kQueries>
struct Thread {
  float coordinates[kQueries][kSlots - 1];
  float smallest[kQueries][kNeighbors];  // squares, ascending
  int32_t exclude[kQueries];

  // Loads queries first, first + stride, ...; beyond the last query it repeats the last.
  ON_BOTH void load(const Problem& problem, int32_t first, int32_t stride) {
    UNROLLED
    for (int q = 0; q < kQueries; ++q) {
      const int32_t wanted = first + q * stride;
      const int32_t query = wanted < problem.num_queries ? wanted : problem.num_queries - 1;
      exclude[q] = problem.exclude[query];
      UNROLLED
      for (int f = 0; f < kSlots - 1; ++f)
        coordinates[q][f] = f < problem.num_features
                                ? problem.queries[int64_t(query) * problem.num_features + f]
                                : 0.0f;
      UNROLLED
      for (int i = 0; i < kNeighbors; ++i) smallest[q][i] = infinity();
    }
  }

  ON_BOTH void meet(const Point<kSlots>& point) {
    UNROLLED
    for (int q = 0; q < kQueries; ++q) {
      float square = 0.0f;
      UNROLLED
      for (int f = 0; f < kSlots - 1; ++f) {
        const float difference = coordinates[q][f] - point.coordinates[f];
        square = fmaf(difference, difference, square);
      }
      // Rare: few points are among the nearest so far.
      if (square < smallest[q][kNeighbors - 1] && point.label != exclude[q])
        insert(square, smallest[q]);
    }
  }

  // The larger one moves to the next place.
  ON_BOTH static void insert(float square, float* ascending) {
    UNROLLED
    for (int i = 0; i < kNeighbors; ++i) {
      const float here = ascending[i];
      ascending[i] = fminf(here, square);
      square = fmaxf(here, square);
    }
  }

  // A query that is not finite gets NaN.
  ON_BOTH float distance(int q, int i) const {
    bool is_finite = true;
    UNROLLED
    for (int f = 0; f < kSlots - 1; ++f)
      is_finite = is_finite && fabsf(coordinates[q][f]) < infinity();
    return is_finite ? sqrtf(smallest[q][i]) : std::numeric_limits<float>::quiet_NaN();
  }
};

}  // namespace maxent

#endif  // MAXENT_JAX_NATIVE_KNN_THREAD_H_
