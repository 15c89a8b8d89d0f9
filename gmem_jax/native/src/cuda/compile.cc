#include "cuda/compile.h"

#include <dlfcn.h>
#include <unistd.h>

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

using Program = void*;

// NVRTC, as far as it is used.
struct Nvrtc {
  int (*version)(int*, int*);
  int (*create)(Program*, const char*, const char*, int, const char* const*, const char* const*);
  int (*compile)(Program, int, const char* const*);
  int (*log_size)(Program, std::size_t*);
  int (*log)(Program, char*);
  int (*code_size)(Program, std::size_t*);
  int (*code)(Program, char*);
  int (*destroy)(Program*);

  Nvrtc() {
    void* library = open_library(paths().nvrtc, "pip install 'gmem-jax[cuda13]'");
    find(library, "nvrtcVersion", version);
    find(library, "nvrtcCreateProgram", create);
    find(library, "nvrtcCompileProgram", compile);
    find(library, "nvrtcGetProgramLogSize", log_size);
    find(library, "nvrtcGetProgramLog", log);
    find(library, "nvrtcGetCUBINSize", code_size);
    find(library, "nvrtcGetCUBIN", code);
    find(library, "nvrtcDestroyProgram", destroy);
  }
};

std::string contents(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
}

// A file that is there is whole. One that cannot be kept is compiled again next time.
void keep(const std::string& path, const std::string& code) {
  std::error_code unable;
  std::filesystem::create_directories(paths().cache, unable);
  const std::string unfinished = path + "." + std::to_string(getpid());
  std::ofstream file(unfinished, std::ios::binary);
  file.write(code.data(), static_cast<std::streamsize>(code.size()));
  file.close();
  if (!file || std::rename(unfinished.c_str(), path.c_str()) != 0) std::remove(unfinished.c_str());
}

std::string law_as_type(const Which& which) {
  return with_law(which.law, which.variant, [](auto law) { return std::string(decltype(law)::kType); });
}

std::string compiled(const Nvrtc& nvrtc, const std::string& architecture, const Which& which, std::string* log) {
  const std::string source = contents(paths().sources + "/cuda/kernel.cu");
  if (source.empty()) throw std::runtime_error("the sources of the GPU's kernels are not in " + paths().sources);
  std::vector<std::string> options = {
      "--gpu-architecture=" + architecture, "--std=c++17", "--device-as-default-execution-space",
      "--fmad=false",  // as on CPUs: a fused multiply-add is where the sources say so
      "-I" + paths().sources, "-DGMEM_ISA=gpu",
      "-DGMEM_LAW=" + law_as_type(which),
      "-DGMEM_PERIODIC=" + std::to_string(which.periodic),
      std::string("-DGMEM_NUMBER=") + (which.task == Task::forward ? "double" : "Dual<double>")};
  if (log) options.emplace_back("--ptxas-options=-v");
  std::istringstream more(trial_options());
  for (std::string option; more >> option;) options.push_back(option);
  std::vector<const char*> words;
  for (const std::string& option : options) words.push_back(option.c_str());
  Program program = nullptr;
  if (nvrtc.create(&program, source.c_str(), "kernel.cu", 0, nullptr, nullptr) != 0)
    throw std::runtime_error("NVRTC failed");
  const int failed = nvrtc.compile(program, static_cast<int>(words.size()), words.data());
  const auto text = [program](auto size_of, auto get) {
    std::size_t size = 0;
    size_of(program, &size);
    std::string found(size, '\0');
    get(program, &found[0]);
    return found;
  };
  const std::string said = text(nvrtc.log_size, nvrtc.log), code = failed ? "" : text(nvrtc.code_size, nvrtc.code);
  nvrtc.destroy(&program);
  if (log) *log = said;
  if (!failed) return code;
  const std::string first = said.substr(0, said.find('\n'));
  throw std::runtime_error("NVRTC does not compile the kernels for " + architecture + ": " + first);
}

}  // namespace

std::string trial_options() {
  const char* told = std::getenv("GMEM_NVRTC");
  return told ? told : "";
}

void* open_library(const std::string& names, const std::string& help) {
  std::istringstream each(names);
  for (std::string name; std::getline(each, name, ':');)
    if (void* library = dlopen(name.c_str(), RTLD_NOW)) return library;
  throw std::runtime_error(names.substr(0, names.find(':')) + " could not be loaded; " + help);
}

void* symbol_of(void* library, const char* name) {
  if (void* symbol = dlsym(library, name)) return symbol;
  throw std::runtime_error(std::string("the CUDA libraries here are too old: they have no ") + name);
}

std::string code_for(const std::string& architecture, const Which& which, std::string* log) {
  static std::mutex one_at_a_time;
  const std::lock_guard<std::mutex> lock(one_at_a_time);
  static const Nvrtc nvrtc;
  int major = 0, minor = 0;
  nvrtc.version(&major, &minor);
  const std::string compiler = "-nvrtc" + std::to_string(major) + "." + std::to_string(minor);
  const std::string law = "-law" + std::to_string(static_cast<int>(which.law)) +
                          std::to_string(static_cast<int>(which.variant)) +
                          (which.periodic ? "-periodic" : "") + (which.task == Task::forward ? "" : "-tangent");
  const std::string path = paths().cache + "/" + GMEM_SOURCE_HASH + "-" + architecture + compiler + law + ".cubin";
  const bool keeps = !paths().cache.empty() && trial_options().empty();
  std::string code = keeps && !log ? contents(path) : "";
  if (code.empty()) {
    code = compiled(nvrtc, architecture, which, log);
    if (keeps) keep(path, code);
  }
  return code;
}

}  // namespace cuda
}  // namespace gmem

// Where NVRTC (see `open_library`), the sources and the folder for compiled kernels are.
extern "C" void gmem_cuda_paths(const char* nvrtc, const char* sources, const char* cache) {
  gmem::cuda::paths() = {nvrtc, sources, cache};
}

// For a test: 0 if the kernels compile; what the assembler says of them, or why they do not, in `said`.
extern "C" int gmem_cuda_compile(const char* architecture, int law, int variant, int tangent, char* said, int size) {
  std::string log;
  int failed = 0;
  try {
    const auto task = tangent ? gmem::Task::tangent : gmem::Task::forward;
    gmem::cuda::code_for(architecture, {static_cast<gmem::Law>(law), static_cast<gmem::Variant>(variant), task, false}, &log);
  } catch (const std::exception& error) {
    log = error.what();
    failed = 1;
  }
  std::snprintf(said, static_cast<std::size_t>(size), "%s", log.c_str());
  return failed;
}
