// What a number is to the physics: something with arithmetic, comparisons, and the functions of scalar.h. There are
// plain ones - a vector of lanes on a CPU, a double on a GPU - and those made of them in dual.h and tape.h.

#pragma once

#include "numbers/scalar.h"

#if !defined(__CUDACC__) && !defined(__CUDACC_RTC__)
#include "numbers/simd.h"
#endif
