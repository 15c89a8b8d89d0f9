// The kernels of one law, GMEM_LAW, in numbers of one kind, GMEM_NUMBER; compiled at run time, see compile.cc. With
// GMEM_BACK they are those of reverse mode: steps that keep the numbers that the way back needs, and the way back.

#if GMEM_BACK
#include "cuda/back.h"
#else
#include "cuda/step.h"
#endif

namespace {

using namespace gmem;
using namespace gmem::GMEM_ISA;
using cuda::kItems;
using cuda::kWorkers;
using Number = GMEM_NUMBER;

inline int thread() { return blockIdx.x * blockDim.x + threadIdx.x; }

}  // namespace

// Blocks of 128 threads that shall fit into a multiprocessor: 8 leave 64 registers to a thread. Tried on an H200; more
// threads hide more of the memory's latency than a few spilt numbers cost. Other values by GMEM_NVRTC="-DGMEM_TOUCH=6".
constexpr bool kPlain = !__is_class(Number), kPeriodic = GMEM_PERIODIC, kUnequal = GMEM_UNEQUAL, kRubs = GMEM_RUBS,
               kKeeps = GMEM_BACK;
#ifndef GMEM_TOUCH
#define GMEM_TOUCH (!kPlain ? 2 : GMEM_LAW::kLayered ? 4 : 8)
#endif
#ifndef GMEM_MOVE
#define GMEM_MOVE (kPlain ? 5 : 2)
#endif
#define GMEM_KERNEL(threads, blocks) extern "C" __global__ void __launch_bounds__(threads, blocks)
#define GMEM_GIVEN const __grid_constant__ Arguments a, int step

GMEM_KERNEL(128, 2) enter(GMEM_GIVEN) { gmem::GMEM_ISA::enter<Number, kPeriodic, kUnequal, kKeeps>(a, thread()); }
GMEM_KERNEL(128, 4) remember(GMEM_GIVEN) { gmem::GMEM_ISA::remember<Number, GMEM_LAW, kRubs>(a, thread()); }
GMEM_KERNEL(128, GMEM_TOUCH) touch(GMEM_GIVEN) {
  gmem::GMEM_ISA::touch<Number, GMEM_LAW, kPeriodic, kUnequal, kRubs, kKeeps>(a, step, thread());
}
GMEM_KERNEL(128, GMEM_MOVE) move_alone(GMEM_GIVEN) {
  gmem::GMEM_ISA::move_alone<Number, kPeriodic, kUnequal, kRubs, kKeeps>(a, step, thread());
}
#if GMEM_BACK
GMEM_KERNEL(128, 4) take(GMEM_GIVEN) { gmem::GMEM_ISA::take<GMEM_LAW>(a, thread()); }
GMEM_KERNEL(128, 2) touch_back(GMEM_GIVEN) { gmem::GMEM_ISA::touch_back<GMEM_LAW>(a, step, thread()); }
GMEM_KERNEL(128, 6) gather_back(GMEM_GIVEN) { gmem::GMEM_ISA::gather_back(a, thread()); }
GMEM_KERNEL(128, 2) move_back(GMEM_GIVEN) { gmem::GMEM_ISA::move_back(a, step, thread()); }
GMEM_KERNEL(128, 4) collect_walls(GMEM_GIVEN) { gmem::GMEM_ISA::collect_walls(a, step, thread()); }
GMEM_KERNEL(128, 4) sum_up(GMEM_GIVEN) { gmem::GMEM_ISA::sum_up(a, step, thread()); }
GMEM_KERNEL(128, 4) leave_back(GMEM_GIVEN) { gmem::GMEM_ISA::leave_back(a, thread()); }
#else
GMEM_KERNEL(128, 4) collect(GMEM_GIVEN) { gmem::GMEM_ISA::collect<Number>(a, step, thread()); }
GMEM_KERNEL(128, 4) leave(GMEM_GIVEN) { gmem::GMEM_ISA::leave<Number, GMEM_LAW, kRubs>(a, thread()); }
#endif

GMEM_KERNEL(kItems* kWorkers, 2) move(GMEM_GIVEN) {
  __shared__ Load<Number> part[kWorkers][kItems];
  const int slot = threadIdx.x % kItems, worker = threadIdx.x / kItems;
  const ReplicaView<Number> on(a, blockIdx.x * kItems + slot);
  Load<Number> sum{};
  for (int first = 0; first < a.spheres; first += kWorkers) {
    part[worker][slot] = loads_of<Number, kPeriodic, kRubs>(on, step, first + worker);
    __syncthreads();
    for (int w = 0; worker == 0 && w < kWorkers && first + w < a.spheres; ++w) sum = sum + part[w][slot];
    if (first + kWorkers < a.spheres) __syncthreads();
  }
  if (worker == 0) gmem::GMEM_ISA::move<Number, kPeriodic, kUnequal, kKeeps>(on, step, sum);
}
