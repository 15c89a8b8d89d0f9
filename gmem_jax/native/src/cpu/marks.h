// What both modes keep of each candidate beside forces and histories.

#pragma once

#include <cstddef>

#include "cpu/problem.h"
#include "numbers/scalar.h"

namespace gmem {
namespace GMEM_ISA {

struct Marks {
  bool* touched;       // in any lane, at the last step: only then is there a history to forget
  double* wake;        // the travel at which it may next touch: until then it need not be looked at
  int* runs;           // Mindlin: how many are stored
  int* rings;          // ... of how many rings, at the beginning of the call; those beyond were zero
};

template <class Law>
void carve_marks(const Plan& plan, Carver& carver, Marks* marks) {
  const std::size_t count = static_cast<std::size_t>(plan.candidates) + 1;  // and a dummy
  bool* touched = carver.take<bool>(count);
  double* wake = carver.take<double>(count);
  int* runs = carver.take<int>(Law::kLayered ? count : 0);
  int* rings = carver.take<int>(Law::kLayered ? count : 0);
  if (marks) *marks = {touched, wake, runs, rings};
}

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
