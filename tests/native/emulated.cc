// The GPU's half of the library on a CPU: the same handler and the same kernels, a launch being a loop over threads.

#include "emulated.h"

#include "cuda/back.h"
#include "cuda/handler.cc"

namespace gmem {
namespace cuda {

namespace {

// Of one thread on the way back.
template <class Law>
void run_back(GpuKernel kernel, const Arguments& a, int step, int thread) {
  namespace k = gmem::GMEM_ISA;
  switch (kernel) {
    case GpuKernel::take: return k::take<Law>(a, thread);
    case GpuKernel::touch_back: return k::touch_back<Law>(a, step, thread);
    case GpuKernel::gather_back: return k::gather_back(a, thread);
    case GpuKernel::move_back: return k::move_back(a, step, thread);
    case GpuKernel::collect_walls: return k::collect_walls(a, step, thread);
    case GpuKernel::sum_up: return k::sum_up(a, step, thread);
    case GpuKernel::leave_back: return k::leave_back(a, thread);
    default: return;
  }
}

// Of one thread.
template <class V, class Law, bool periodic, bool unequal, bool rubs, bool keeps = false>
void run(GpuKernel kernel, const Arguments& a, int step, int thread) {
  namespace k = gmem::GMEM_ISA;
  switch (kernel) {
    case GpuKernel::enter: return k::enter<V, periodic, unequal, keeps>(a, thread);
    case GpuKernel::remember: return k::remember<V, Law, rubs>(a, thread);
    case GpuKernel::touch: return k::touch<V, Law, periodic, unequal, rubs, keeps>(a, step, thread);
    case GpuKernel::move:  // in the order of its sum it is the same
    case GpuKernel::move_alone: return k::move_alone<V, periodic, unequal, rubs, keeps>(a, step, thread);
    case GpuKernel::collect: return k::collect<V>(a, step, thread);
    case GpuKernel::leave: return k::leave<V, Law, rubs>(a, thread);
    default:
      if constexpr (keeps) run_back<Law>(kernel, a, step, thread);
  }
}

}  // namespace

Run run_of(const Which& which) {
  return with_law(which.law, which.variant, [&](auto law) -> Run {
    using L = decltype(law);
    if constexpr (!L::kLayered)
      if (which.task == Task::adjoint) return run<double, L, false, false, false, true>;
    const auto of_numbers = [&](auto number) -> Run {
      using V = decltype(number);
      if (which.unequal) return which.periodic || which.rubs ? nullptr : run<V, L, false, true, false>;  // not tested
      if (which.periodic) return which.rubs ? run<V, L, true, false, true> : run<V, L, true, false, false>;
      return which.rubs ? run<V, L, false, false, true> : run<V, L, false, false, false>;
    };
    return which.task == Task::forward ? of_numbers(double{}) : of_numbers(gmem::GMEM_ISA::Dual<double>{});
  });
}

namespace {

template <Task task>
xla::ffi::Error emulate(int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t leaves, int64_t mixed,
                        int64_t periodic, int64_t unequal, int64_t rubs, xla::ffi::RemainingArgs args,
                        xla::ffi::RemainingRets rets) {
  return handle<task>(nullptr, law, variant, points, isotropic, leaves, mixed, periodic, unequal, rubs, args, rets);
}

auto without_stream() { return with_arguments(xla::ffi::Ffi::Bind()); }

}  // namespace

Launcher::Launcher(void* stream, const Which& which) : stream_(stream), kernels_(new Which(which)) {}
Launcher::~Launcher() { delete static_cast<const Which*>(kernels_); }

void Launcher::operator()(GpuKernel kernel, int items, const Arguments& a, int step) const {
  const Which& which = *static_cast<const Which*>(kernels_);
  constexpr int block = 128;
  const int threads = (items * a.lanes + block - 1) / block * block;  // blocks are whole
  const Run run = run_of(which);
  for (int thread = 0; thread < threads; ++thread) run(kernel, a, step, thread);
}

}  // namespace cuda
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_emulated_advance, gmem::cuda::emulate<gmem::Task::forward>,
                              gmem::cuda::without_stream());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_emulated_tangent, gmem::cuda::emulate<gmem::Task::tangent>,
                              gmem::cuda::without_stream());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_emulated_adjoint, gmem::cuda::emulate<gmem::Task::adjoint>,
                              gmem::cuda::without_stream());
