// The steps of a GPU's threads in the search for nearest neighbours, gone through one by one.

#include <cstdint>
#include <vector>

#include "knn_thread.h"

namespace {

using maxent::kThreads;
using maxent::kTile;
using maxent::Point;
using maxent::Problem;
using maxent::Thread;

template <int kSlots, int kNeighbors, int kQueries>
void search(const Problem& problem, int32_t parts, float* found) {
  const int32_t tiles = (problem.num_filled + kTile - 1) / kTile;
  std::vector<Point<kSlots>> tile(kTile);
  const int32_t block = kThreads * kQueries;
  for (int32_t begin = 0; begin < problem.num_queries; begin += block) {
    for (int32_t lane = 0; lane < kThreads; ++lane) {
      Thread<kSlots, kNeighbors, kQueries> merged;
      merged.load(problem, begin + lane, kThreads);
      for (int32_t part = 0; part < parts; ++part) {
        Thread<kSlots, kNeighbors, kQueries> thread;
        thread.load(problem, begin + lane, kThreads);
        for (int32_t t = part; t < tiles; t += parts) {
          for (int32_t j = 0; j < kTile; ++j)
            tile[j] = maxent::load_point<kSlots>(problem, t * kTile + j);
          for (const Point<kSlots>& point : tile) thread.meet(point);
        }
        for (int q = 0; q < kQueries; ++q)
          for (int i = 0; i < kNeighbors; ++i)
            merged.insert(thread.smallest[q][i], merged.smallest[q]);
      }
      for (int q = 0; q < kQueries; ++q) {
        const int64_t query = begin + lane + q * kThreads;
        if (query >= problem.num_queries) continue;
        for (int i = 0; i < kNeighbors; ++i)
          found[query * kNeighbors + i] = merged.distance(q, i);
      }
    }
  }
}

template <int kSlots, int kNeighbors = 8>
void with_neighbors(const Problem& problem, int k, int parts, float* found) {
  if constexpr (kNeighbors > 1) {
    if (k < kNeighbors) return with_neighbors<kSlots, kNeighbors - 1>(problem, k, parts, found);
  }
  if (parts > 1)
    search<kSlots, kNeighbors, 1>(problem, parts, found);
  else
    search<kSlots, kNeighbors, 4>(problem, parts, found);
}

}  // namespace

extern "C" void knn_on_host(const float* queries, const float* points, const int32_t* labels,
                            const int32_t* exclude, int32_t count, int32_t num_queries,
                            int32_t num_features, int32_t k, int32_t parts, float* found) {
  const Problem problem = {queries, points, labels, exclude, count, num_queries, num_features};
  if (num_features <= 7)
    with_neighbors<8>(problem, k, parts, found);
  else
    with_neighbors<16>(problem, k, parts, found);
}
