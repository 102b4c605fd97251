// Exact k-nearest-neighbour distances on a CPU, called from XLA. See knn.py for what they mean.
//
// Few queries are compared with every point. A register holds several queries while the loop passes
// over the points. A point is inserted if it is nearer to a query than the worst of its k so far,
// which is rare.
// Many queries descend a tree of bounding boxes. A leaf has 64 points, and each node has a register
// of children.
// Both compute a squared distance by the same operations in the same order, and rounding is
// monotonic, so that a box is never farther than a point within it: the results are bit-identical.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <limits>
#include <numeric>
#include <vector>

#ifdef __AVX2__
#include <immintrin.h>
#endif

#include "parallel.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using maxent::num_threads;
using maxent::parallel;

#define INLINE inline __attribute__((always_inline))

// Float32 values in a register. AVX2 has 16 registers. 7 coordinates of the queries and 4 partial
// sums fit into them with 8 lanes, but not with 16 lanes in two registers each.
#ifdef __AVX512F__
constexpr int kLanes = 16;
#else
constexpr int kLanes = 8;
#endif
constexpr int kLeaf = 64;        // points; one test covers all their registers
constexpr int kFanout = kLanes;  // children of a node
constexpr int kTile = 64;        // most queries in one job
constexpr int kChunk = 512;      // points that stay in the first-level cache during a tile
constexpr float kInf = std::numeric_limits<float>::infinity();

using Lanes = float __attribute__((vector_size(kLanes * sizeof(float))));
using Mask = int32_t __attribute__((vector_size(kLanes * sizeof(float))));

INLINE Lanes load(const float* from) {
  Lanes lanes;
  std::memcpy(&lanes, from, sizeof(lanes));
  return lanes;
}

// The order in which squares are summed: 1, 0, 2, 3, …. XLA's compiler fuses multiplication and
// addition in this order, so the results equal those without this file.
INLINE int64_t nth(int64_t i, int64_t num_features) {
  return num_features > 1 && i < 2 ? 1 - i : i;
}

INLINE void store(Lanes lanes, float* to) { std::memcpy(to, &lanes, sizeof(lanes)); }

INLINE Lanes smaller(Lanes a, Lanes b) { return a < b ? a : b; }

INLINE Lanes larger(Lanes a, Lanes b) { return a < b ? b : a; }

// One bit for each lane in which `a` is below `b`: the only test of the inner loops.
INLINE uint32_t below(Lanes a, Lanes b) {
#if defined(__AVX512F__)
  return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ);
#elif defined(__AVX2__)
  return _mm256_movemask_ps(_mm256_cmp_ps((__m256)a, (__m256)b, _CMP_LT_OQ));
#else
  const Mask is_below = a < b;
  uint32_t bits = 0;
  for (int lane = 0; lane < kLanes; ++lane) bits |= (is_below[lane] & 1u) << lane;
  return bits;
#endif
}

// One bit for each lane in which `a` is below `b` or NaN.
INLINE uint32_t not_above(Lanes a, Lanes b) {
#if defined(__AVX512F__)
  return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_NGE_UQ);
#elif defined(__AVX2__)
  return _mm256_movemask_ps(_mm256_cmp_ps((__m256)a, (__m256)b, _CMP_NGE_UQ));
#else
  const Mask is_at_least = a >= b;
  uint32_t bits = 0;
  for (int lane = 0; lane < kLanes; ++lane) bits |= (~is_at_least[lane] & 1u) << lane;
  return bits;
#endif
}

INLINE Lanes all(float x) { return Lanes{} + x; }

// Inserts a square into the `k` smallest, which are ascending.
INLINE void insert(float square, float* smallest, int64_t k) {
  int64_t place = k - 1;
  for (; place > 0 && smallest[place - 1] > square; --place) smallest[place] = smallest[place - 1];
  smallest[place] = square;
}

struct Problem {
  const float* queries;    // [B, F]
  const float* points;     // [M, F]
  const int32_t* labels;   // [M]
  const int32_t* exclude;  // [B]
  int64_t num_queries, num_points, num_features, k;
  float* distances;  // [B, k]
};

bool finite(const float* row, int64_t size) {
  return std::all_of(row, row + size, [](float x) { return std::isfinite(x); });
}

void finish(const Problem& problem, int64_t query, const float* smallest, int64_t stride) {
  float* out = problem.distances + query * problem.k;
  const float* row = problem.queries + query * problem.num_features;
  const bool valid = finite(row, problem.num_features);
  for (int64_t i = 0; i < problem.k; ++i)
    out[i] = valid ? std::sqrt(smallest[i * stride]) : std::numeric_limits<float>::quiet_NaN();
}

// Compares points [from, to) with one register of queries. kFeatures 0: known only at run time.
template <int kFeatures, int kUnroll>
INLINE int64_t pass(const Problem& problem, int64_t from, int64_t to, const float* coordinates,
                    const int32_t* exclude, float* smallest) {
  const int64_t num_features = kFeatures ? kFeatures : problem.num_features;
  const int64_t k = problem.k;
  Lanes query[kFeatures ? kFeatures : 1];
  for (int f = 0; f < kFeatures; ++f) query[f] = load(coordinates + f * kLanes);
  Lanes worst = load(smallest + (k - 1) * kLanes);
  Mask excluded;
  std::memcpy(&excluded, exclude, sizeof(excluded));
  int64_t m = from;
  for (; m + kUnroll <= to; m += kUnroll) {
    Lanes squares[kUnroll] = {};
    for (int u = 0; u < kUnroll; ++u) {
      const float* point = problem.points + (m + u) * num_features;
      for (int64_t i = 0; i < num_features; ++i) {
        const int64_t f = nth(i, num_features);
        const Lanes difference = (kFeatures ? query[f] : load(coordinates + f * kLanes)) - point[f];
        squares[u] += difference * difference;
      }
    }
    Lanes nearest = squares[0];  // stays NaN if it is: `smaller` drops a NaN on its left alone
    for (int u = 1; u < kUnroll; ++u) nearest = smaller(squares[u], nearest);
    if (__builtin_expect(!not_above(nearest, worst), 1)) continue;
    for (int u = 0; u < kUnroll; ++u) {
      if (!below(squares[u], worst)) continue;
      Lanes square = excluded == problem.labels[m + u] ? all(kInf) : squares[u];
      for (int64_t i = 0; i < k; ++i) {  // the larger one moves to the next place
        const Lanes kept = load(smallest + i * kLanes);
        store(smaller(square, kept), smallest + i * kLanes);
        square = larger(square, kept);
      }
      worst = load(smallest + (k - 1) * kLanes);
    }
  }
  return m;
}

template <int kFeatures>
INLINE void pass_all(const Problem& problem, int64_t from, int64_t to, const float* coordinates,
                     const int32_t* exclude, float* smallest) {
  from = pass<kFeatures, 4>(problem, from, to, coordinates, exclude, smallest);
  pass<kFeatures, 1>(problem, from, to, coordinates, exclude, smallest);
}

void pass_chunk(const Problem& problem, int64_t from, int64_t to, const float* coordinates,
                const int32_t* exclude, float* smallest) {
  switch (problem.num_features) {
#define CASE(F) \
  case F:       \
    return pass_all<F>(problem, from, to, coordinates, exclude, smallest);
    CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8)
#undef CASE
    default:
      return pass_all<0>(problem, from, to, coordinates, exclude, smallest);
  }
}

// Compares queries [first, first + tile) with every point.
void search_all(const Problem& problem, int64_t first, int64_t tile) {
  const int64_t num = std::min(tile, problem.num_queries - first);
  const int64_t groups = (num + kLanes - 1) / kLanes;
  const int64_t num_features = problem.num_features, k = problem.k;
  std::vector<float> coordinates(groups * num_features * kLanes, 0.0f);
  std::vector<float> smallest(groups * k * kLanes, kInf);
  std::vector<int32_t> exclude(groups * kLanes, 0);
  for (int64_t i = 0; i < num; ++i) {
    const int64_t group = i / kLanes, lane = i % kLanes;
    for (int64_t f = 0; f < num_features; ++f)
      coordinates[(group * num_features + f) * kLanes + lane] =
          problem.queries[(first + i) * num_features + f];
    exclude[i] = problem.exclude[first + i];
  }
  for (int64_t from = 0; from < problem.num_points; from += kChunk)
    for (int64_t group = 0; group < groups; ++group)
      pass_chunk(problem, from, std::min<int64_t>(from + kChunk, problem.num_points),
                 &coordinates[group * num_features * kLanes], &exclude[group * kLanes],
                 &smallest[group * k * kLanes]);
  for (int64_t i = 0; i < num; ++i)
    finish(problem, first + i, &smallest[i / kLanes * k * kLanes + i % kLanes], kLanes);
}

// Level 0 holds the leaves; kFanout neighbours on a level have one parent on the next. The lanes
// hold points or nodes: [groups, F, kLanes].
struct Tree {
  int64_t num_features = 0;
  std::vector<float> points;     // [groups, F, kLanes]; inf where a leaf is not full
  std::vector<int32_t> labels;   // [leaves * 64]
  std::vector<int64_t> sizes;    // of each level, in nodes
  std::vector<std::vector<float>> low, high;  // of each level, [groups, F, kLanes]; empty: low is inf
};

// Assigns points to leaves: permutes `order` until the points of each leaf are consecutive.
// Splits at powers of two, so that every node of every level is a run of leaves.
class Splitter {
 public:
  Splitter(const Problem& problem, std::vector<int32_t>& order)
      : problem_(problem), order_(order), keys_(order.size()) {}

  struct Range {
    int64_t from, to;  // leaves
  };

  // Splits a range into two halves across its widest coordinate.
  int64_t split(Range range) {
    const int64_t begin = range.from * kLeaf;
    const int64_t end = std::min<int64_t>(range.to * kLeaf, order_.size());
    int64_t half = 1;
    while (half * 2 < range.to - range.from) half *= 2;
    const int64_t middle = (range.from + half) * kLeaf;
    const int64_t widest = widest_coordinate(begin, end);
    for (int64_t i = begin; i < end; ++i)
      keys_[i] = {problem_.points[order_[i] * problem_.num_features + widest], order_[i]};
    std::nth_element(keys_.begin() + begin, keys_.begin() + middle, keys_.begin() + end);
    for (int64_t i = begin; i < end; ++i) order_[i] = keys_[i].second;
    return range.from + half;
  }

  void split_whole(Range range) {
    if (range.to - range.from < 2) return;
    const int64_t middle = split(range);
    split_whole({range.from, middle});
    split_whole({middle, range.to});
  }

 private:
  int64_t widest_coordinate(int64_t begin, int64_t end) const {
    const int64_t step = std::max<int64_t>(1, (end - begin) / 256);  // a sample is enough
    int64_t widest = 0;
    float largest = -1;
    for (int64_t f = 0; f < problem_.num_features; ++f) {
      float low = kInf, high = -kInf;
      for (int64_t i = begin; i < end; i += step) {
        const float x = problem_.points[order_[i] * problem_.num_features + f];
        low = std::min(low, x);
        high = std::max(high, x);
      }
      if (high - low > largest) largest = high - low, widest = f;
    }
    return widest;
  }

  const Problem& problem_;
  std::vector<int32_t>& order_;
  std::vector<std::pair<float, int32_t>> keys_;
};

std::vector<int32_t> leaf_order(ffi::ThreadPool& pool, const Problem& problem) {
  std::vector<int32_t> order;
  order.reserve(problem.num_points);
  for (int64_t m = 0; m < problem.num_points; ++m)
    if (finite(problem.points + m * problem.num_features, problem.num_features)) order.push_back(m);
  Splitter splitter(problem, order);
  std::vector<Splitter::Range> ranges{{0, static_cast<int64_t>(order.size() + kLeaf - 1) / kLeaf}};
  while (static_cast<int64_t>(ranges.size()) < 4 * num_threads(pool)) {
    std::vector<Splitter::Range> halves(2 * ranges.size());
    parallel(pool, ranges.size(), [&](int64_t i) {
      const auto [from, to] = ranges[i];
      const int64_t middle = to - from < 2 ? to : splitter.split({from, to});
      halves[2 * i] = {from, middle};
      halves[2 * i + 1] = {middle, to};
    });
    ranges = halves;
  }
  parallel(pool, ranges.size(), [&](int64_t i) { splitter.split_whole(ranges[i]); });
  return order;
}

// Writes the box around `count` boxes or points in the lanes to one lane of the level above.
void enclose(const float* low, const float* high, int64_t count, int64_t num_features,
             float* box_low, float* box_high, int64_t lane) {
  for (int64_t f = 0; f < num_features; ++f)
    for (int64_t i = 0; i < count; ++i) {
      const int64_t at = (i / kLanes * num_features + f) * kLanes + i % kLanes;
      float& smallest = box_low[f * kLanes + lane];
      float& largest = box_high[f * kLanes + lane];
      smallest = std::min(smallest, low[at]);
      largest = std::max(largest, high[at]);
    }
}

Tree build(ffi::ThreadPool& pool, const Problem& problem) {
  const std::vector<int32_t> order = leaf_order(pool, problem);
  const int64_t num_features = problem.num_features, num_points = order.size();
  Tree tree;
  tree.num_features = num_features;
  int64_t size = std::max<int64_t>(1, (num_points + kLeaf - 1) / kLeaf);
  tree.points.assign(size * kLeaf * num_features, kInf);
  tree.labels.assign(size * kLeaf, 0);
  auto new_level = [&](int64_t nodes) {
    tree.sizes.push_back(nodes);
    const int64_t groups = (nodes + kFanout - 1) / kFanout;
    tree.low.emplace_back(groups * num_features * kLanes, kInf);
    tree.high.emplace_back(groups * num_features * kLanes, -kInf);
  };
  auto group_of = [&](std::vector<float>& level, int64_t node) {
    return &level[node / kFanout * num_features * kLanes];
  };
  new_level(size);
  parallel(pool, (size + kFanout - 1) / kFanout, [&](int64_t group) {
    for (int64_t leaf = group * kFanout; leaf < std::min(size, (group + 1) * kFanout); ++leaf) {
      const int64_t begin = leaf * kLeaf, end = std::min(begin + kLeaf, num_points);
      float* points = &tree.points[begin * num_features];
      for (int64_t i = begin; i < end; ++i) {
        const float* point = problem.points + order[i] * num_features;
        const int64_t at = (i - begin) / kLanes * num_features * kLanes + i % kLanes;
        for (int64_t f = 0; f < num_features; ++f) points[at + f * kLanes] = point[f];
        tree.labels[i] = problem.labels[order[i]];
      }
      enclose(points, points, end - begin, num_features, group_of(tree.low[0], leaf),
              group_of(tree.high[0], leaf), leaf % kFanout);
    }
  });
  while (size > kFanout) {
    const int64_t below = size;
    size = (size + kFanout - 1) / kFanout;
    new_level(size);
    const size_t level = tree.sizes.size() - 1;
    for (int64_t node = 0; node < size; ++node)
      enclose(group_of(tree.low[level - 1], node * kFanout),
              group_of(tree.high[level - 1], node * kFanout),
              std::min<int64_t>(kFanout, below - node * kFanout), num_features,
              group_of(tree.low[level], node), group_of(tree.high[level], node), node % kFanout);
  }
  return tree;
}

struct Visit {
  float bound;  // squared distance to the node's box
  int32_t level;
  int64_t node;
};

template <int kFeatures>
INLINE void search_leaf(const Tree& tree, int64_t leaf, const float* query, int32_t exclude,
                        float* smallest, int64_t k) {
  const int64_t num_features = kFeatures ? kFeatures : tree.num_features;
  constexpr int kGroups = kLeaf / kLanes;
  const float* points = &tree.points[leaf * kLeaf * num_features];
  Lanes squares[kGroups] = {};
  for (int64_t i = 0; i < num_features; ++i)
    for (int group = 0; group < kGroups; ++group) {
      const int64_t f = nth(i, num_features);
      const Lanes difference = query[f] - load(points + (group * num_features + f) * kLanes);
      squares[group] += difference * difference;
    }
  Lanes nearest = squares[0];
  for (int group = 1; group < kGroups; ++group) nearest = smaller(squares[group], nearest);
  if (!below(nearest, all(smallest[k - 1]))) return;
  for (int group = 0; group < kGroups; ++group) {
    uint32_t bits = below(squares[group], all(smallest[k - 1]));
    for (; bits; bits &= bits - 1) {
      const int lane = __builtin_ctz(bits);
      if (squares[group][lane] < smallest[k - 1] &&
          exclude != tree.labels[leaf * kLeaf + group * kLanes + lane])
        insert(squares[group][lane], smallest, k);
    }
  }
}

// Collects the nodes of a group that may hold a nearer point, nearest last.
template <int kFeatures>
INLINE int64_t open_group(const Tree& tree, int32_t level, int64_t group, const float* query,
                          float worst, Visit* visits) {
  const int64_t num_features = kFeatures ? kFeatures : tree.num_features;
  const float* low = &tree.low[level][group * num_features * kLanes];
  const float* high = &tree.high[level][group * num_features * kLanes];
  Lanes bounds = {};
  for (int64_t i = 0; i < num_features; ++i) {
    const int64_t f = nth(i, num_features);
    Lanes outside = load(low + f * kLanes) - query[f];
    const Lanes beyond = query[f] - load(high + f * kLanes);
    outside = outside > beyond ? outside : beyond;
    outside = outside > 0 ? outside : Lanes{};
    bounds += outside * outside;
  }
  int64_t num = 0;
  for (uint32_t bits = below(bounds, all(worst)); bits; bits &= bits - 1) {
    const int lane = __builtin_ctz(bits);
    int64_t place = num++;
    for (; place > 0 && visits[place - 1].bound < bounds[lane]; --place)
      visits[place] = visits[place - 1];
    visits[place] = {bounds[lane], level, group * kFanout + lane};
  }
  return num;
}

template <int kFeatures>
INLINE void descend(const Tree& tree, const float* query, int32_t exclude, float* smallest,
                    int64_t k, Visit* visits) {
  const int32_t top = static_cast<int32_t>(tree.sizes.size()) - 1;
  int64_t num = open_group<kFeatures>(tree, top, 0, query, smallest[k - 1], visits);
  while (num > 0) {
    const Visit visit = visits[--num];
    if (!(visit.bound < smallest[k - 1])) continue;
    if (visit.level == 0)
      search_leaf<kFeatures>(tree, visit.node, query, exclude, smallest, k);
    else
      num += open_group<kFeatures>(tree, visit.level - 1, visit.node, query, smallest[k - 1],
                                   visits + num);
  }
}

void descend_tile(const Problem& problem, const Tree& tree, int64_t first, int64_t last,
                  float* smallest, Visit* visits) {
  for (int64_t i = first; i < last; ++i) {
    const float* query = problem.queries + i * problem.num_features;
    std::fill(smallest, smallest + problem.k, kInf);
    switch (problem.num_features) {
#define CASE(F)                                                               \
  case F:                                                                     \
    descend<F>(tree, query, problem.exclude[i], smallest, problem.k, visits); \
    break;
      CASE(2) CASE(3) CASE(7)
#undef CASE
      default:
        descend<0>(tree, query, problem.exclude[i], smallest, problem.k, visits);
    }
    finish(problem, i, smallest, 1);
  }
}

void search_tree(const Problem& problem, const Tree& tree, int64_t first, int64_t tile) {
  std::vector<float> smallest(problem.k);
  std::vector<Visit> visits(tree.sizes.size() * kFanout);  // at most one group of each level waits
  const int64_t last = std::min(first + tile, problem.num_queries);
  descend_tile(problem, tree, first, last, smallest.data(), visits.data());
}

// Offset of an operand with leading axes; an axis of size 1 is broadcast.
int64_t offset(ffi::AnyBuffer::Dimensions shape, size_t kept, ffi::AnyBuffer::Dimensions leading,
               int64_t index) {
  int64_t size = 1, result = 0;
  for (size_t axis = 0; axis < kept; ++axis) size *= shape[shape.size() - 1 - axis];
  for (size_t axis = leading.size(); axis-- > 0; index /= leading[axis]) {
    result += (shape[axis] == 1 ? 0 : index % leading[axis]) * size;
    size *= shape[axis];
  }
  return result;
}

ffi::Error knn(ffi::ThreadPool pool, ffi::Buffer<ffi::F32> queries, ffi::Buffer<ffi::F32> points,
               ffi::Buffer<ffi::S32> labels, ffi::Buffer<ffi::S32> exclude,
               ffi::Buffer<ffi::S32> count, bool tree,
               ffi::ResultBuffer<ffi::F32> distances) {
  const auto shape = distances->dimensions();
  const auto leading = shape.first(shape.size() - 2);
  const int64_t num_searches = std::accumulate(leading.begin(), leading.end(), int64_t{1},
                                               std::multiplies<int64_t>());
  const auto point_shape = points.dimensions();
  std::vector<Problem> problems(num_searches);
  for (int64_t i = 0; i < num_searches; ++i) {
    const int64_t filled = count.typed_data()[offset(count.dimensions(), 0, leading, i)];
    const int64_t capacity = point_shape[point_shape.size() - 2];
    problems[i] = {
        queries.typed_data() + offset(queries.dimensions(), 2, leading, i),
        points.typed_data() + offset(point_shape, 2, leading, i),
        labels.typed_data() + offset(labels.dimensions(), 1, leading, i),
        exclude.typed_data() + offset(exclude.dimensions(), 1, leading, i),
        shape[shape.size() - 2],
        std::clamp<int64_t>(filled, 0, capacity),
        point_shape[point_shape.size() - 1],
        shape[shape.size() - 1],
        distances->typed_data() + i * shape[shape.size() - 2] * shape[shape.size() - 1],
    };
  }
  const int64_t num_queries = shape[shape.size() - 2];
  // Several jobs for each thread, so that no thread waits long for another.
  const int64_t share = num_queries * num_searches / (4 * num_threads(pool));
  const int64_t tile = std::clamp<int64_t>(share / kLanes * kLanes, kLanes, kTile);
  const int64_t tiles = (num_queries + tile - 1) / tile;
  std::vector<std::pair<const Problem*, int64_t>> passes;
  for (const Problem& problem : problems) {
    if (!tree) {
      for (int64_t i = 0; i < tiles; ++i) passes.emplace_back(&problem, i * tile);
      continue;
    }
    const Tree built = build(pool, problem);
    parallel(pool, tiles, [&](int64_t i) { search_tree(problem, built, i * tile, tile); });
  }
  parallel(pool, passes.size(),
           [&](int64_t i) { search_all(*passes[i].first, passes[i].second, tile); });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(maxent_knn, knn,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Arg<ffi::Buffer<ffi::S32>>()
                                  .Arg<ffi::Buffer<ffi::S32>>()
                                  .Arg<ffi::Buffer<ffi::S32>>()
                                  .Attr<bool>("tree")
                                  .Ret<ffi::Buffer<ffi::F32>>());
