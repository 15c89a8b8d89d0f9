// What a number is to the physics: something with arithmetic, comparisons, and the functions of scalar.h. There are
// plain ones - a vector of lanes on a CPU, a double on a GPU - and those made of them in dual.h and tape.h.

#pragma once

#include "numbers/scalar.h"

#if !defined(__CUDACC__) && !defined(__CUDACC_RTC__)
#include "numbers/simd.h"
#endif

namespace gmem {
namespace GMEM_ISA {

// How many independent chains of operations are computed side by side. On a GPU threads serve this purpose.
#if defined(__CUDA_ARCH__)
constexpr int kTogether = 1;
#else
constexpr int kTogether = 8;
#endif

}  // namespace GMEM_ISA
}  // namespace gmem
