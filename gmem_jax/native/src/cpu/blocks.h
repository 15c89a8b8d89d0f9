// Blocks of work shared out to threads.

#pragma once

#include <vector>

#include "cpu/problem.h"

namespace gmem {

// Run all blocks on `threads` threads of the pool, of which the caller holds `Threads`. Returns when nothing runs any
// more; then throws what the first thread to fail threw.
void run_blocks(const Problem& problem, const InstructionSet& kernel, const std::vector<Block>& blocks, int threads);

}  // namespace gmem
