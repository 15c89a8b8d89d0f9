// Threads: a pool that waits for jobs, and teams of threads that share a block.

#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <string>

namespace gmem {

// Threads that work on one block in phases. Work comes in numbered chunks; each thread starts with its own share, a
// run of neighbours that stays the same from step to step, and helps the others when it is done.
class Team {
 public:
  enum Queue { kGrains, kContacts, kQueues };
  static constexpr int kMaxSize = 64;

  explicit Team(int size) : size_(size) {}
  int size() const { return size_; }

  // Do the work of one thread. If it throws, the others do not wait for it: they leave at their next barrier.
  template <class Work>
  void run(const Work& work) {
    try {
      work();
    } catch (const Left&) {
    } catch (...) {
      failed_.store(true);
      wake();
      throw;
    }
  }

  // Wait for the whole team.
  void barrier();
  // Open the share of `rank` in a phase of `chunks` chunks. A barrier must come between the last `take` from the queue
  // and this.
  void share(Queue queue, int rank, int chunks);
  // The next chunk for `rank`; false when all have been taken.
  bool take(Queue queue, int rank, int* chunk);

 private:
  // The next chunk in the lower half, the end in the upper half of one word: a thread that takes a chunk while the
  // share is being opened must not see one without the other.
  struct alignas(64) Share {
    std::atomic<std::uint64_t> range{0};
  };
  struct Left {};  // thrown at a barrier that not all will reach

  void wake();

  const int size_;
  std::atomic<bool> failed_{false};
  alignas(64) std::atomic<int> arrived_{0};
  alignas(64) std::atomic<int> phase_{0};
  std::atomic<int> asleep_{0};
  std::mutex mutex_;
  std::condition_variable wake_;
  Share shares_[kQueues][kMaxSize];
};

// Threads for the length of one call, the caller's own among them. Calls that run at once share out the CPUs. A call
// for which no CPU is left waits for one.
class Threads {
 public:
  explicit Threads(int wanted);
  ~Threads();
  Threads(const Threads&) = delete;
  Threads& operator=(const Threads&) = delete;

  const int count;
};

// Run `work(rank)` for rank 0 (here) to threads - 1 (in the pool) and wait for all; then throw what the first of them
// to fail threw.
void run_ranks(int threads, const std::function<void(int)>& work);

// CPUs that this process may keep busy: those it may run on, or fewer where its control group has a quota of their
// time.
int cpus();

// The least quota of CPU time of the control groups that are listed in the file `groups` (/proc/self/cgroup) and lie in
// the folder `root` (/sys/fs/cgroup), in CPUs, rounded up; the largest number where there is none.
int quota_of(const std::string& groups, const std::string& root);

// Threads to use: the environment's GMEM_THREADS, or `cpus`. Throws std::invalid_argument if
// GMEM_THREADS is no number of threads.
int thread_count();

}  // namespace gmem
