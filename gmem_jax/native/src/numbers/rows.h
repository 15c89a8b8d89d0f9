// Rows of four doubles (a vector and a spare) and their transposition to vectors of lanes.

#pragma once

#include <cstddef>

#include "numbers/simd.h"
#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

typedef double Row __attribute__((vector_size(32), aligned(32)));

// W rows, packed into vectors.
struct Rows {
  Real part[4];
};

#if defined(__AVX512F__)

template <class Pointer>
inline Rows load_rows(const Pointer& row) {
  Rows r;
  for (int i = 0; i < 4; ++i)
    r.part[i] = __builtin_shufflevector(*row(2 * i), *row(2 * i + 1), 0, 1, 2, 3, 4, 5, 6, 7);
  return r;
}

inline Vec<Real> columns(const Rows& r) {
  const Real p = __builtin_shufflevector(r.part[0], r.part[1], 0, 4, 8, 12, 1, 5, 9, 13);
  const Real q = __builtin_shufflevector(r.part[2], r.part[3], 0, 4, 8, 12, 1, 5, 9, 13);
  const Real s = __builtin_shufflevector(r.part[0], r.part[1], 2, 6, 10, 14, 3, 7, 11, 15);
  const Real t = __builtin_shufflevector(r.part[2], r.part[3], 2, 6, 10, 14, 3, 7, 11, 15);
  return {__builtin_shufflevector(p, q, 0, 1, 2, 3, 8, 9, 10, 11), __builtin_shufflevector(p, q, 4, 5, 6, 7, 12, 13, 14, 15),
          __builtin_shufflevector(s, t, 0, 1, 2, 3, 8, 9, 10, 11)};
}

inline Rows rows_of(Vec<Real> a) {
  const Real zero{};
  const Real p = __builtin_shufflevector(a.x, a.y, 0, 8, 1, 9, 2, 10, 3, 11);
  const Real q = __builtin_shufflevector(a.x, a.y, 4, 12, 5, 13, 6, 14, 7, 15);
  const Real s = __builtin_shufflevector(a.z, zero, 0, 8, 1, 9, 2, 10, 3, 11);
  const Real t = __builtin_shufflevector(a.z, zero, 4, 12, 5, 13, 6, 14, 7, 15);
  return {{__builtin_shufflevector(p, s, 0, 1, 8, 9, 2, 3, 10, 11), __builtin_shufflevector(p, s, 4, 5, 12, 13, 6, 7, 14, 15),
           __builtin_shufflevector(q, t, 0, 1, 8, 9, 2, 3, 10, 11), __builtin_shufflevector(q, t, 4, 5, 12, 13, 6, 7, 14, 15)}};
}

inline Row row_of(const Rows& r, int l) {
  return l % 2 ? __builtin_shufflevector(r.part[l / 2], r.part[l / 2], 4, 5, 6, 7)
               : __builtin_shufflevector(r.part[l / 2], r.part[l / 2], 0, 1, 2, 3);
}

#elif defined(__AVX__)

template <class Pointer>
inline Rows load_rows(const Pointer& row) {
  return {{*row(0), *row(1), *row(2), *row(3)}};
}

inline Vec<Real> columns(const Rows& r) {
  const Real p = __builtin_shufflevector(r.part[0], r.part[1], 0, 4, 2, 6);  // x0 x1 z0 z1
  const Real q = __builtin_shufflevector(r.part[2], r.part[3], 0, 4, 2, 6);
  const Real s = __builtin_shufflevector(r.part[0], r.part[1], 1, 5, 3, 7);
  const Real t = __builtin_shufflevector(r.part[2], r.part[3], 1, 5, 3, 7);
  return {__builtin_shufflevector(p, q, 0, 1, 4, 5), __builtin_shufflevector(s, t, 0, 1, 4, 5),
          __builtin_shufflevector(p, q, 2, 3, 6, 7)};
}

inline Rows rows_of(Vec<Real> a) {
  const Real zero{};
  const Real p = __builtin_shufflevector(a.x, a.y, 0, 4, 2, 6);  // x0 y0 x2 y2
  const Real q = __builtin_shufflevector(a.x, a.y, 1, 5, 3, 7);
  const Real s = __builtin_shufflevector(a.z, zero, 0, 4, 2, 6);
  const Real t = __builtin_shufflevector(a.z, zero, 1, 5, 3, 7);
  return {{__builtin_shufflevector(p, s, 0, 1, 4, 5), __builtin_shufflevector(q, t, 0, 1, 4, 5),
           __builtin_shufflevector(p, s, 2, 3, 6, 7), __builtin_shufflevector(q, t, 2, 3, 6, 7)}};
}

inline Row row_of(const Rows& r, int l) { return r.part[l]; }

#else

template <class Pointer>
inline Rows load_rows(const Pointer& row) {
  const double *a = reinterpret_cast<const double*>(row(0)), *b = reinterpret_cast<const double*>(row(1));
  return {{load(a), load(a + 2), load(b), load(b + 2)}};
}

inline Vec<Real> columns(const Rows& r) {
  return {__builtin_shufflevector(r.part[0], r.part[2], 0, 2), __builtin_shufflevector(r.part[0], r.part[2], 1, 3),
          __builtin_shufflevector(r.part[1], r.part[3], 0, 2)};
}

inline Rows rows_of(Vec<Real> a) {
  const Real zero{};
  return {{__builtin_shufflevector(a.x, a.y, 0, 2), __builtin_shufflevector(a.z, zero, 0, 2),
           __builtin_shufflevector(a.x, a.y, 1, 3), __builtin_shufflevector(a.z, zero, 1, 3)}};
}

inline Row row_of(const Rows& r, int l) {
  return __builtin_shufflevector(r.part[2 * l], r.part[2 * l + 1], 0, 1, 2, 3);
}

#endif

inline Rows operator+(const Rows& a, const Rows& b) {
  Rows r;
  for (int i = 0; i < 4; ++i) r.part[i] = a.part[i] + b.part[i];
  return r;
}

inline Rows operator-(const Rows& a, const Rows& b) {
  Rows r;
  for (int i = 0; i < 4; ++i) r.part[i] = a.part[i] - b.part[i];
  return r;
}

inline Rows operator*(Real s, const Rows& a) {
  Rows r;
  for (int i = 0; i < 4; ++i) r.part[i] = s * a.part[i];
  return r;
}

// W rows at `to`, `stride` rows apart.
inline void store_rows(Row* to, std::ptrdiff_t stride, Vec<Real> a) {
  const Rows rows = rows_of(a);
  for (int l = 0; l < W; ++l) to[l * stride] = row_of(rows, l);
}

}  // namespace GMEM_ISA
}  // namespace gmem
