// Kernels put into a stream: by the driver of a GPU, or, in a test, by a loop on the CPU.

#pragma once

#include "cuda/arguments.h"
#include "cuda/compile.h"

namespace gmem {
namespace cuda {

class Launcher {
 public:
  // Throws std::runtime_error in one line.
  Launcher(void* stream, const Which& which);
  ~Launcher();
  Launcher(const Launcher&) = delete;

  // Launches a kernel for `items` items in every lane, with one thread for each, or kWorkers in `move`. Does not wait.
  void operator()(GpuKernel kernel, int items, const Arguments& arguments, int step = 0) const;

 private:
  void* stream_;
  const void* kernels_;
};

}  // namespace cuda
}  // namespace gmem
