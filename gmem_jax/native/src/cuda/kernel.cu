// The kernels of one law, GMEM_LAW, in numbers of one kind, GMEM_NUMBER; compiled at run time, see compile.cc.

#include "cuda/step.h"

namespace {

using namespace gmem;
using namespace gmem::GMEM_ISA;
using Number = GMEM_NUMBER;

inline int thread() { return blockIdx.x * blockDim.x + threadIdx.x; }

}  // namespace

#define GMEM_KERNEL extern "C" __global__ void __launch_bounds__(GMEM_BLOCK, 2)

GMEM_KERNEL enter(const Arguments a, int) { gmem::GMEM_ISA::enter<Number, GMEM_LAW>(a, thread()); }
GMEM_KERNEL advance(const Arguments a, int step) { gmem::GMEM_ISA::advance<Number, GMEM_LAW>(a, step, thread()); }
GMEM_KERNEL collect(const Arguments a, int) { gmem::GMEM_ISA::collect<Number>(a, thread()); }
GMEM_KERNEL leave(const Arguments a, int) { gmem::GMEM_ISA::leave<Number, GMEM_LAW>(a, thread()); }
