// The functions that the physics needs of a number, for one double: a lane of a GPU, or of a test.
//
// All code that kernel.cc compiles is in a namespace named after the instruction set: the linker must not take the code
// of one set for that of another.

#pragma once

#if defined(__GNUC__) && !defined(__clang__) && __GNUC__ < 11
#error "gmem_jax needs g++ 11 or newer, or clang++ 14 or newer"
#elif defined(__clang__) && __clang_major__ < 14 && !defined(__apple_build_version__)
#error "gmem_jax needs clang++ 14 or newer, or g++ 11 or newer"
#endif

#ifndef GMEM_ISA
#define GMEM_ISA baseline
#endif

#define GMEM_INLINE inline __attribute__((always_inline))
// For long functions that are called in several places. On a GPU they are inlined, so that their arguments stay in
// registers.
#if defined(__CUDACC_RTC__)
#define GMEM_APART GMEM_INLINE
#else
#define GMEM_APART __attribute__((noinline))
#endif

namespace gmem {
namespace GMEM_ISA {

// The result of comparing two numbers.
template <class V>
using Mask = decltype(V{} < V{});

template <class V>
constexpr V splat(double a) {
  if constexpr (__is_class(V)) {
    return V::of(a);
  } else {
    return V{} + a;
  }
}

// Numbers that a V is made of, to be calculated side by side.
template <class V>
constexpr int kLanes = 1;

// The square of a force below which it has no magnitude worth restoring: its own square would underflow.
template <class V>
constexpr double kTiny = 1e-280;

inline double select(bool m, double a, double b) { return m ? a : b; }
inline double zero_unless(bool m, double a) { return m ? a : 0.0; }

#if defined(__CUDA_ARCH__)
inline double fma(double a, double b, double c) { return __fma_rn(a, b, c); }
inline double root(double a) { return __dsqrt_rn(a); }
inline double inverse_root(double a) { return ::rsqrt(a); }
inline double floor_of(double a) { return ::floor(a); }
#else
inline double fma(double a, double b, double c) {
#if defined(__FMA__) || defined(__aarch64__)
  return __builtin_fma(a, b, c);
#else
  return a * b + c;
#endif
}
inline double root(double a) { return __builtin_sqrt(a); }
inline double inverse_root(double a) { return 1.0 / __builtin_sqrt(a); }
inline double floor_of(double a) { return __builtin_floor(a); }
#endif
inline double fms(double a, double b, double c) { return fma(a, b, -c); }
inline double fnma(double a, double b, double c) { return fma(-a, b, c); }
inline double max(double a, double b) { return a > b ? a : b; }
inline unsigned bits(bool m) { return m; }
inline unsigned bits_less(double a, double b) { return a < b; }
inline bool differ(double a, double b) { return a != b; }
inline void copy_lane(double& to, int, double from) { to = from; }
inline double largest(double a) { return a; }
inline double smallest(double a) { return a; }

}  // namespace GMEM_ISA
}  // namespace gmem
