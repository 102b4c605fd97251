// Exact k-nearest-neighbour distances on an NVIDIA GPU, called from XLA. See knn.py for what they
// mean, and knn_thread.h for what a thread does.
//
// Many queries: each thread keeps four, and each block goes through all points. Few queries: the
// points are divided among blocks. Each block writes its k smallest squares; a second kernel merges
// them.

#include <cuda_runtime.h>

#include <algorithm>
#include <cstdint>

#include "knn_thread.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using maxent::kThreads;
using maxent::kTile;
using maxent::Point;
using maxent::Problem;
using maxent::Thread;

// Blocks that keep a large GPU busy: four for each of 132 multiprocessors.
constexpr int kBlocks = 528;
constexpr int kMaxNeighbors = 8;

// Several searches. Strides separate the operands of one search from the next; 0 if shared.
struct Batch {
  Problem first;
  const int32_t* counts;
  int64_t queries_stride, points_stride, labels_stride, exclude_stride, count_stride;
  int64_t num_points;
  int32_t parts;   // among which the points are divided
  float* squares;  // [searches, parts, B, k], if parts > 1
  float* found;    // [searches, B, k] distances
};

__device__ Problem of_search(const Batch& batch, int64_t search) {
  Problem problem = batch.first;
  problem.queries += search * batch.queries_stride;
  problem.points += search * batch.points_stride;
  problem.labels += search * batch.labels_stride;
  problem.exclude += search * batch.exclude_stride;
  const int64_t count = batch.counts[search * batch.count_stride];
  problem.num_filled = int32_t(count < batch.num_points ? count : batch.num_points);
  return problem;
}

// Grid: tiles of queries, parts of the points, searches.
template <int kSlots, int kNeighbors, int kQueries>
__global__ void __launch_bounds__(kThreads) pass_points(Batch batch) {
  __shared__ Point<kSlots> tile[kTile];
  const Problem problem = of_search(batch, blockIdx.z);
  const int32_t first = blockIdx.x * kThreads * kQueries + threadIdx.x;
  Thread<kSlots, kNeighbors, kQueries> thread;
  thread.load(problem, first, kThreads);

  const int32_t tiles = (problem.num_filled + kTile - 1) / kTile;
  for (int32_t t = blockIdx.y; t < tiles; t += batch.parts) {
    tile[threadIdx.x] = maxent::load_point<kSlots>(problem, t * kTile + threadIdx.x);
    __syncthreads();
#pragma unroll 4
    for (int j = 0; j < kTile; ++j) thread.meet(tile[j]);
    __syncthreads();
  }

  for (int q = 0; q < kQueries; ++q) {
    const int64_t query = first + q * kThreads;
    if (query >= problem.num_queries) continue;
    const int64_t row = (int64_t(blockIdx.z) * batch.parts + blockIdx.y) * problem.num_queries;
    for (int i = 0; i < kNeighbors; ++i) {
      const int64_t at = (row + query) * kNeighbors + i;
      if (batch.parts > 1)
        batch.squares[at] = thread.smallest[q][i];
      else
        batch.found[at] = thread.distance(q, i);
    }
  }
}

// One thread for each query.
template <int kSlots, int kNeighbors>
__global__ void merge(Batch batch) {
  const Problem problem = of_search(batch, blockIdx.z);
  const int32_t query = blockIdx.x * blockDim.x + threadIdx.x;
  if (query >= problem.num_queries) return;
  Thread<kSlots, kNeighbors, 1> thread;
  thread.load(problem, query, 1);
  for (int32_t part = 0; part < batch.parts; ++part) {
    const int64_t row = (int64_t(blockIdx.z) * batch.parts + part) * problem.num_queries + query;
    for (int i = 0; i < kNeighbors; ++i)
      thread.insert(batch.squares[row * kNeighbors + i], thread.smallest[0]);
  }
  const int64_t row = int64_t(blockIdx.z) * problem.num_queries + query;
  for (int i = 0; i < kNeighbors; ++i) batch.found[row * kNeighbors + i] = thread.distance(0, i);
}

int64_t divided_up(int64_t a, int64_t b) { return (a + b - 1) / b; }

template <int kSlots, int kNeighbors>
ffi::Error search(cudaStream_t stream, ffi::ScratchAllocator& scratch, Batch batch, int64_t searches) {
  const int64_t num_queries = batch.first.num_queries;
  const bool many = num_queries >= int64_t(kBlocks) * kThreads;
  const int64_t tiles = divided_up(num_queries, kThreads * (many ? 4 : 1));
  const int64_t of_points = divided_up(batch.num_points, kTile);
  batch.parts = int32_t(std::clamp<int64_t>(kBlocks / (tiles * searches), 1, of_points));
  if (batch.parts > 1) {
    const int64_t size = searches * batch.parts * num_queries * kNeighbors * sizeof(float);
    const auto room = scratch.Allocate(size);
    if (!room) return ffi::Error(ffi::ErrorCode::kResourceExhausted, "no memory for the search");
    batch.squares = static_cast<float*>(*room);
  }
  const dim3 grid(tiles, batch.parts, searches);
  if (many)
    pass_points<kSlots, kNeighbors, 4><<<grid, kThreads, 0, stream>>>(batch);
  else
    pass_points<kSlots, kNeighbors, 1><<<grid, kThreads, 0, stream>>>(batch);
  if (batch.parts > 1)
    merge<kSlots, kNeighbors>
        <<<dim3(divided_up(num_queries, kThreads), 1, searches), kThreads, 0, stream>>>(batch);
  const cudaError_t error = cudaGetLastError();
  if (error != cudaSuccess) return ffi::Error::Internal(cudaGetErrorString(error));
  return ffi::Error::Success();
}

template <int kSlots, int kNeighbors = kMaxNeighbors>
ffi::Error with_neighbors(int64_t k, cudaStream_t stream, ffi::ScratchAllocator& scratch,
                          const Batch& batch, int64_t searches) {
  if constexpr (kNeighbors > 1) {
    if (k < kNeighbors)
      return with_neighbors<kSlots, kNeighbors - 1>(k, stream, scratch, batch, searches);
  }
  return search<kSlots, kNeighbors>(stream, scratch, batch, searches);
}

using Floats = ffi::Buffer<ffi::F32>;
using Whole = ffi::Buffer<ffi::S32>;

ffi::Error knn(cudaStream_t stream, ffi::ScratchAllocator scratch, Floats queries, Floats points,
               Whole labels, Whole exclude, Whole count, ffi::ResultBuffer<ffi::F32> distances) {
  const auto shape = distances->dimensions();  // [..., B, k]
  const auto of_points = points.dimensions();  // [..., M, F]
  const int64_t k = shape.back(), num_queries = shape[shape.size() - 2];
  const int64_t num_features = of_points.back(), num_points = of_points[of_points.size() - 2];
  const int64_t searches = distances->element_count() / std::max<int64_t>(num_queries * k, 1);
  if (num_features > 15 || k > kMaxNeighbors || num_points > INT32_MAX || num_queries > INT32_MAX)
    return ffi::Error::InvalidArgument("at most 15 features and 8 neighbours");
  Batch batch{};
  batch.first = {queries.typed_data(), points.typed_data(), labels.typed_data(),
                 exclude.typed_data(), 0, int32_t(num_queries), int32_t(num_features)};
  batch.counts = count.typed_data();
  const auto stride = [](int64_t elements, int64_t of_one) {
    return elements == of_one ? 0 : of_one;
  };
  batch.queries_stride = stride(queries.element_count(), num_queries * num_features);
  batch.points_stride = stride(points.element_count(), num_points * num_features);
  batch.labels_stride = stride(labels.element_count(), num_points);
  batch.exclude_stride = stride(exclude.element_count(), num_queries);
  batch.count_stride = stride(count.element_count(), 1);
  batch.num_points = num_points;
  batch.found = distances->typed_data();
  if (num_features <= 7) return with_neighbors<8>(k, stream, scratch, batch, searches);
  return with_neighbors<16>(k, stream, scratch, batch, searches);
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(maxent_knn_cuda, knn,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::PlatformStream<cudaStream_t>>()
                                  .Ctx<ffi::ScratchAllocator>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Whole>()
                                  .Arg<Whole>()
                                  .Arg<Whole>()
                                  .Ret<Floats>());
