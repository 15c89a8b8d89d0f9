// Memory that outlives a call, so that the next one does not fault its pages in again.

#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>

namespace gmem {

struct Scratch {
  struct Free {
    void operator()(char* memory) const { std::free(memory); }
  };
  std::unique_ptr<char, Free> memory;
  std::size_t bytes = 0;
  void* aligned() const { return memory.get(); }  // to 64 bytes
};

// At least so many bytes, with any contents. Throws std::bad_alloc.
Scratch take_scratch(std::size_t bytes);
void give_scratch(Scratch piece);

}  // namespace gmem
