// The arrays and numbers that the handlers of all platforms require of a call, and their errors.

#pragma once

#include <cstdint>
#include <exception>
#include <new>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "call/arguments.h"
#include "physics/parameters.h"

namespace gmem {

// Axes are edges of a periodic box by which an image is moved I (none, or three), sizes where spheres differ in radius
// U (none, or one), grains N, spheres of a grain K and of all S, candidates P, parameters R, steps T, numbers of the
// walls W, Mindlin's points Q, contacts of spheres with walls that have friction F, replicas B.
using Wants = std::vector<Wanted>;

inline Wants operator+(Wants one, const Wants& other) {
  one.insert(one.end(), other.begin(), other.end());
  return one;
}

inline Wants histories(Law law) {
  return with_law(law, Variant::exact, [](auto law) {
    Wants wants;
    for (const Leaf& leaf : decltype(law)::kLeaves)
      if (leaf.name) wants.push_back({leaf.name, leaf.axes});
    return wants;
  });
}

// Histories of spheres at walls with friction.
inline Wants wall_histories(Law law, bool rubs) {
  Wants wants = rubs ? histories(law) : Wants{};
  for (Wanted& wanted : wants) wanted.name = "walls' " + wanted.name, wanted.axes[0] = 'F';
  return wants;
}

inline bool is_layered(Law law) {
  return with_law(law, Variant::exact, [](auto law) { return decltype(law)::kLayered; });
}

inline Wants fields_of_grains() {
  return {{"positions", "N3B"}, {"quaternions", "N4B"},   {"velocities", "N3B"},
          {"spins", "N3B"},     {"accelerations", "N3B"}, {"spin rates", "N3B"}};
}
inline Wants numbers_of_steps() { return {{"parameters", "RB"}, {"walls", "TWB"}}; }
// The arrays by which steps are differentiated.
inline Wants arrays_of_steps(Law law) {
  return fields_of_grains() + numbers_of_steps() + Wants{{"offsets", "K3B"}} + histories(law);
}
inline Wants pressures() { return {{"pressures", "3B"}}; }

inline void require_law(int64_t law, int64_t variant, int64_t points) {
  require(0 <= law && law <= static_cast<int64_t>(Law::mindlin), "no friction law has number " + std::to_string(law));
  require(0 <= variant && variant <= static_cast<int64_t>(Variant::paper),
          "no variant of the Mindlin law has number " + std::to_string(variant));
  require(!is_layered(static_cast<Law>(law)) || points >= 2, "the Mindlin law needs two points or more");
}

inline void require_axes(int64_t periodic) {
  require(0 <= periodic && periodic < 8, "the periodic axes should be bits, one each");
}

// A binding with the arguments of a call: numbers by name, in the order of a handler's arguments, then arrays.
template <class Binding>
auto with_arguments(Binding&& binding) {
  return std::forward<Binding>(binding)
      .template Attr<int64_t>("law")
      .template Attr<int64_t>("variant")
      .template Attr<int64_t>("points")
      .template Attr<int64_t>("isotropic")
      .template Attr<int64_t>("leaves")
      .template Attr<int64_t>("mixed")
      .template Attr<int64_t>("periodic")
      .template Attr<int64_t>("unequal")
      .template Attr<int64_t>("rubs")
      .RemainingArgs()
      .RemainingRets();
}

// Returns the result of `call`, or its exception as an error of XLA.
template <class Call>
xla::ffi::Error in_words(const Call& call) {
  using xla::ffi::ErrorCode;
  const auto error = [](ErrorCode code, const char* what) {
    return xla::ffi::Error(code, std::string("gmem_jax native: ") + what);
  };
  try {
    return call();
  } catch (const std::invalid_argument& wrong) {
    return error(ErrorCode::kInvalidArgument, wrong.what());
  } catch (const std::bad_alloc&) {
    return error(ErrorCode::kResourceExhausted, "out of memory; use fewer replicas");
  } catch (const std::exception& other) {
    return error(ErrorCode::kInternal, other.what());
  }
}

}  // namespace gmem
