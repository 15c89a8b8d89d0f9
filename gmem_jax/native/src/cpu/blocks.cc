#include "cpu/blocks.h"

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <new>
#include <utility>

#include "cpu/cache.h"
#include "cpu/process.h"
#include "cpu/team.h"

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace gmem {

namespace {

constexpr double kShare = 0.5;  // of the cache that is for blocks: the arrays of the call and other processes want some

// Memory that outlives a call, so that the next one does not fault its pages in again.
class ScratchPool {
 public:
  struct Free {
    void operator()(char* memory) const { std::free(memory); }
  };
  struct Piece {
    std::unique_ptr<char, Free> memory;
    std::size_t bytes = 0;
    void* aligned() const { return memory.get(); }
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
    // In large pages, where the system has them to give: those of 4 kB are more than a CPU has translations for.
    const std::size_t alignment = bytes < kLargePage ? 64 : kLargePage, whole = (bytes / alignment + 1) * alignment;
    Piece piece{std::unique_ptr<char, Free>(static_cast<char*>(std::aligned_alloc(alignment, whole))), bytes};
    if (!piece.memory) throw std::bad_alloc();
#if defined(MADV_HUGEPAGE)
    if (alignment == kLargePage) madvise(piece.memory.get(), whole, MADV_HUGEPAGE);
#endif
    return piece;
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
  static constexpr std::size_t kLargePage = std::size_t{2} << 20;
  static constexpr std::size_t kKept = std::size_t{512} << 20;
  std::mutex mutex_;
  std::vector<Piece> free_;
};

ScratchPool& scratch_pool() { return of_process<ScratchPool>(); }

// Some blocks at once, each by a team; `threads` are shared out to them, to each at most one per domain.
void run_teams(const Problem& problem, const InstructionSet& kernel, const Block* blocks, int count, int threads,
               int domains, std::size_t bytes) {
  std::vector<std::unique_ptr<Team>> team;
  std::vector<ScratchPool::Piece> scratch;
  std::vector<std::pair<int, int>> place;  // team, and rank in it, of each thread
  for (int i = 0; i < count; ++i) {
    const int size = std::min({threads * (i + 1) / count - threads * i / count, domains, Team::kMaxSize});
    team.emplace_back(new Team(size));
    scratch.push_back(scratch_pool().take(bytes));
    for (int rank = 0; rank < size; ++rank) place.push_back({i, rank});
  }
  run_ranks(static_cast<int>(place.size()), [&](int thread) {
    const auto [i, rank] = place[thread];
    team[i]->run([&, i = i, rank = rank] { kernel.run(problem, blocks[i], *team[i], rank, scratch[i].aligned()); });
  });
  for (auto& piece : scratch) scratch_pool().give(std::move(piece));
}

}  // namespace

// As many blocks at once as fit into the cache, each by a team: side by side they would push each other out. More where
// threads would have nothing to do otherwise.
void run_blocks(const Problem& problem, const InstructionSet& kernel, const std::vector<Block>& blocks, int threads) {
  const int count = static_cast<int>(blocks.size());
  if (count == 0) return;
  std::size_t bytes = 0;
  int domains = 1;
  for (const Block& block : blocks) {
    bytes = std::max(bytes, kernel.scratch_bytes(problem, block));
    domains = std::max(domains, block.pack->plan->domains);
  }
  const int fit =
      static_cast<int>(std::min<std::size_t>(threads, kShare * cache_bytes() / std::max<std::size_t>(bytes, 1)));
  const int busy = (threads + domains - 1) / domains;
  const int teams = std::min(count, std::max({1, fit, busy}));
  for (int first = 0; first < count; first += teams)
    run_teams(problem, kernel, blocks.data() + first, std::min(teams, count - first), threads, domains, bytes);
}

}  // namespace gmem
