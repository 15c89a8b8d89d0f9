#include "cpu/blocks.h"

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>
#include <mutex>
#include <utility>

#include "cpu/process.h"
#include "cpu/team.h"

namespace gmem {

namespace {

// Memory that outlives a call, so that the next one does not fault its pages in again.
class ScratchPool {
 public:
  struct Piece {
    std::unique_ptr<char[]> memory;
    std::size_t bytes = 0;
    void* aligned() const {
      return reinterpret_cast<void*>((reinterpret_cast<std::uintptr_t>(memory.get()) + 63) / 64 * 64);
    }
  };

  Piece take(std::size_t bytes) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      for (auto piece = free_.begin(); piece != free_.end(); ++piece) {
        if (piece->bytes < bytes || piece->bytes > 2 * bytes) continue;
        Piece found = std::move(*piece);
        free_.erase(piece);
        return found;
      }
    }
    return {std::unique_ptr<char[]>(new char[bytes + 64]), bytes};
  }

  void give(Piece piece) {
    std::lock_guard<std::mutex> lock(mutex_);
    free_.push_back(std::move(piece));
    std::size_t total = 0;
    for (const Piece& kept : free_) total += kept.bytes;
    while (total > kKept && !free_.empty()) {
      total -= free_.front().bytes;
      free_.erase(free_.begin());
    }
  }

 private:
  static constexpr std::size_t kKept = std::size_t{512} << 20;
  std::mutex mutex_;
  std::vector<Piece> free_;
};

ScratchPool& scratch_pool() { return of_process<ScratchPool>(); }

}  // namespace

// Blocks one by one to single threads as long as that keeps all busy, then the rest to teams.
void run_blocks(const Problem& problem, const Kernel& kernel, const std::vector<Block>& blocks, int threads) {
  const int count = static_cast<int>(blocks.size());
  if (count == 0) return;
  const int alone = count / threads * threads, rest = count - alone;
  std::size_t bytes = 0;
  int domains = 0;
  for (const Block& block : blocks) {
    bytes = std::max(bytes, kernel.scratch_bytes(problem, block));
    domains = std::max(domains, block.pack->plan->domains);
  }
  if (alone > 0) {
    std::atomic<int> next{0};
    const int ranks = std::min(threads, alone);
    std::vector<ScratchPool::Piece> scratch;
    for (int rank = 0; rank < ranks; ++rank) scratch.push_back(scratch_pool().take(bytes));
    run_ranks(ranks, [&](int rank) {
      for (int i; (i = next.fetch_add(1)) < alone;) {
        Team team(1);
        kernel.run(problem, blocks[i], team, 0, scratch[rank].aligned());
      }
    });
    for (auto& piece : scratch) scratch_pool().give(std::move(piece));
  }
  if (rest > 0) {
    const int size = std::min({threads / rest, domains, Team::kMaxSize});
    std::vector<std::unique_ptr<Team>> teams;
    std::vector<ScratchPool::Piece> scratch;
    for (int i = 0; i < rest; ++i) {
      teams.emplace_back(new Team(size));
      scratch.push_back(scratch_pool().take(bytes));
    }
    run_ranks(rest * size, [&](int rank) {
      const int i = rank / size;
      teams[i]->run([&] { kernel.run(problem, blocks[alone + i], *teams[i], rank % size, scratch[i].aligned()); });
    });
    for (auto& piece : scratch) scratch_pool().give(std::move(piece));
  }
}

}  // namespace gmem
