#include "cpu/team.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdlib>
#include <deque>
#include <exception>
#include <fstream>
#include <limits>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>

#include "cpu/process.h"

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

// Polls until `ready()` is true or some time has passed. A thread that sleeps may wake 0.1 ms late, as long as a sample
// takes between two calls. After some microseconds, which are enough in a step on a quiet machine, the CPU is yielded
// to other threads.
template <class Ready>
void linger(const Ready& ready) {
  constexpr int kSpins = 200;
  constexpr std::chrono::microseconds kLonger{200};
  for (int looks = 0; looks < kSpins; ++looks, pause())
    if (ready()) return;
  for (const auto end = std::chrono::steady_clock::now() + kLonger; !ready() && std::chrono::steady_clock::now() < end;)
    std::this_thread::yield();
}

// The quota of CPU time over its period, from the files of a control group of either version; infinite without a quota.
double share_in(const std::string& folder) {
  double quota = 0.0, period = 0.0;
  std::ifstream both(folder + "/cpu.max"), first(folder + "/cpu.cfs_quota_us"), second(folder + "/cpu.cfs_period_us");
  if (both >> quota >> period || (first >> quota && second >> period))
    if (quota > 0.0 && period > 0.0) return quota / period;
  return std::numeric_limits<double>::infinity();
}

// Workers live until the process ends; between jobs they linger, and then sleep.
class Pool {
 public:
  void run(int threads, const std::function<void(int)>& work) {
    std::unique_lock<std::mutex> lock(mutex_);
    // There is a worker for every rank of every job, since the ranks of a team wait for each other.
    for (; workers_ < ranks_ + threads - 1; ++workers_) std::thread([this] { serve(); }).detach();
    ranks_ += threads - 1;
    Job job{&work, threads - 1, threads - 1, {}};
    jobs_.push_back(&job);
    ++posted_;
    lock.unlock();
    wake_.notify_all();
    work(0);
    linger([&job] { return job.left == 0; });
    lock.lock();
    job.done.wait(lock, [&job] { return job.left == 0; });
    ranks_ -= threads - 1;
  }

  int enter(int wanted) {
    const int most = cpus();
    std::unique_lock<std::mutex> lock(mutex_);
    ++calls_;
    free_.wait(lock, [&] { return used_ < most; });
    const int count = calls_ == 1 ? wanted : std::min(wanted, std::min(most - used_, std::max(1, most / calls_)));
    used_ += count;
    return count;
  }

  void leave(int count) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      --calls_;
      used_ -= count;
    }
    free_.notify_all();
  }

 private:
  struct Job {
    const std::function<void(int)>* work;
    int next;               // ranks from 1 to this one have not begun
    std::atomic<int> left;  // how many ranks have not ended
    std::condition_variable done;
  };

  void serve() {
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      if (const int posted = posted_; jobs_.empty()) {
        lock.unlock();
        linger([&] { return posted_ != posted; });
        lock.lock();
      }
      wake_.wait(lock, [this] { return !jobs_.empty(); });
      Job& job = *jobs_.front();
      const int rank = job.next--;
      if (job.next == 0) jobs_.pop_front();
      lock.unlock();
      (*job.work)(rank);
      lock.lock();
      if (--job.left == 0) job.done.notify_one();
    }
  }

  std::mutex mutex_;
  std::condition_variable wake_, free_;
  std::deque<Job*> jobs_;        // with ranks that have not begun
  std::atomic<int> posted_{0};   // how many jobs have been posted
  int workers_ = 0, ranks_ = 0;  // workers, and the ranks of jobs that need one
  int calls_ = 0, used_ = 0;     // calls in progress or waiting, and the threads they have
};

Pool& pool() { return of_process<Pool>(); }

}  // namespace

int quota_of(const std::string& groups, const std::string& root) {
  double least = std::numeric_limits<int>::max();
  std::ifstream file(groups);
  for (std::string line; std::getline(file, line);) {  // number:controllers:path, and no controllers in version 2
    const std::size_t first = line.find(':'), second = line.find(':', first + 1);
    if (first == std::string::npos || second == std::string::npos) continue;
    const std::string controllers = "," + line.substr(first + 1, second - first - 1) + ",";
    if (controllers != ",," && controllers.find(",cpu,") == std::string::npos) continue;
    std::string path = line.substr(second + 1);
    for (bool more = true; more;) {  // a group has no more than those above it
      least = std::min(least, share_in(root + (controllers == ",," ? "" : "/cpu") + path));
      more = !path.empty();
      path.resize(path.find_last_of('/') == std::string::npos ? 0 : path.find_last_of('/'));
    }
  }
  return std::max(1, static_cast<int>(std::ceil(least)));
}

int cpus() {
  static const int quota = quota_of("/proc/self/cgroup", "/sys/fs/cgroup");
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof set, &set) == 0) return std::min(CPU_COUNT(&set), quota);
#endif
  return std::min(std::max(1, static_cast<int>(std::thread::hardware_concurrency())), quota);
}

void Team::barrier() {
  if (size_ == 1) return;
  const int phase = phase_.load(std::memory_order_relaxed);
  if (arrived_.fetch_add(1, std::memory_order_acq_rel) == size_ - 1) {
    arrived_.store(0, std::memory_order_relaxed);
    phase_.store(phase + 1);
    wake();
    return;
  }
  const auto over = [&] { return phase_.load() != phase || failed_.load(); };
  linger(over);
  if (!over()) {
    std::unique_lock<std::mutex> lock(mutex_);
    ++asleep_;  // before `over` is called again: the thread that ends the phase looks for sleepers afterwards
    wake_.wait(lock, over);
    --asleep_;
  }
  if (phase_.load() == phase) throw Left{};
}

void Team::wake() {
  if (asleep_.load() == 0) return;
  std::lock_guard<std::mutex> lock(mutex_);
  wake_.notify_all();
}

void Team::share(Queue queue, int rank, int chunks) {
  const auto begin = [&](int of) { return static_cast<std::uint64_t>(chunks) * of / size_; };
  shares_[queue][rank].range.store(begin(rank + 1) << 32 | begin(rank), std::memory_order_release);
}

bool Team::take(Queue queue, int rank, int* chunk) {
  const auto next = [](std::uint64_t range) { return static_cast<std::uint32_t>(range); };
  const auto any = [&](std::uint64_t range) { return next(range) < range >> 32; };
  for (int i = 0; i < size_; ++i) {
    std::atomic<std::uint64_t>& range = shares_[queue][(rank + i) % size_].range;
    // Look before adding: counters of finished shares must not run away.
    if (!any(range.load(std::memory_order_acquire))) continue;
    const std::uint64_t taken = range.fetch_add(1, std::memory_order_acq_rel);
    *chunk = static_cast<int>(next(taken));
    if (any(taken)) return true;
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

Threads::Threads(int wanted) : count(pool().enter(wanted)) {}
Threads::~Threads() { pool().leave(count); }

int thread_count() {
  const char* text = std::getenv("GMEM_THREADS");
  if (!text || !*text) return cpus();
  char* end = nullptr;
  const long wanted = std::strtol(text, &end, 10);
  if (*end || wanted < 1 || wanted > 4096)
    throw std::invalid_argument("GMEM_THREADS should be a number of threads from 1 to 4096; it is \"" +
                                std::string(text) + '"');
  return static_cast<int>(wanted);
}

}  // namespace gmem
