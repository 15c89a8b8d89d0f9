#include "cpu/team.h"

#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif

namespace gmem {

namespace {

inline void pause() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

// Workers live until the process ends; they sleep on a condition variable between calls.
class Pool {
 public:
  std::mutex busy;  // held by the call that uses the workers

  void run(int threads, const std::function<void(int)>& work) {
    grow(threads - 1);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      work_ = &work;
      wanted_ = threads - 1;
      left_ = threads - 1;
      ++job_;
    }
    wake_.notify_all();
    work(0);
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return left_ == 0; });
  }

 private:
  void grow(int workers) {
    while (static_cast<int>(threads_.size()) < workers) {
      const int number = static_cast<int>(threads_.size());
      threads_.emplace_back([this, number] { serve(number); });
      threads_.back().detach();
    }
  }

  void serve(int number) {
    std::unique_lock<std::mutex> lock(mutex_);
    long seen = 0;
    for (;;) {
      wake_.wait(lock, [&] { return job_ != seen; });
      seen = job_;
      if (number >= wanted_) continue;
      const std::function<void(int)>* work = work_;
      lock.unlock();
      (*work)(number + 1);
      lock.lock();
      if (--left_ == 0) done_.notify_one();
    }
  }

  std::mutex mutex_;
  std::condition_variable wake_, done_;
  std::vector<std::thread> threads_;
  const std::function<void(int)>* work_ = nullptr;
  int wanted_ = 0, left_ = 0;
  long job_ = 0;
};

Pool& pool() {
  static Pool* pool = new Pool;  // never destroyed: workers outlive static destruction
  return *pool;
}

}  // namespace

void Team::barrier() {
  if (size_ == 1) return;
  const int phase = phase_.load(std::memory_order_relaxed);
  if (arrived_.fetch_add(1, std::memory_order_acq_rel) == size_ - 1) {
    arrived_.store(0, std::memory_order_relaxed);
    phase_.store(phase + 1, std::memory_order_release);
    return;
  }
  // Spin for some microseconds; then the others may need this CPU.
  for (int spins = 0; phase_.load(std::memory_order_acquire) == phase; ++spins) {
    if (failed_.load(std::memory_order_relaxed)) throw Left{};
    if (spins < 200) {
      pause();
    } else {
      std::this_thread::yield();
    }
  }
}

void Team::share(Queue queue, int rank, int chunks) {
  Share& mine = shares_[queue][rank];
  mine.last.store(static_cast<int>(static_cast<long>(chunks) * (rank + 1) / size_), std::memory_order_relaxed);
  mine.next.store(static_cast<int>(static_cast<long>(chunks) * rank / size_), std::memory_order_release);
}

bool Team::take(Queue queue, int rank, int* chunk) {
  for (int i = 0; i < size_; ++i) {
    Share& share = shares_[queue][(rank + i) % size_];
    // Look before adding: counters of finished shares must not run away.
    if (share.next.load(std::memory_order_acquire) >= share.last.load(std::memory_order_relaxed)) continue;
    *chunk = share.next.fetch_add(1, std::memory_order_acq_rel);
    if (*chunk < share.last.load(std::memory_order_relaxed)) return true;
  }
  return false;
}

void run_ranks(int threads, const std::function<void(int)>& work) {
  if (threads <= 1) return work(0);
  std::mutex mutex;
  std::exception_ptr first;
  pool().run(threads, [&](int rank) {
    try {
      work(rank);
    } catch (...) {
      std::lock_guard<std::mutex> lock(mutex);
      if (!first) first = std::current_exception();
    }
  });
  if (first) std::rethrow_exception(first);
}

Threads::Threads(int wanted) : count(wanted > 1 && pool().busy.try_lock() ? wanted : 1) {}
Threads::~Threads() {
  if (count > 1) pool().busy.unlock();
}

int thread_count() {
  if (const char* text = std::getenv("GMEM_THREADS")) {
    const int wanted = std::atoi(text);
    if (wanted >= 1) return wanted;
  }
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof set, &set) == 0) return CPU_COUNT(&set);
#endif
  const unsigned count = std::thread::hardware_concurrency();
  return count ? static_cast<int>(count) : 1;
}

}  // namespace gmem
