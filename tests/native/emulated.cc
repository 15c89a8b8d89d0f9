// The GPU's half of the library on a CPU: the same handler and the same kernels, a launch being a loop over threads.

#include "cuda/handler.cc"
#include "cuda/step.h"

namespace gmem {
namespace cuda {

namespace {

template <class V, class Law>
void run(GpuKernel kernel, int threads, const Arguments& a, int step) {
  namespace k = gmem::GMEM_ISA;
  threads = (threads + kBlock - 1) / kBlock * kBlock;  // blocks are whole
  for (int thread = 0; thread < threads; ++thread) {
    switch (kernel) {
      case GpuKernel::enter: k::enter<V, Law>(a, thread); break;
      case GpuKernel::advance: k::advance<V, Law>(a, step, thread); break;
      case GpuKernel::collect: k::collect<V>(a, thread); break;
      case GpuKernel::leave: k::leave<V, Law>(a, thread); break;
    }
  }
}

template <Task task>
xla::ffi::Error emulate(int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t leaves,
                        int64_t mixed, xla::ffi::RemainingArgs args, xla::ffi::RemainingRets rets) {
  return handle<task>(nullptr, law, variant, points, isotropic, leaves, mixed, args, rets);
}

auto without_stream() { return with_arguments(xla::ffi::Ffi::Bind()); }

}  // namespace

Launcher::Launcher(void* stream, const Which& which) : stream_(stream), kernels_(new Which(which)) {}
Launcher::~Launcher() { delete static_cast<const Which*>(kernels_); }

void Launcher::operator()(GpuKernel kernel, int threads, const Arguments& a, int step) const {
  const Which& which = *static_cast<const Which*>(kernels_);
  with_law(which.law, which.variant, [&](auto law) {
    using L = decltype(law);
    if (which.task == Task::forward) return run<double, L>(kernel, threads, a, step);
    run<gmem::GMEM_ISA::Dual<double>, L>(kernel, threads, a, step);
  });
}

}  // namespace cuda
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_emulated_advance, gmem::cuda::emulate<gmem::Task::forward>,
                              gmem::cuda::without_stream());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_emulated_tangent, gmem::cuda::emulate<gmem::Task::tangent>,
                              gmem::cuda::without_stream());
