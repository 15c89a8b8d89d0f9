// The kernels compiled for a kind of GPU, by NVRTC while the program runs: no GPU, driver or nvcc is needed for it.

#pragma once

#include <string>

#include "physics/parameters.h"

namespace gmem {
namespace cuda {

// Which kernels: of one law, in plain numbers or (for the tangent) in those that carry a derivative.
struct Which {
  Law law;
  Variant variant;
  Task task;
  bool periodic;  // whether the box may be so
};

// Further options for NVRTC, for trials: of the environment's GMEM_NVRTC, as "-DGMEM_BLOCK=256".
std::string trial_options();

// The code for an architecture, as "sm_90"; compiled once and then kept in a file. Where `log` is given it is compiled
// anew, and what the assembler says of registers and spills goes there. Throws std::runtime_error in one line.
std::string code_for(const std::string& architecture, const Which& which, std::string* log = nullptr);

// Opens the first library that there is among paths and names joined by ":", or throws with what would help.
void* open_library(const std::string& names, const std::string& help);
// A function of it, by name.
void* symbol_of(void* library, const char* name);
template <class Function>
void find(void* library, const char* name, Function*& function) {
  function = reinterpret_cast<Function*>(symbol_of(library, name));
}

}  // namespace cuda
}  // namespace gmem
