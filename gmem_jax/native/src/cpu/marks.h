// What both modes keep of each candidate beside forces and histories, and where a law's history lies in the arrays of
// a call.

#pragma once

#include <cstddef>

#include "cpu/problem.h"
#include "numbers/scalar.h"

namespace gmem {
namespace GMEM_ISA {

struct Marks {
  bool* touched;       // in any lane, at the last step: only then is there a history to forget
  double* wake;        // the travel at which it may next touch: until then it need not be looked at
  int* reached;        // Mindlin: the last layer that is stored; those beyond are zero
  int* reached_first;  // ... and was at the beginning of the call
};

template <class Law>
void carve_marks(const Plan& plan, Carver& carver, Marks* marks) {
  const std::size_t count = static_cast<std::size_t>(plan.candidates) + 1;  // and a dummy
  bool* touched = carver.take<bool>(count);
  double* wake = carver.take<double>(count);
  int* reached = carver.take<int>(Law::kLayered ? count : 0);
  int* first = carver.take<int>(Law::kLayered ? count : 0);
  if (marks) *marks = {touched, wake, reached, first};
}

// The last layer that an overlap fills, and one more: its root may differ from JAX's in the last digit.
inline int layer_of(const Problem& p, const Lane& lane, double overlap) {
  if (!(overlap > 0.0)) return -1;
  const double last = p.points - 1.0;
  const double reached = __builtin_sqrt(overlap) / lane.parameters[(kLaw + 3) * p.stride] + 1.0;
  return static_cast<int>(reached < last ? reached : last);
}

struct Place {
  int leaf;
  std::ptrdiff_t row;
};

// Where number `q` of the history in `row` of the list lies: leaf 0 is the force (or the layers), leaf 1 the overlap.
template <class Law>
Place place_of(std::ptrdiff_t row, int q) {
  return q < Law::kVectors ? Place{0, row * Law::kVectors + q} : Place{1, row};
}

}  // namespace GMEM_ISA
}  // namespace gmem
