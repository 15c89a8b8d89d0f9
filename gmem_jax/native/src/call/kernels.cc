// The instruction sets that the library was compiled for, and the best of them on this CPU.

#include <cstdlib>
#include <string>

#include "cpu/problem.h"

namespace gmem {

// gmem_jax/native/build.py: KERNELS
#define GMEM_DECLARE(name) \
  namespace name { extern const InstructionSet kernel; }
#if defined(__x86_64__)
GMEM_DECLARE(avx512)
GMEM_DECLARE(avx512_derivatives)
GMEM_DECLARE(avx2)
GMEM_DECLARE(avx2_derivatives)
GMEM_DECLARE(avx2_second_derivatives)
#endif
GMEM_DECLARE(baseline)
GMEM_DECLARE(baseline_derivatives)
GMEM_DECLARE(baseline_second_derivatives)

const InstructionSet& best_kernel(Task task, std::size_t replicas) {
  const auto of_task = [task](const InstructionSet& steps, const InstructionSet& derivatives,
                              const InstructionSet& second) -> const InstructionSet& {
    return task == Task::forward ? steps : task == Task::second_adjoint ? second : derivatives;
  };
  const char* wanted = std::getenv("GMEM_ISA");  // for tests: a lower instruction set than the best
  const std::string limit = wanted ? wanted : "";
#if defined(__x86_64__)
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
  const bool narrow = task != Task::forward && replicas <= static_cast<std::size_t>(avx2::kernel.width);
  if (avx512 && !narrow && limit != "avx2" && limit != "baseline")
    return of_task(avx512::kernel, avx512_derivatives::kernel, avx2_second_derivatives::kernel);
  if (avx2 && limit != "baseline")
    return of_task(avx2::kernel, avx2_derivatives::kernel, avx2_second_derivatives::kernel);
#endif
  return of_task(baseline::kernel, baseline_derivatives::kernel, baseline_second_derivatives::kernel);
}

}  // namespace gmem

// Name of the instruction set in use.
extern "C" const char* gmem_instruction_set() { return gmem::best_kernel(gmem::Task::forward, 1).name; }
