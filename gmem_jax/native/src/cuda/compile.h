// The kernels are compiled for a kind of GPU by NVRTC, while the program runs. This needs no GPU, driver or nvcc.

#pragma once

#include <string>

#include "physics/parameters.h"

namespace gmem {
namespace cuda {

// Which kernels: of one law, in plain numbers or (for the tangent) in those that carry a derivative; or of reverse
// mode.
struct Which {
  Law law;
  Variant variant;
  Task task;
  bool periodic;  // whether the box may be periodic
  bool unequal;   // whether spheres may differ in radius
  bool rubs;      // whether walls have friction
};

// Further options for NVRTC, for trials: of the environment's GMEM_NVRTC, as "-DGMEM_BLOCK=256".
std::string trial_options();

// The code for an architecture, as "sm_90": a cubin, or text in PTX for the driver to compile where NVRTC does not know
// the architecture. Compiled once and then kept in a file; or `anew`, as always where `log` is given, to which what the
// assembler says of a cubin's registers and spills goes. Throws std::runtime_error in one line.
std::string code_for(const std::string& architecture, const Which& which, bool anew = false,
                     std::string* log = nullptr);

// A function of a library, by name.
void* symbol_of(void* library, const char* name);
template <class Function>
void find(void* library, const char* name, Function*& function) {
  function = reinterpret_cast<Function*>(symbol_of(library, name));
}

}  // namespace cuda
}  // namespace gmem
