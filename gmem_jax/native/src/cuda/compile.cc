#include "cuda/compile.h"

#include <dlfcn.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <vector>

namespace gmem {
namespace cuda {

namespace {

// Where things lie, as Python says.
struct Paths {
  std::string nvrtc, sources, cache;
};

Paths& paths() {
  static Paths known;
  return known;
}

constexpr const char* kHelp = "; pip install 'gmem-jax[cuda13]' (or [cuda12] for drivers of CUDA 12)";

std::string dotted(int version) { return std::to_string(version / 1000) + "." + std::to_string(version % 1000 / 10); }

// The newest CUDA that the GPU's driver knows, as 13020 for 13.2; 0 where there is no driver.
int cuda_of_driver() {
  int version = 0;
  void* library = dlopen("libcuda.so.1", RTLD_NOW);
  const auto ask = reinterpret_cast<int (*)(int*)>(library ? dlsym(library, "cuDriverGetVersion") : nullptr);
  return ask && ask(&version) == 0 ? version : 0;
}

using Program = void*;

// The functions of NVRTC that are used, of the first NVRTC found whose cubins the driver loads.
struct Nvrtc {
  int (*create)(Program*, const char*, const char*, int, const char* const*, const char* const*);
  int (*compile)(Program, int, const char* const*);
  int (*log_size)(Program, std::size_t*);
  int (*log)(Program, char*);
  int (*cubin_size)(Program, std::size_t*);
  int (*cubin)(Program, char*);
  int (*ptx_size)(Program, std::size_t*);
  int (*ptx)(Program, char*);
  int (*destroy)(Program*);
  int version = 0;  // as 13050 for 13.5
  std::vector<int> architectures;

  Nvrtc() {
    void* library = open();
    find(library, "nvrtcCreateProgram", create);
    find(library, "nvrtcCompileProgram", compile);
    find(library, "nvrtcGetProgramLogSize", log_size);
    find(library, "nvrtcGetProgramLog", log);
    find(library, "nvrtcGetCUBINSize", cubin_size);
    find(library, "nvrtcGetCUBIN", cubin);
    find(library, "nvrtcGetPTXSize", ptx_size);
    find(library, "nvrtcGetPTX", ptx);
    find(library, "nvrtcDestroyProgram", destroy);
    int (*number)(int*), (*get)(int*), many = 0;
    find(library, "nvrtcGetNumSupportedArchs", number);
    find(library, "nvrtcGetSupportedArchs", get);
    number(&many);
    architectures.resize(static_cast<std::size_t>(many));
    get(architectures.data());
  }

 private:
  void* open() {
    const int driver = cuda_of_driver();
    std::string why = paths().nvrtc.substr(0, paths().nvrtc.find(':')) + " could not be loaded";
    std::istringstream each(paths().nvrtc);
    for (std::string name; std::getline(each, name, ':');) {
      void* library = dlopen(name.c_str(), RTLD_NOW);
      if (!library) continue;
      int (*ask)(int*, int*), major = 0, minor = 0;
      find(library, "nvrtcVersion", ask);
      ask(&major, &minor);
      version = 1000 * major + 10 * minor;
      if (driver == 0 || major <= driver / 1000) return library;
      why = "NVRTC " + dotted(version) + " is too new for the GPU's driver, which is of CUDA " + dotted(driver);
    }
    throw std::runtime_error(why + kHelp);
  }
};

const Nvrtc& nvrtc() {
  static const Nvrtc only;
  return only;
}

// The target for which NVRTC compiles so that `architecture` can run the code: `architecture` itself, or, where NVRTC
// does not know it, the newest older one, as "compute_90", whose PTX the driver compiles. Throws where there is none,
// or where the driver is too old for the PTX.
std::string target_for(const std::string& architecture) {
  const int wanted = std::atoi(architecture.substr(architecture.find('_') + 1).c_str());
  int older = 0;
  for (const int known : nvrtc().architectures) {
    if (known == wanted) return architecture;
    if (known < wanted) older = std::max(older, known);
  }
  const std::string here = "NVRTC " + dotted(nvrtc().version);
  if (older == 0) throw std::runtime_error(here + " knows no GPU as old as " + architecture + kHelp);
  const int driver = cuda_of_driver();
  if (driver != 0 && driver < nvrtc().version)
    throw std::runtime_error(here + " does not know " + architecture + ", and the GPU's driver, of CUDA " +
                             dotted(driver) + ", is too old for its PTX" + kHelp);
  return "compute_" + std::to_string(older);
}

bool is_ptx(const std::string& target) { return target.rfind("compute_", 0) == 0; }

std::string contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

// The end of a file, by which one that was cut short or changed is known: FNV-1a in 16 digits.
std::string checksum(const std::string& code) {
  std::uint64_t sum = 14695981039346656037u;
  for (const char byte : code) sum = (sum ^ static_cast<unsigned char>(byte)) * 1099511628211u;
  char digits[17];
  std::snprintf(digits, sizeof digits, "%016llx", static_cast<unsigned long long>(sum));
  return digits;
}

// The code in a file; "" where there is none, or it is not whole.
std::string kept(const std::string& path) {
  const std::string file = contents(path);
  const std::string code = file.substr(0, file.size() < 16 ? 0 : file.size() - 16);
  return code + checksum(code) == file ? code : "";
}

// Keeps code in a file. Several processes may do so at once. Code that cannot be kept is compiled again next time.
void keep(const std::string& path, const std::string& code) {
  std::error_code unable;
  std::filesystem::create_directories(paths().cache, unable);
  std::string unfinished = path + ".XXXXXX";
  const int file = mkstemp(&unfinished[0]);
  if (file < 0) return;
  const std::string all = code + checksum(code);
  const bool whole = write(file, all.data(), all.size()) == static_cast<ssize_t>(all.size());
  const bool readable = fchmod(file, S_IRUSR | S_IWUSR | S_IRGRP | S_IROTH) == 0;  // by all who share the folder
  const bool closed = close(file) == 0;
  if (!whole || !readable || !closed || std::rename(unfinished.c_str(), path.c_str()) != 0)
    std::remove(unfinished.c_str());
}

std::string law_as_type(const Which& which) {
  return with_law(which.law, which.variant, [](auto law) { return std::string(decltype(law)::kType); });
}

std::string compiled(const std::string& target, const Which& which, std::string* log) {
  const std::string source = contents(paths().sources + "/cuda/kernel.cu");
  if (source.empty()) throw std::runtime_error("the sources of the GPU's kernels are not in " + paths().sources);
  std::vector<std::string> options = {
      "--gpu-architecture=" + target,
      "--std=c++17",
      "--device-as-default-execution-space",
      "--generate-line-info",
      "--fmad=false",  // as on CPUs: a fused multiply-add is where the sources say so
      "-I" + paths().sources,
      "-DGMEM_ISA=gpu",
      "-DGMEM_LAW=" + law_as_type(which),
      "-DGMEM_PERIODIC=" + std::to_string(which.periodic),
      "-DGMEM_UNEQUAL=" + std::to_string(which.unequal),
      "-DGMEM_RUBS=" + std::to_string(which.rubs),
      std::string("-DGMEM_NUMBER=") + (which.task == Task::tangent ? "Dual<double>" : "double"),
      std::string("-DGMEM_BACK=") + (which.task == Task::adjoint ? "1" : "0")};
  if (log) options.emplace_back("--ptxas-options=-v");
  std::istringstream more(trial_options());
  for (std::string option; more >> option;) options.push_back(option);
  std::vector<const char*> words;
  for (const std::string& option : options) words.push_back(option.c_str());
  Program program = nullptr;
  const Nvrtc& n = nvrtc();
  if (n.create(&program, source.c_str(), "kernel.cu", 0, nullptr, nullptr) != 0)
    throw std::runtime_error("NVRTC failed");
  const int failed = n.compile(program, static_cast<int>(words.size()), words.data());
  const auto text = [program](auto size_of, auto get) {
    std::size_t size = 0;
    size_of(program, &size);
    std::string found(size, '\0');
    get(program, &found[0]);
    return found;
  };
  const std::string said = text(n.log_size, n.log);
  const std::string code = failed ? "" : is_ptx(target) ? text(n.ptx_size, n.ptx) : text(n.cubin_size, n.cubin);
  n.destroy(&program);
  if (log) *log = said;
  if (!failed) return code;
  const std::string first = said.substr(0, said.find('\n'));
  throw std::runtime_error("NVRTC does not compile the kernels for " + target + ": " + first);
}

// Copies the text of `say` to `said` and returns 0; if `say` throws, copies the exception's text and returns 1.
template <class Say>
int in_one_line(char* said, int size, const Say& say) {
  std::string text;
  int failed = 0;
  try {
    text = say();
  } catch (const std::exception& error) {
    failed = 1, text = error.what();
  }
  std::snprintf(said, static_cast<std::size_t>(size), "%s", text.c_str());
  return failed;
}

}  // namespace

std::string trial_options() {
  const char* told = std::getenv("GMEM_NVRTC");
  return told ? told : "";
}

void* symbol_of(void* library, const char* name) {
  if (void* symbol = dlsym(library, name)) return symbol;
  throw std::runtime_error(std::string("the CUDA libraries here are too old: they have no ") + name);
}

std::string code_for(const std::string& architecture, const Which& which, bool anew, std::string* log) {
  static std::mutex one_at_a_time;
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  const std::string target = target_for(architecture), version = dotted(nvrtc().version);
  if (log && is_ptx(target)) throw std::runtime_error("NVRTC " + version + " does not know " + architecture);
  const std::string law = "-law" + std::to_string(static_cast<int>(which.law)) +
                          std::to_string(static_cast<int>(which.variant)) + (which.periodic ? "-periodic" : "") +
                          (which.unequal ? "-unequal" : "") + (which.rubs ? "-rubs" : "") +
                          (which.task == Task::forward   ? ""
                           : which.task == Task::tangent ? "-tangent"
                                                         : "-adjoint");
  const std::string path = paths().cache + "/" + GMEM_SOURCE_HASH + "-" + target + "-nvrtc" + version + law +
                           (is_ptx(target) ? ".ptx" : ".cubin");
  const bool keeps = !paths().cache.empty() && trial_options().empty();
  std::string code = keeps && !anew && !log ? kept(path) : "";
  if (code.empty()) {
    code = compiled(target, which, log);
    if (keeps) keep(path, code);
  }
  return code;
}

}  // namespace cuda
}  // namespace gmem

// Where NVRTC (paths and names joined by ":"), the sources and the folder for compiled kernels are.
extern "C" void gmem_cuda_paths(const char* nvrtc, const char* sources, const char* cache) {
  gmem::cuda::paths() = {nvrtc, sources, cache};
}

// 0 if kernels can be made for an architecture, or for any ("") where it is not known; or why not, in `said`.
extern "C" int gmem_cuda_missing(const char* architecture, char* said, int size) {
  return gmem::cuda::in_one_line(said, size, [&] {
    if (*architecture) {
      gmem::cuda::target_for(architecture);
    } else {
      gmem::cuda::nvrtc();
    }
    return std::string();
  });
}

// For a test: 0 if the kernels of a `gmem::Task` compile; what the assembler says of them, or why they do not, in
// `said`.
extern "C" int gmem_cuda_compile(const char* architecture, int law, int variant, int task, char* said, int size) {
  return gmem::cuda::in_one_line(said, size, [&] {
    std::string log;
    const gmem::cuda::Which which{static_cast<gmem::Law>(law),
                                  static_cast<gmem::Variant>(variant),
                                  static_cast<gmem::Task>(task),
                                  false,
                                  false,
                                  false};
    gmem::cuda::code_for(architecture, which, true, &log);
    return log;
  });
}
