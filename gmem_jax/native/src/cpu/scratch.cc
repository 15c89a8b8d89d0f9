#include "cpu/scratch.h"

#include <mutex>
#include <new>
#include <utility>
#include <vector>

#include "cpu/process.h"

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace gmem {

namespace {

class ScratchPool {
 public:
  Scratch take(std::size_t bytes) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      for (auto piece = free_.begin(); piece != free_.end(); ++piece) {
        if (piece->bytes < bytes || piece->bytes > 2 * bytes) continue;
        Scratch found = std::move(*piece);
        free_.erase(piece);
        return found;
      }
    }
    // In large pages, where the system has them: pages of 4 kB would be more than a CPU keeps translations for.
    const std::size_t alignment = bytes < kLargePage ? 64 : kLargePage, whole = (bytes / alignment + 1) * alignment;
    Scratch piece;
    piece.memory.reset(static_cast<char*>(std::aligned_alloc(alignment, whole)));
    piece.bytes = bytes;
    if (!piece.memory) throw std::bad_alloc();
#if defined(MADV_HUGEPAGE)
    if (alignment == kLargePage) madvise(piece.memory.get(), whole, MADV_HUGEPAGE);
#endif
    return piece;
  }

  void give(Scratch piece) {
    std::lock_guard<std::mutex> lock(mutex_);
    free_.push_back(std::move(piece));
    std::size_t total = 0;
    for (const Scratch& kept : free_) total += kept.bytes;
    while (total > kKept && !free_.empty()) {
      total -= free_.front().bytes;
      free_.erase(free_.begin());
    }
  }

 private:
  static constexpr std::size_t kLargePage = std::size_t{2} << 20;
  static constexpr std::size_t kKept = std::size_t{512} << 20;
  std::mutex mutex_;
  std::vector<Scratch> free_;
};

ScratchPool& scratch_pool() { return of_process<ScratchPool>(); }

}  // namespace

Scratch take_scratch(std::size_t bytes) { return scratch_pool().take(bytes); }
void give_scratch(Scratch piece) { scratch_pool().give(std::move(piece)); }

}  // namespace gmem
