#include "cpu/cache.h"

#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>

#include "cpu/team.h"

#if defined(__linux__)
#include <sched.h>
#endif

namespace gmem {

namespace {

constexpr double kUnknown = 2.0 * (1 << 20);  // of a CPU that does not say

// Number of CPUs in a list such as "0-3,8-11".
int listed(const std::string& list) {
  int count = 0;
  for (const char* at = list.c_str(); *at;) {
    char* end = nullptr;
    const long first = std::strtol(at, &end, 10);
    if (end == at) break;
    const long last = *end == '-' ? std::strtol(end + 1, &end, 10) : first;
    count += static_cast<int>(last - first) + 1;
    at = *end == ',' ? end + 1 : end;
  }
  return count;
}

// A CPU's part of the largest cache that it has.
double share_of([[maybe_unused]] int cpu) {
  double largest = 0.0, share = kUnknown;
#if defined(__linux__)
  for (int index = 0; index < 8; ++index) {
    const std::string folder =
        "/sys/devices/system/cpu/cpu" + std::to_string(cpu) + "/cache/index" + std::to_string(index) + "/";
    std::ifstream sizes(folder + "size"), lists(folder + "shared_cpu_list");
    double size = 0.0;
    char unit = 0;
    std::string list;
    if (!(sizes >> size >> unit) || !(lists >> list)) break;
    size *= unit == 'K' ? 1 << 10 : unit == 'M' ? 1 << 20 : 1;
    if (size > largest && listed(list) > 0) largest = size, share = size / listed(list);
  }
#endif
  return share;
}

std::size_t find() {
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof set, &set) == 0) {
    double total = 0.0;
    for (int cpu = 0; cpu < CPU_SETSIZE; ++cpu)
      if (CPU_ISSET(cpu, &set)) total += share_of(cpu);
    return static_cast<std::size_t>(total);
  }
#endif
  return static_cast<std::size_t>(kUnknown * thread_count());
}

}  // namespace

std::size_t cache_bytes() {
  static const std::size_t found = find();
  const char* text = std::getenv("GMEM_CACHE");
  if (!text || !*text) return found;
  char* end = nullptr;
  const double wanted = std::strtod(text, &end);
  if (*end || !(wanted > 0.0 && wanted < 1e9))
    throw std::invalid_argument("GMEM_CACHE should be a number of megabytes; it is \"" + std::string(text) + '"');
  return static_cast<std::size_t>(wanted * 1e6);
}

}  // namespace gmem
