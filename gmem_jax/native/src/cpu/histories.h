// The work on candidates that both modes share: choosing those that are looked at, and copying their histories from the
// arrays of a call and back.

#pragma once

#include <cstddef>
#include <cstdint>

#include "cpu/problem.h"
#include "physics/laws.h"

namespace gmem {
namespace GMEM_ISA {

// The travel up to which two spheres that are now apart cannot touch; `square` is the square of their distance. They
// touch at the distance `reach`. A distance larger than `far` (`Plan::far`) counts as `far`.
inline double next_check(double travel, double square, double reach = 2.0, double far = 4.0) {
  const double apart = __builtin_sqrt(square);
  return travel + (1.0 - 1e-9) * ((apart < far ? apart : far) - reach);
}

// What is kept of each candidate beside forces and histories.
template <class Law>
struct Marks {
  bool* touched;       // whether it touched in any lane at the last step: only then is there a history to forget
  double* next_check;  // the travel at which it may next touch: until then it need not be looked at
  int* segments;       // Mindlin: how many are stored
  int* rings;          // ... of how many rings at the beginning of the call; rings beyond these were zero

  void place(const Plan& plan, Arena& arena) {
    const std::size_t count = static_cast<std::size_t>(plan.candidates) + 1;  // and a dummy
    touched = arena.take<bool>(count);
    next_check = arena.take<double>(count);
    segments = arena.take<int>(Law::kLayered ? count : 0);
    rings = arena.take<int>(Law::kLayered ? count : 0);
  }

  static constexpr int kLook = 256;  // candidates looked at at once

  // Writes to `near` which of the next kLook candidates, from `first` on and before `end`, may touch. Returns how many.
  GMEM_INLINE int find_near(int first, int end, double travel, int (&near)[kLook]) const {
    constexpr int kWord = 64;
    const int look_end = first + kLook < end ? first + kLook : end;
    const Real now = splat<Real>(travel);
    int found = 0;
    for (int c = first; c < look_end; c += kWord) {
      const int count = look_end - c < kWord ? look_end - c : kWord;
      uint64_t later = 0;  // a bit for each; none where `next_check` is not a number
      int l = 0;
      for (; l + W <= count; l += W) later |= uint64_t{bits_less(now, load(next_check + c + l))} << l;
      for (; l < count; ++l) later |= uint64_t{next_check[c + l] > travel} << l;
      for (uint64_t may = ~later & ~uint64_t{0} >> (kWord - count); may; may &= may - 1)
        near[found++] = c + __builtin_ctzll(may);
    }
    return found;
  }
};

// How many rings may differ from 0 where the outermost is `outer`. One more is counted, since JAX's root may differ in
// its last digit.
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

// Where number `axis` of ring j lies in the arrays of a call.
inline Place ring_place(const Problem& p, std::ptrdiff_t row, int j, int axis) {
  return {0, (row * p.points + j) * 2 + axis};
}

// Makes the layers and segments of a history from Mindlin's rings; `number(j, axis)` reads ring j of a call's arrays.
template <class Law, class V, class Segments, class Outer, class Number>
void load_rings(V* history, Segments segments, Outer outer, bool apart, const Number& number) {
  const auto ring = [&](int j) {
    const auto along = number(j, 0);
    return Flat<V>{along, number(j, 1)};
  };
  store_layers(history + kLayers, segments.load(outer, kLacking<Law::variant>, apart, ring));
}

// The way back, by `put(j, axis, number)`; `before` is `Marks::rings`.
template <class V, class Segments, class Outer, class Put>
void unload_rings(const Problem& p, const V* history, const Segments& segments, Outer outer, int before,
                  const Put& put) {
  segments.unload(load_layers(history + kLayers), outer, rings_to_write(p, before, outer),
                  [&](int j, const auto& force) {
                    put(j, 0, force.along);
                    put(j, 1, force.across);
                  });
}

// The history of candidate c, from the arrays of the call to where a mode keeps it.
template <class Mode, class V>
void load_history(Mode& mode, std::ptrdiff_t c, const LawParameters<V>& law) {
  using Law = typename Mode::OfLaw;
  const std::ptrdiff_t row = mode.plan.candidate[c].row;
  for (int q = 0; q < Law::kGiven; ++q) mode.remembered(c, q) = mode.history_in(place_of<Law>(row, q));
  mode.mark_new(c);
  if constexpr (Law::kLayered) {
    const auto outer = mode.outermost(c, law);
    mode.marks.rings[c] = rings_of(mode.problem, outer);
    const auto number = [&](int j, int axis) { return mode.history_in(ring_place(mode.problem, row, j, axis)); };
    load_rings<Law>(&mode.remembered(c, 0), mode.segments_of(c), outer, mode.apart, number);
  }
}

// ... and back: to the lanes that have done all their steps.
template <class Mode, class V>
void unload_history(const Mode& mode, std::ptrdiff_t c, const LawParameters<V>& law, int steps_done) {
  using Law = typename Mode::OfLaw;
  const std::ptrdiff_t row = mode.plan.candidate[c].row;
  for (int q = 0; q < Law::kGiven; ++q) mode.history_out(place_of<Law>(row, q), mode.remembered(c, q), steps_done);
  if constexpr (Law::kLayered) {
    const auto outer = mode.outermost(c, law);
    unload_rings(mode.problem, &mode.remembered(c, 0), mode.segments_of(c), outer, mode.marks.rings[c],
                 [&](int j, int axis, const auto& number) {
                   mode.history_out(ring_place(mode.problem, row, j, axis), number, steps_done);
                 });
  }
}

// Writes zeros to the histories in the n-th row without a candidate.
template <class Mode>
void unload_padding(const Mode& mode, int n, int steps_done) {
  using Law = typename Mode::OfLaw;
  const decltype(mode.history_in(Place{})) nothing{};
  const std::ptrdiff_t row = mode.plan.padding_row[n];
  for (int q = 0; q < Law::kGiven; ++q) mode.history_out(place_of<Law>(row, q), nothing, steps_done);
  if (Law::kLayered && !mode.problem.history_aliased)
    for (int q = 0; q < 2 * mode.problem.points; ++q)
      mode.history_out(ring_place(mode.problem, row, 0, q), nothing, steps_done);
}

}  // namespace GMEM_ISA
}  // namespace gmem
