// Vectors of W doubles and their masks. Every operation is a correctly rounded IEEE operation per lane (or, in
// `inverse_root`, a fixed sequence of them), so that a lane's numbers depend neither on W nor on its neighbours.

#pragma once

#include "numbers/scalar.h"

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace gmem {
namespace GMEM_ISA {

#if defined(__AVX512F__)
constexpr int W = 8;
#elif defined(__AVX__)
constexpr int W = 4;
#else
constexpr int W = 2;
#endif

typedef double Real __attribute__((vector_size(8 * W)));
typedef double Unaligned __attribute__((vector_size(8 * W), aligned(8), may_alias));
typedef Mask<Real> Bits;  // all bits of a lane set or clear

inline Real load(const double* p) { return *reinterpret_cast<const Unaligned*>(p); }
inline void store(double* p, Real a) { *reinterpret_cast<Unaligned*>(p) = a; }
// Of fewer than W numbers; the last one is repeated.
inline Real load(const double* p, int count) {
  Real a;
#if defined(__AVX512F__)
  const __m512i lane = _mm512_min_epi64(_mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0), _mm512_set1_epi64(count - 1));
  a = (Real)_mm512_permutexvar_pd(lane, _mm512_maskz_loadu_pd(static_cast<__mmask8>((1u << count) - 1), p));
#else
  for (int l = 0; l < W; ++l) a[l] = p[l < count ? l : count - 1];
#endif
  return a;
}
inline void store(double* p, Real a, int count) {
#if defined(__AVX512F__)
  _mm512_mask_storeu_pd(p, static_cast<__mmask8>((1u << count) - 1), (__m512d)a);
#else
  for (int l = 0; l < count; ++l) p[l] = a[l];
#endif
}
inline Real select(Bits m, Real a, Real b) { return m ? a : b; }
inline Real zero_unless(Bits m, Real a) { return m ? a : Real{}; }

#if defined(__AVX512F__)
inline Real fma(Real a, Real b, Real c) { return (Real)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
inline Real fms(Real a, Real b, Real c) { return (Real)_mm512_fmsub_pd((__m512d)a, (__m512d)b, (__m512d)c); }
inline Real fnma(Real a, Real b, Real c) { return (Real)_mm512_fnmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
inline Real root(Real a) { return (Real)_mm512_sqrt_pd((__m512d)a); }
inline Real max(Real a, Real b) { return (Real)_mm512_max_pd((__m512d)a, (__m512d)b); }
inline unsigned bits_less(Real a, Real b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LT_OQ); }
#elif defined(__AVX__) && defined(__FMA__)
inline Real fma(Real a, Real b, Real c) { return (Real)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline Real fms(Real a, Real b, Real c) { return (Real)_mm256_fmsub_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline Real fnma(Real a, Real b, Real c) { return (Real)_mm256_fnmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline Real root(Real a) { return (Real)_mm256_sqrt_pd((__m256d)a); }
inline Real max(Real a, Real b) { return (Real)_mm256_max_pd((__m256d)a, (__m256d)b); }
inline unsigned bits_less(Real a, Real b) {
  return _mm256_movemask_pd(_mm256_cmp_pd((__m256d)a, (__m256d)b, _CMP_LT_OQ));
}
#elif defined(__SSE2__)
inline Real fma(Real a, Real b, Real c) { return a * b + c; }
inline Real fms(Real a, Real b, Real c) { return a * b - c; }
inline Real fnma(Real a, Real b, Real c) { return c - a * b; }
inline Real root(Real a) { return (Real)_mm_sqrt_pd((__m128d)a); }
inline Real max(Real a, Real b) { return (Real)_mm_max_pd((__m128d)a, (__m128d)b); }
inline unsigned bits_less(Real a, Real b) { return _mm_movemask_pd(_mm_cmplt_pd((__m128d)a, (__m128d)b)); }
#elif defined(__aarch64__)
inline Real fma(Real a, Real b, Real c) { return (Real)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
inline Real fms(Real a, Real b, Real c) { return fma(a, b, -c); }
inline Real fnma(Real a, Real b, Real c) { return (Real)vfmsq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
inline Real root(Real a) { return (Real)vsqrtq_f64((float64x2_t)a); }
inline Real max(Real a, Real b) { return a > b ? a : b; }
inline unsigned bits_less(Real a, Real b) { return (a[0] < b[0] ? 1u : 0u) | (a[1] < b[1] ? 2u : 0u); }
#else
inline Real fma(Real a, Real b, Real c) { return a * b + c; }
inline Real fms(Real a, Real b, Real c) { return a * b - c; }
inline Real fnma(Real a, Real b, Real c) { return c - a * b; }
inline Real max(Real a, Real b) { return a > b ? a : b; }
inline Real root(Real a) {
  Real r;
  for (int l = 0; l < W; ++l) r[l] = __builtin_sqrt(a[l]);
  return r;
}
inline unsigned bits_less(Real a, Real b) {
  unsigned bits = 0;
  for (int l = 0; l < W; ++l) bits |= (a[l] < b[l] ? 1u : 0u) << l;
  return bits;
}
#endif

// Largest integer not above a, for 0 <= a < 2^51.
inline Real floor_of(Real a) {
  const Real big = splat<Real>(6755399441055744.0);  // 1.5 * 2^52
  const Real nearest = (a + big) - big;
  return nearest - zero_unless(nearest > a, splat<Real>(1.0));
}

template <>
constexpr int kLanes<Real> = W;
inline unsigned bits(Bits m) { return bits_less(zero_unless(m, splat<Real>(-1.0)), Real{}); }
inline Bits differ(Real a, Real b) { return a != b; }
inline void copy_lane(Real& to, int l, Real from) { to[l] = from[l]; }

inline double largest(Real a) {
  double m = a[0];
  for (int l = 1; l < W; ++l) m = a[l] > m ? a[l] : m;
  return m;
}

inline double smallest(Real a) {
  double m = a[0];
  for (int l = 1; l < W; ++l) m = a[l] < m ? a[l] : m;
  return m;
}

// 1 / sqrt(a) of a positive normal number to about an ulp. The divider would take some 35 cycles for the root and the
// quotient of eight lanes, and does not overlap them; and the approximate roots of some CPUs differ from others'.
inline Real inverse_root(Real a) {
  const Real one = splat<Real>(1.0);
  // From the bits of a, to 3.5 %; then by the best cubic for that interval, to 8e-7; then by a Taylor series.
  Real y = (Real)(0x5FE6E8EAE1500000 - ((Bits)a >> 1));
  Real r = fnma(a * y, y, one);
  Real p = fma(splat<Real>(0.3139020622967821), r, splat<Real>(0.37627395776434536));
  p = fma(p, r, splat<Real>(0.4999984446460111));
  y = y * fma(p, r, splat<Real>(0.9999992598857359));
  r = fnma(a * y, y, one);
  return fma(y * r, fma(splat<Real>(0.375), r, splat<Real>(0.5)), y);
}

}  // namespace GMEM_ISA
}  // namespace gmem
