// Vectors of N floats, for contacts in mixed precision; and two vectors of doubles as one number of as many lanes.
// Every operation is correctly rounded per lane (or, in `inverse_root`, a fixed sequence of such operations), so that a
// lane's numbers depend neither on N nor on its neighbours.

#pragma once

#include <cstring>

#include "numbers/simd.h"
#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

template <int N>
struct Floats;
template <>
struct Floats<W> {
  typedef float Lanes __attribute__((vector_size(4 * W)));
};
template <>
struct Floats<2 * W> {
  typedef float Lanes __attribute__((vector_size(8 * W)));
};

template <int N>
struct Single {
  using Lanes = typename Floats<N>::Lanes;
  using Bits = Mask<Lanes>;
  Lanes v;

  static Single of(double a) { return {Lanes{} + static_cast<float>(a)}; }
  double operator[](int l) const { return v[l]; }

  friend Single select(Bits m, Single a, Single b) { return {m ? a.v : b.v}; }
  friend Single zero_unless(Bits m, Single a) { return {m ? a.v : Lanes{}}; }
  friend Single operator+(Single a, Single b) { return {a.v + b.v}; }
  friend Single operator-(Single a, Single b) { return {a.v - b.v}; }
  friend Single operator-(Single a) { return {-a.v}; }
  friend Single operator*(Single a, Single b) { return {a.v * b.v}; }
  friend Single operator/(Single a, Single b) { return {a.v / b.v}; }
  friend Bits operator<(Single a, Single b) { return a.v < b.v; }
  friend Bits operator>(Single a, Single b) { return a.v > b.v; }
  friend Bits operator<=(Single a, Single b) { return a.v <= b.v; }
  friend Single fma(Single a, Single b, Single c) { return {fused(a.v, b.v, c.v)}; }
  friend Single fms(Single a, Single b, Single c) { return {fused(a.v, b.v, -c.v)}; }
  friend Single fnma(Single a, Single b, Single c) { return {fused(-a.v, b.v, c.v)}; }
  friend Single max(Single a, Single b) { return {a.v > b.v ? a.v : b.v}; }
  friend Single root(Single a) { return {rooted(a.v)}; }

  friend unsigned bits_less(Single a, Single b) {
#if defined(__AVX512F__)
    if constexpr (N == 16) return _mm512_cmp_ps_mask((__m512)a.v, (__m512)b.v, _CMP_LT_OQ);
#endif
#if defined(__AVX__)
    if constexpr (N == 8) return _mm256_movemask_ps(_mm256_cmp_ps((__m256)a.v, (__m256)b.v, _CMP_LT_OQ));
#endif
    unsigned bits = 0;
    for (int l = 0; l < N; ++l) bits |= (a.v[l] < b.v[l] ? 1u : 0u) << l;
    return bits;
  }
  friend double largest(Single a) {
    float m = a.v[0];
    for (int l = 1; l < N; ++l) m = a.v[l] > m ? a.v[l] : m;
    return m;
  }
  friend double smallest(Single a) {
    float m = a.v[0];
    for (int l = 1; l < N; ++l) m = a.v[l] < m ? a.v[l] : m;
    return m;
  }

  // Largest integer not above a, for 0 <= a < 2^22.
  friend Single floor_of(Single a) {
    const Single big = of(12582912.0);  // 1.5 * 2^23
    const Single nearest = (a + big) - big;
    return nearest - zero_unless(nearest > a, of(1.0));
  }

  // 1 / sqrt(a) of a positive normal number to about an ulp, as for doubles.
  friend Single inverse_root(Single a) {
    const Single one = of(1.0);
    Single y{(Lanes)(0x5F374757 - ((Bits)a.v >> 1))};
    Single r = fnma(a * y, y, one);
    Single p = fma(of(0.3139020622967821), r, of(0.37627395776434536));
    p = fma(p, r, of(0.4999984446460111));
    y = y * fma(p, r, of(0.9999992598857359));
    r = fnma(a * y, y, one);
    return fma(y * r, of(0.5), y);
  }

 private:
  static Lanes fused(Lanes a, Lanes b, Lanes c) {
#if defined(__AVX512F__)
    if constexpr (N == 16) return (Lanes)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#endif
#if defined(__FMA__)
    if constexpr (N == 8) return (Lanes)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
    if constexpr (N == 4) return (Lanes)_mm_fmadd_ps((__m128)a, (__m128)b, (__m128)c);
#endif
    return a * b + c;
  }

  static Lanes rooted(Lanes a) {
#if defined(__AVX512F__)
    if constexpr (N == 16) return (Lanes)_mm512_sqrt_ps((__m512)a);
#endif
#if defined(__AVX__)
    if constexpr (N == 8) return (Lanes)_mm256_sqrt_ps((__m256)a);
#endif
    Lanes r;
    for (int l = 0; l < N; ++l) r[l] = __builtin_sqrtf(a[l]);
    return r;
  }
};

template <int N>
constexpr double kTiny<Single<N>> = 1e-35;

// Twice as many lanes.
struct Pair {
  struct Bits {
    Mask<Real> a, b;
    friend Bits operator&(Bits m, Bits n) { return {m.a & n.a, m.b & n.b}; }
  };
  Real a, b;

  static Pair of(double x) { return {splat<Real>(x), splat<Real>(x)}; }
  double operator[](int l) const { return l < W ? a[l] : b[l - W]; }

  friend Pair select(Bits m, Pair x, Pair y) { return {select(m.a, x.a, y.a), select(m.b, x.b, y.b)}; }
  friend Pair zero_unless(Bits m, Pair x) { return {zero_unless(m.a, x.a), zero_unless(m.b, x.b)}; }
  friend Pair operator+(Pair x, Pair y) { return {x.a + y.a, x.b + y.b}; }
  friend Pair operator-(Pair x, Pair y) { return {x.a - y.a, x.b - y.b}; }
  friend Pair operator-(Pair x) { return {-x.a, -x.b}; }
  friend Pair operator*(Pair x, Pair y) { return {x.a * y.a, x.b * y.b}; }
  friend Pair operator/(Pair x, Pair y) { return {x.a / y.a, x.b / y.b}; }
  friend Pair fma(Pair x, Pair y, Pair z) { return {fma(x.a, y.a, z.a), fma(x.b, y.b, z.b)}; }
  friend Pair fms(Pair x, Pair y, Pair z) { return {fms(x.a, y.a, z.a), fms(x.b, y.b, z.b)}; }
  friend Pair fnma(Pair x, Pair y, Pair z) { return {fnma(x.a, y.a, z.a), fnma(x.b, y.b, z.b)}; }
  friend Bits operator<(Pair x, Pair y) { return {x.a < y.a, x.b < y.b}; }
  friend Bits operator>(Pair x, Pair y) { return {x.a > y.a, x.b > y.b}; }
  friend Pair max(Pair x, Pair y) { return {max(x.a, y.a), max(x.b, y.b)}; }
  friend Pair root(Pair x) { return {root(x.a), root(x.b)}; }
  friend unsigned bits_less(Pair x, Pair y) { return bits_less(x.a, y.a) | bits_less(x.b, y.b) << W; }
  // Not-a-number in the first half is returned, as from one half alone: a bound without it would be too low.
  friend double largest(Pair x) {
    const double a = largest(x.a), b = largest(x.b);
    return a != a || a > b ? a : b;
  }
  friend double smallest(Pair x) {
    const double a = smallest(x.a), b = smallest(x.b);
    return a != a || a < b ? a : b;
  }
  friend void store(double* p, Pair x) { store(p, x.a), store(p + W, x.b); }
  friend void store(double* p, Pair x, int count) {
    store(p, x.a, count < W ? count : W);
    if (count > W) store(p + W, x.b, count - W);
  }
};

using Halves = Floats<W>::Lanes;

inline Single<W> narrow(Real a) { return {__builtin_convertvector(a, Halves)}; }
inline Real widen(Single<W> a) { return __builtin_convertvector((Halves)a.v, Real); }

inline Single<2 * W> narrow(Pair a) {
#if defined(__AVX512F__)
  return {(Single<2 * W>::Lanes) _mm512_insertf32x8(_mm512_castps256_ps512(_mm512_cvtpd_ps((__m512d)a.a)),
                                                    _mm512_cvtpd_ps((__m512d)a.b), 1)};
#else
  const Halves parts[2] = {narrow(a.a).v, narrow(a.b).v};
  Single<2 * W> both;
  std::memcpy(&both, parts, sizeof both);
  return both;
#endif
}

inline Pair widen(Single<2 * W> a) {
#if defined(__AVX512F__)
  return {(Real)_mm512_cvtps_pd(_mm512_castps512_ps256((__m512)a.v)),
          (Real)_mm512_cvtps_pd(_mm512_extractf32x8_ps((__m512)a.v, 1))};
#else
  Halves parts[2];
  std::memcpy(parts, &a, sizeof a);
  return {widen(Single<W>{parts[0]}), widen(Single<W>{parts[1]})};
#endif
}

template <class V>
GMEM_INLINE void put(V& to, V a) {
  to = a;
}
GMEM_INLINE void put(Single<W>& to, Real a) { to = narrow(a); }
GMEM_INLINE void put(Single<2 * W>& to, Pair a) { to = narrow(a); }
GMEM_INLINE void put(Real& to, Single<W> a) { to = widen(a); }
GMEM_INLINE void put(Pair& to, Single<2 * W> a) { to = widen(a); }

// From one precision to another, or the same.
template <class To, class From>
GMEM_INLINE To convert(From a) {
  To to;
  put(to, a);
  return to;
}
template <class To, class From>
GMEM_INLINE Vec<To> convert(Vec<From> a) {
  return {convert<To>(a.x), convert<To>(a.y), convert<To>(a.z)};
}

}  // namespace GMEM_ISA
}  // namespace gmem
