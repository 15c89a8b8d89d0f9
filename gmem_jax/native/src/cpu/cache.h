// The caches of this machine.

#pragma once

#include <cstddef>

namespace gmem {

// Bytes of the largest caches that the CPUs of this process may call their own: each its part of one that it shares
// with others. GMEM_CACHE, in MB, takes their place. Throws std::invalid_argument if that is no size.
std::size_t cache_bytes();

}  // namespace gmem
