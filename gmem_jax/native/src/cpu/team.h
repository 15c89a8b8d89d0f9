// Threads: a pool that sleeps between calls, and teams of threads that share a block.

#pragma once

#include <atomic>
#include <functional>

namespace gmem {

// Threads that work on one block in phases. Work comes in numbered chunks; each thread starts with its own share, a
// run of neighbours that stays the same from step to step, and helps the others when it is done.
class Team {
 public:
  enum Queue { kGrains, kContacts, kQueues };
  static constexpr int kMaxSize = 64;

  explicit Team(int size) : size_(size) {}
  int size() const { return size_; }

  // Wait for the whole team.
  void barrier();
  // Open the share of `rank` in a phase of `chunks` chunks. The queue must have been emptied before.
  void share(Queue queue, int rank, int chunks);
  // The next chunk for `rank`; false when all have been taken.
  bool take(Queue queue, int rank, int* chunk);

 private:
  struct alignas(64) Share {
    std::atomic<int> next{0};
    std::atomic<int> last{0};
  };
  const int size_;
  alignas(64) std::atomic<int> arrived_{0};
  alignas(64) std::atomic<int> phase_{0};
  Share shares_[kQueues][kMaxSize];
};

// Run `work(rank)` for rank 0 (here) to threads - 1 (in the pool) and wait for all. While another call holds the
// pool, its ranks are run one after the other, so work must not wait for other ranks unless `concurrent` says so.
int acquire_threads(int wanted);
void release_threads();
void run_ranks(int threads, const std::function<void(int)>& work);

// Threads to use: the environment's GMEM_THREADS, or the CPUs this process may run on.
int thread_count();

}  // namespace gmem
