// Shared by knn.cc and physics.cc: jobs on XLA's threads.

#ifndef MAXENT_JAX_NATIVE_PARALLEL_H_
#define MAXENT_JAX_NATIVE_PARALLEL_H_

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <thread>
#include <utility>

#include "xla/ffi/api/ffi.h"

namespace maxent {

inline int64_t num_threads(xla::ffi::ThreadPool& pool) {
  return std::max<int64_t>(1, pool.num_threads());
}

// Jobs 0, …, count - 1, which threads take one by one.
class Jobs {
 public:
  Jobs(int64_t count, std::function<void(int64_t)> job) : count_(count), job_(std::move(job)) {}

  // Takes jobs until none is left.
  void run() {
    for (int64_t i; (i = next_.fetch_add(1)) < count_;) {
      job_(i);
      done_.fetch_add(1);
    }
  }

  // Does what is left, and waits for the jobs that other threads have taken.
  void finish() {
    run();
    while (done_.load() < count_) std::this_thread::yield();
  }

 private:
  const int64_t count_;
  const std::function<void(int64_t)> job_;
  std::atomic<int64_t> next_{0}, done_{0};
};

// Offers jobs to all of XLA's threads but one. A thread that is free late finds nothing to do, so
// that nobody waits for a thread that is itself waiting.
inline void offer(xla::ffi::ThreadPool& pool, std::shared_ptr<Jobs> jobs, int64_t count) {
  const int64_t helpers = std::min(num_threads(pool) - 1, count);
  for (int64_t i = 0; i < helpers; ++i) pool.Schedule([jobs] { jobs->run(); });
}

// Calls job(0), …, job(count - 1) on XLA's threads and this one.
inline void parallel(xla::ffi::ThreadPool& pool, int64_t count,
                     std::function<void(int64_t)> job) {
  auto jobs = std::make_shared<Jobs>(count, std::move(job));
  offer(pool, jobs, count - 1);
  jobs->finish();
}

}  // namespace maxent

#endif  // MAXENT_JAX_NATIVE_PARALLEL_H_
