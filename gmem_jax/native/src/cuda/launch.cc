// The driver is opened while the program runs, so that the library loads where there is none.

#include "cuda/launch.h"

#include <dlfcn.h>

#include <array>
#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <tuple>

namespace gmem {
namespace cuda {

namespace {

using Handle = void*;  // the driver's contexts, modules, functions and streams
constexpr int kRelaxed = 2, kMajor = 75, kMinor = 76, kMostThreads = 0;  // of cuda.h

struct Loaded {
  Handle function;
  int block;  // threads that it was compiled for
};
using Kernels = std::array<Loaded, kKernels>;

struct Driver {
  int (*context_of)(Handle, Handle*);
  int (*push)(Handle);
  int (*pop)(Handle*);
  int (*device_of)(int*);
  int (*attribute)(int*, int, int);
  int (*load)(Handle*, const void*);
  int (*function)(Handle*, Handle, const char*);
  int (*needs)(int*, int, Handle);
  int (*launch)(Handle, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, Handle, void**, void**);
  int (*exchange_mode)(int*);
  int (*describe)(int, const char**);

  Driver() {
    void* library = dlopen("libcuda.so.1", RTLD_NOW);
    if (!library) throw std::runtime_error("libcuda.so.1 could not be loaded; is there a driver for the GPU?");
    find(library, "cuStreamGetCtx", context_of);
    find(library, "cuCtxPushCurrent_v2", push);
    find(library, "cuCtxPopCurrent_v2", pop);
    find(library, "cuCtxGetDevice", device_of);
    find(library, "cuDeviceGetAttribute", attribute);
    find(library, "cuModuleLoadData", load);
    find(library, "cuModuleGetFunction", function);
    find(library, "cuFuncGetAttribute", needs);
    find(library, "cuLaunchKernel", launch);
    find(library, "cuThreadExchangeStreamCaptureMode", exchange_mode);
    find(library, "cuGetErrorString", describe);
  }

  void must(int result, const char* what) const {
    const char* why = nullptr;
    if (result != 0 && (describe(result, &why) != 0 || !why)) why = "unknown";
    if (result != 0) throw std::runtime_error(std::string("the GPU's driver: ") + what + ": " + why);
  }
};

const Driver& driver() {
  static const Driver only;
  return only;
}

// The kernels in the current context; kept until the process ends.
const Kernels* kernels_of(Handle context, const Which& which) {
  static std::mutex mutex;
  static std::map<std::tuple<Handle, Law, Variant, Task, bool, bool, bool, std::string>, Kernels> known;
  const std::lock_guard<std::mutex> lock(mutex);
  const auto key = std::make_tuple(context, which.law, which.variant, which.task, which.periodic, which.unequal,
                                   which.rubs, trial_options());
  const auto found = known.find(key);
  if (found != known.end()) return &found->second;
  const Driver& d = driver();
  int device = 0, major = 0, minor = 0;
  d.must(d.device_of(&device), "which device");
  d.must(d.attribute(&major, kMajor, device), "which architecture");
  d.must(d.attribute(&minor, kMinor, device), "which architecture");
  const std::string architecture = "sm_" + std::to_string(major) + std::to_string(minor);
  Kernels kernels{};
  const auto load = [&](bool anew) {
    const std::string code = code_for(architecture, which, anew);
    // Where the call was not initialized, the stream may be in capture for a graph, to which loading must not belong.
    int mode = kRelaxed;
    d.must(d.exchange_mode(&mode), "mode of capture");
    Handle module = nullptr;
    int failed = d.load(&module, code.data());
    for (std::size_t i = 0; i < kernels.size() && failed == 0; ++i) {
      if (!is_kernel_of(which.task, static_cast<GpuKernel>(i))) continue;
      failed = d.function(&kernels[i].function, module, kKernelNames[i]);
      if (failed == 0) failed = d.needs(&kernels[i].block, kMostThreads, kernels[i].function);
    }
    d.exchange_mode(&mode);
    return failed;
  };
  // The file may be of another GPU, though its name says otherwise.
  if (load(false) != 0) d.must(load(true), "loading the kernels");
  return &known.emplace(key, kernels).first->second;
}

}  // namespace

Launcher::Launcher(void* stream, const Which& which) : stream_(stream) {
  const Driver& d = driver();
  Handle context = nullptr;
  d.must(d.context_of(stream, &context), "context of the stream");
  d.must(d.push(context), "context");
  try {
    kernels_ = kernels_of(context, which);
  } catch (...) {
    d.pop(&context);
    throw;
  }
}

Launcher::~Launcher() {
  Handle context = nullptr;
  driver().pop(&context);
}

void Launcher::operator()(GpuKernel kernel, int items, const Arguments& arguments, int step) const {
  if (items == 0) return;
  const Driver& d = driver();
  void* parameters[] = {const_cast<Arguments*>(&arguments), &step};
  const Loaded& found = (*static_cast<const Kernels*>(kernels_))[static_cast<std::size_t>(kernel)];
  const unsigned block = static_cast<unsigned>(found.block), each = kernel == GpuKernel::move ? kItems : block;
  const unsigned blocks = (static_cast<unsigned>(items) * static_cast<unsigned>(arguments.lanes) + each - 1) / each;
  d.must(d.launch(found.function, blocks, 1, 1, block, 1, 1, 0, stream_, parameters, nullptr), "launch");
}

}  // namespace cuda
}  // namespace gmem
