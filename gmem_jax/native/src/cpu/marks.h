// What both modes keep of each candidate beside forces and histories.

#pragma once

#include <cstddef>

#include "cpu/problem.h"
#include "numbers/scalar.h"

namespace gmem {
namespace GMEM_ISA {

template <class Law>
struct Marks {
  bool* touched;       // in any lane, at the last step: only then is there a history to forget
  double* next_check;  // the travel at which it may next touch: until then it need not be looked at
  int* segments;       // Mindlin: how many are stored
  int* rings;          // ... of how many rings, at the beginning of the call; those beyond were zero

  void place(const Plan& plan, Arena& arena) {
    const std::size_t count = static_cast<std::size_t>(plan.candidates) + 1;  // and a dummy
    touched = arena.take<bool>(count);
    next_check = arena.take<double>(count);
    segments = arena.take<int>(Law::kLayered ? count : 0);
    rings = arena.take<int>(Law::kLayered ? count : 0);
  }
};

// Rings that may hold something where the outermost is `outer`: one more, since JAX's root may differ in its last digit.
template <class V>
int rings_of(const Problem& p, V outer) {
  const int last = static_cast<int>(largest(outer));
  return last < 0 ? 0 : last + 2 < p.points ? last + 2 : p.points;
}

// How many rings of a result are to be written.
template <class V>
int rings_to_write(const Problem& p, int before, V outer) {
  const int now = static_cast<int>(largest(outer)) + 1;
  return !p.history_aliased ? p.points : now > before ? now : before;
}

}  // namespace GMEM_ISA
}  // namespace gmem
