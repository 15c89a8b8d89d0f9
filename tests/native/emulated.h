// The kernels of a GPU on the CPU, as emulated.cc has them.

#pragma once

#include "cuda/arguments.h"
#include "cuda/compile.h"

namespace gmem {
namespace cuda {

// One thread of a kernel.
using Run = void (*)(GpuKernel, const Arguments&, int step, int thread);

// ... of some kernels; null for those that are not tested.
Run run_of(const Which& which);

}  // namespace cuda
}  // namespace gmem
