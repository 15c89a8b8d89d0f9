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
typedef V Real;                    // V is another kind of number where derivatives are taken

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
inline V max(V a, V b) { return (V)_mm512_max_pd((__m512d)a, (__m512d)b); }
inline unsigned bits_less(V a, V b) { return _mm512_cmp_pd_mask((__m512d)a, (__m512d)b, _CMP_LT_OQ); }
#elif defined(__AVX__) && defined(__FMA__)
inline V fma(V a, V b, V c) { return (V)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline V fms(V a, V b, V c) { return (V)_mm256_fmsub_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline V fnma(V a, V b, V c) { return (V)_mm256_fnmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
inline V root(V a) { return (V)_mm256_sqrt_pd((__m256d)a); }
inline V max(V a, V b) { return (V)_mm256_max_pd((__m256d)a, (__m256d)b); }
inline unsigned bits_less(V a, V b) {
  return _mm256_movemask_pd(_mm256_cmp_pd((__m256d)a, (__m256d)b, _CMP_LT_OQ));
}
#elif defined(__SSE2__)
inline V fma(V a, V b, V c) { return a * b + c; }
inline V fms(V a, V b, V c) { return a * b - c; }
inline V fnma(V a, V b, V c) { return c - a * b; }
inline V root(V a) { return (V)_mm_sqrt_pd((__m128d)a); }
inline V max(V a, V b) { return (V)_mm_max_pd((__m128d)a, (__m128d)b); }
inline unsigned bits_less(V a, V b) { return _mm_movemask_pd(_mm_cmplt_pd((__m128d)a, (__m128d)b)); }
#elif defined(__aarch64__)
inline V fma(V a, V b, V c) { return (V)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
inline V fms(V a, V b, V c) { return fma(a, b, -c); }
inline V fnma(V a, V b, V c) { return (V)vfmsq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b); }
inline V root(V a) { return (V)vsqrtq_f64((float64x2_t)a); }
inline V max(V a, V b) { return a > b ? a : b; }
inline unsigned bits_less(V a, V b) { return (a[0] < b[0] ? 1u : 0u) | (a[1] < b[1] ? 2u : 0u); }
#else
inline V fma(V a, V b, V c) { return a * b + c; }
inline V fms(V a, V b, V c) { return a * b - c; }
inline V fnma(V a, V b, V c) { return c - a * b; }
inline V max(V a, V b) { return a > b ? a : b; }
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

// a b + c of one lane.
inline double fma_one(double a, double b, double c) {
#if defined(__FMA__) || defined(__aarch64__)
  return __builtin_fma(a, b, c);
#else
  return a * b + c;
#endif
}

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

// 1 / sqrt(a) of a positive normal number to about an ulp. The divider would take some 35 cycles for the root and the
// quotient of eight lanes, and does not overlap them; and the approximate roots of some CPUs differ from others'.
inline V inverse_root(V a) {
  const V one = splat(1.0);
  // From the bits of a, to 3.5 %; then by the best cubic for that interval, to 8e-7; then by a Taylor series.
  V y = (V)(0x5FE6E8EAE1500000 - ((Mask)a >> 1));
  V r = fnma(a * y, y, one);
  V p = fma(splat(0.3139020622967821), r, splat(0.37627395776434536));
  p = fma(p, r, splat(0.4999984446460111));
  y = y * fma(p, r, splat(0.9999992598857359));
  r = fnma(a * y, y, one);
  return fma(y * r, fma(splat(0.375), r, splat(0.5)), y);
}

// How numbers are put together from the arrays of a block, and which of them are results; see dual.h.
template <class Gather>
inline V of_lanes(const Block& block, const Gather& gather) {
  return gather(block.lanes);
}
inline Real result(V a) { return a; }
inline const Lane* results(const Block& block) { return block.lanes; }
