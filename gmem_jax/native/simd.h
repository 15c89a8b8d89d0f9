// Vectors of W doubles and their masks. Every operation is a correctly rounded IEEE operation per lane (or, in
// `inverse_root`, a fixed sequence of them), so that a lane's numbers depend neither on W nor on its neighbours.
//
// Included by kernel.cc inside the namespace of one instruction set.

#define GMEM_INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__)
constexpr int W = 8;
#elif defined(__AVX__)
constexpr int W = 4;
#else
constexpr int W = 2;
#endif

typedef double V __attribute__((vector_size(8 * W)));
typedef double Unaligned __attribute__((vector_size(8 * W), aligned(8), may_alias));
typedef decltype(V{} < V{}) Mask;  // all bits of a lane set or clear

inline V splat(double a) { return V{} + a; }
inline V load(const double* p) { return *reinterpret_cast<const Unaligned*>(p); }
inline void store(double* p, V a) { *reinterpret_cast<Unaligned*>(p) = a; }
inline V select(Mask m, V a, V b) { return m ? a : b; }
inline V zero_unless(Mask m, V a) { return m ? a : V{}; }

#if defined(__AVX512F__)
inline V fma(V a, V b, V c) { return (V)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
inline V fms(V a, V b, V c) { return (V)_mm512_fmsub_pd((__m512d)a, (__m512d)b, (__m512d)c); }
inline V fnma(V a, V b, V c) { return (V)_mm512_fnmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
inline V root(V a) { return (V)_mm512_sqrt_pd((__m512d)a); }
inline unsigned bits_less(V a, V b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LT_OQ); }
#elif defined(__AVX__) && defined(__FMA__)
inline V fma(V a, V b, V c) { return (V)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline V fms(V a, V b, V c) { return (V)_mm256_fmsub_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline V fnma(V a, V b, V c) { return (V)_mm256_fnmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline V root(V a) { return (V)_mm256_sqrt_pd((__m256d)a); }
inline unsigned bits_less(V a, V b) {
  return _mm256_movemask_pd(_mm256_cmp_pd((__m256d)a, (__m256d)b, _CMP_LT_OQ));
}
#elif defined(__SSE2__)
inline V fma(V a, V b, V c) { return a * b + c; }
inline V fms(V a, V b, V c) { return a * b - c; }
inline V fnma(V a, V b, V c) { return c - a * b; }
inline V root(V a) { return (V)_mm_sqrt_pd((__m128d)a); }
inline unsigned bits_less(V a, V b) { return _mm_movemask_pd(_mm_cmplt_pd((__m128d)a, (__m128d)b)); }
#elif defined(__aarch64__)
inline V fma(V a, V b, V c) { return (V)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
inline V fms(V a, V b, V c) { return fma(a, b, -c); }
inline V fnma(V a, V b, V c) { return (V)vfmsq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
inline V root(V a) { return (V)vsqrtq_f64((float64x2_t)a); }
inline unsigned bits_less(V a, V b) { return (a[0] < b[0] ? 1u : 0u) | (a[1] < b[1] ? 2u : 0u); }
#else
inline V fma(V a, V b, V c) { return a * b + c; }
inline V fms(V a, V b, V c) { return a * b - c; }
inline V fnma(V a, V b, V c) { return c - a * b; }
inline V root(V a) {
  V r;
  for (int l = 0; l < W; ++l) r[l] = __builtin_sqrt(a[l]);
  return r;
}
inline unsigned bits_less(V a, V b) {
  unsigned bits = 0;
  for (int l = 0; l < W; ++l) bits |= (a[l] < b[l] ? 1u : 0u) << l;
  return bits;
}
#endif

#ifdef GMEM_RSQRT14
constexpr int kNewtonSteps = 2;
inline V guess_inverse_root(V a) { return (V)_mm512_rsqrt14_pd((__m512d)a); }
#else
// 1 / sqrt(a) of a positive normal number to 3 %, from its bits.
constexpr int kNewtonSteps = 4;
inline V guess_inverse_root(V a) { return (V)(0x5FE6EB50C7B537A9 - ((Mask)a >> 1)); }
#endif

// Largest integer not above a, for 0 <= a < 2^51.
inline V floor_of(V a) {
  const V big = splat(6755399441055744.0);  // 1.5 * 2^52
  const V nearest = (a + big) - big;
  return nearest - zero_unless(nearest > a, splat(1.0));
}

inline double largest(V a) {
  double m = a[0];
  for (int l = 1; l < W; ++l) m = a[l] > m ? a[l] : m;
  return m;
}

inline double smallest(V a) {
  double m = a[0];
  for (int l = 1; l < W; ++l) m = a[l] < m ? a[l] : m;
  return m;
}

// 1 / sqrt(a) of a positive normal number to about an ulp, by Newton's method: the divider would take some 35 cycles
// for the root and the quotient of eight lanes, and does not overlap them.
inline V inverse_root(V a) {
  const V half = splat(0.5), h = half * a;
  V y = guess_inverse_root(a);
  for (int step = 0; step < kNewtonSteps; ++step) y = fma(y, fnma(h * y, y, half), y);
  return y;
}
