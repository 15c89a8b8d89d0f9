// Rows of four doubles (a vector and a spare) and their transposition to vectors of lanes.

#pragma once

#include <cstddef>

#include "numbers/simd.h"
#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

// The given lanes of `a`, and of `b` counted on from there.
template <int... lanes, class T>
inline auto shuffle(T a, T b) {
#if defined(__clang__) || __GNUC__ >= 12
  return __builtin_shufflevector(a, b, lanes...);
#else
  constexpr int width = sizeof(T) / sizeof(double);
  typedef double Result __attribute__((vector_size(sizeof...(lanes) * sizeof(double))));
  return Result{(lanes < width ? a[lanes % width] : b[lanes % width])...};
#endif
}

typedef double Row __attribute__((vector_size(32), aligned(32)));

// W rows, packed into vectors.
struct Rows {
  Real part[4];
};

#if defined(__AVX512F__)

template <class Pointer>
inline Rows load_rows(const Pointer& row) {
  Rows r;
  for (int i = 0; i < 4; ++i) r.part[i] = shuffle<0, 1, 2, 3, 4, 5, 6, 7>(*row(2 * i), *row(2 * i + 1));
  return r;
}

inline Vec<Real> columns(const Rows& r) {
  const Real p = shuffle<0, 4, 8, 12, 1, 5, 9, 13>(r.part[0], r.part[1]);
  const Real q = shuffle<0, 4, 8, 12, 1, 5, 9, 13>(r.part[2], r.part[3]);
  const Real s = shuffle<2, 6, 10, 14, 3, 7, 11, 15>(r.part[0], r.part[1]);
  const Real t = shuffle<2, 6, 10, 14, 3, 7, 11, 15>(r.part[2], r.part[3]);
  return {shuffle<0, 1, 2, 3, 8, 9, 10, 11>(p, q), shuffle<4, 5, 6, 7, 12, 13, 14, 15>(p, q),
          shuffle<0, 1, 2, 3, 8, 9, 10, 11>(s, t)};
}

inline Real spare_column(const Rows& r) {
  const Real s = shuffle<2, 6, 10, 14, 3, 7, 11, 15>(r.part[0], r.part[1]);
  const Real t = shuffle<2, 6, 10, 14, 3, 7, 11, 15>(r.part[2], r.part[3]);
  return shuffle<4, 5, 6, 7, 12, 13, 14, 15>(s, t);
}

inline Rows rows_of(Vec<Real> a, Real spare = Real{}) {
  const Real p = shuffle<0, 8, 1, 9, 2, 10, 3, 11>(a.x, a.y);
  const Real q = shuffle<4, 12, 5, 13, 6, 14, 7, 15>(a.x, a.y);
  const Real s = shuffle<0, 8, 1, 9, 2, 10, 3, 11>(a.z, spare);
  const Real t = shuffle<4, 12, 5, 13, 6, 14, 7, 15>(a.z, spare);
  return {{shuffle<0, 1, 8, 9, 2, 3, 10, 11>(p, s), shuffle<4, 5, 12, 13, 6, 7, 14, 15>(p, s),
           shuffle<0, 1, 8, 9, 2, 3, 10, 11>(q, t), shuffle<4, 5, 12, 13, 6, 7, 14, 15>(q, t)}};
}

inline Row row_of(const Rows& r, int l) {
  return l % 2 ? shuffle<4, 5, 6, 7>(r.part[l / 2], r.part[l / 2]) : shuffle<0, 1, 2, 3>(r.part[l / 2], r.part[l / 2]);
}

#elif defined(__AVX__)

template <class Pointer>
inline Rows load_rows(const Pointer& row) {
  return {{*row(0), *row(1), *row(2), *row(3)}};
}

inline Vec<Real> columns(const Rows& r) {
  const Real p = shuffle<0, 4, 2, 6>(r.part[0], r.part[1]);  // x0 x1 z0 z1
  const Real q = shuffle<0, 4, 2, 6>(r.part[2], r.part[3]);
  const Real s = shuffle<1, 5, 3, 7>(r.part[0], r.part[1]);
  const Real t = shuffle<1, 5, 3, 7>(r.part[2], r.part[3]);
  return {shuffle<0, 1, 4, 5>(p, q), shuffle<0, 1, 4, 5>(s, t), shuffle<2, 3, 6, 7>(p, q)};
}

inline Real spare_column(const Rows& r) {
  const Real s = shuffle<1, 5, 3, 7>(r.part[0], r.part[1]);
  const Real t = shuffle<1, 5, 3, 7>(r.part[2], r.part[3]);
  return shuffle<2, 3, 6, 7>(s, t);
}

inline Rows rows_of(Vec<Real> a, Real spare = Real{}) {
  const Real p = shuffle<0, 4, 2, 6>(a.x, a.y);  // x0 y0 x2 y2
  const Real q = shuffle<1, 5, 3, 7>(a.x, a.y);
  const Real s = shuffle<0, 4, 2, 6>(a.z, spare);
  const Real t = shuffle<1, 5, 3, 7>(a.z, spare);
  return {{shuffle<0, 1, 4, 5>(p, s), shuffle<0, 1, 4, 5>(q, t), shuffle<2, 3, 6, 7>(p, s), shuffle<2, 3, 6, 7>(q, t)}};
}

inline Row row_of(const Rows& r, int l) { return r.part[l]; }

#else

template <class Pointer>
inline Rows load_rows(const Pointer& row) {
  const double *a = reinterpret_cast<const double*>(row(0)), *b = reinterpret_cast<const double*>(row(1));
  return {{load(a), load(a + 2), load(b), load(b + 2)}};
}

inline Vec<Real> columns(const Rows& r) {
  return {shuffle<0, 2>(r.part[0], r.part[2]), shuffle<1, 3>(r.part[0], r.part[2]),
          shuffle<0, 2>(r.part[1], r.part[3])};
}

inline Real spare_column(const Rows& r) { return shuffle<1, 3>(r.part[1], r.part[3]); }

inline Rows rows_of(Vec<Real> a, Real spare = Real{}) {
  return {{shuffle<0, 2>(a.x, a.y), shuffle<0, 2>(a.z, spare), shuffle<1, 3>(a.x, a.y), shuffle<1, 3>(a.z, spare)}};
}

inline Row row_of(const Rows& r, int l) { return shuffle<0, 1, 2, 3>(r.part[2 * l], r.part[2 * l + 1]); }

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

inline Rows operator*(const Rows& a, const Rows& b) {
  Rows r;
  for (int i = 0; i < 4; ++i) r.part[i] = a.part[i] * b.part[i];
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
