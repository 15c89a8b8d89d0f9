#include "cpu/blocks.h"

#include <algorithm>
#include <cstdint>
#include <memory>
#include <utility>

#include "cpu/cache.h"
#include "cpu/scratch.h"
#include "cpu/team.h"

namespace gmem {

namespace {

constexpr double kShare = 0.5;  // of the cache, for blocks; the arrays of the call and other processes need the rest

// Runs some blocks at once, each by a team. The teams share out `threads`; none has more threads than domains.
void run_teams(const Problem& problem, const InstructionSet& kernel, const Block* blocks, int count, int threads,
               int domains, std::size_t bytes) {
  std::vector<std::unique_ptr<Team>> team;
  std::vector<Scratch> scratch;
  std::vector<std::pair<int, int>> place;  // team, and rank in it, of each thread
  for (int i = 0; i < count; ++i) {
    const int size = std::min({threads * (i + 1) / count - threads * i / count, domains, Team::kMaxSize});
    team.emplace_back(new Team(size));
    scratch.push_back(take_scratch(bytes));
    for (int rank = 0; rank < size; ++rank) place.push_back({i, rank});
  }
  run_ranks(static_cast<int>(place.size()), [&](int thread) {
    const auto [i, rank] = place[thread];
    team[i]->run([&, i = i, rank = rank] { kernel.run(problem, blocks[i], *team[i], rank, scratch[i].aligned()); });
  });
  for (Scratch& piece : scratch) give_scratch(std::move(piece));
}

}  // namespace

// Runs as many blocks at once as fit into the cache: more would push each other out. It runs more only where threads
// would have nothing to do otherwise.
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
