// Shared by knn.cc and physics.cc: a loop over jobs on XLA's threads.

#ifndef MAXENT_JAX_NATIVE_PARALLEL_H_
#define MAXENT_JAX_NATIVE_PARALLEL_H_

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <thread>

#include "xla/ffi/api/ffi.h"

namespace maxent {

inline int64_t num_threads(xla::ffi::ThreadPool& pool) {
  return std::max<int64_t>(1, pool.num_threads());
}

// Calls job(0), …, job(count - 1) on XLA's threads and this one. A helper that starts late finds
// nothing to do, so that no thread waits for one that is itself waiting.
inline void parallel(xla::ffi::ThreadPool& pool, int64_t count,
                     const std::function<void(int64_t)>& job) {
  struct Shared {
    std::atomic<int64_t> next{0}, done{0};
  };
  auto shared = std::make_shared<Shared>();
  auto work = [shared, count, &job] {
    for (int64_t i; (i = shared->next.fetch_add(1)) < count;) {
      job(i);
      shared->done.fetch_add(1);
    }
  };
  const int64_t helpers = std::min(num_threads(pool), count) - 1;
  for (int64_t i = 0; i < helpers; ++i) pool.Schedule([work] { work(); });
  work();
  while (shared->done.load() < count) std::this_thread::yield();
}

}  // namespace maxent

#endif  // MAXENT_JAX_NATIVE_PARALLEL_H_
