// The tasks of a call, the contact laws as numbers and as types, and the rows of the array of parameters.

#pragma once

namespace gmem {

constexpr int kFields = 6;  // position, quaternion, velocity, spin, acceleration, spin rate
constexpr int kWalls = 12;  // lower, upper, lower velocity, upper velocity
constexpr int kMaxHistory = 3;
constexpr int kPlanes = 6;  // planes that a sphere may touch: the lower walls along x, y and z, then the upper ones

// What a call computes. `forward`: all steps. `tangent`: their derivative along a direction. `adjoint`: derivatives by
// all arguments, from those by all results. `second_adjoint`: the adjoint's derivative along a direction.
enum class Task { forward, tangent, adjoint, second_adjoint };

// In the order of
// gmem_jax/physics/contact/laws.py: LAWS
enum class Law { frictionless = 0, hooke = 1, mindlin_rescaled = 2, mindlin = 3 };
enum class Variant { exact = 0, averaged = 1, paper = 2 };

// Rows of the parameter array. The parameters of the law begin in row kLaw; gravity follows them.
// gmem_jax/native/march.py: _parameters
enum Parameter { kDt, kDrag, kMass, kInertia, kNormalStiffness = kInertia + 3, kNormalDamping, kWallStiffness, kLaw };
constexpr int kLawParameters = 5;  // mu, stiffness, damping time, spinning, spacing of Mindlin's points
constexpr int kGravity = kLaw + kLawParameters, kParameters = kGravity + 1;
// Then the lower and upper edges of the box before the first step, which a periodic box needs to carry its grains
// along; and the friction coefficient of the walls.
constexpr int kCell = kParameters, kWallMu = kCell + 6, kRows = kWallMu + 1;
constexpr int kSpinning = kLaw + 3;

// Places in a history: of the overlap of the last step, in laws that remember it, and of Mindlin's `Layers`.
constexpr int kLastOverlap = 3, kLayers = 4;

// One array of a history in a call: its name and its axes (see call/signature.h).
struct Leaf {
  const char *name, *axes;
};

// The laws as types. `kType` is the name of the type, for the compiler of a GPU's kernels. `kLeaves` are the arrays of
// the history; entries without a name are not used.
struct Frictionless {
  static constexpr const char* kType = "Frictionless";
  static constexpr Leaf kLeaves[kMaxHistory] = {};
  static constexpr int kHistory = 0;  // numbers remembered of a contact from step to step, without Mindlin's segments
  static constexpr int kGiven = 0;    // how many of these, the first ones, are in the arrays of a call
  static constexpr int kVectors = 0;  // how many of those, the first ones, are components of a vector
  static constexpr bool kLayered = false;
};

struct Hooke {
  static constexpr const char* kType = "Hooke";
  static constexpr Leaf kLeaves[kMaxHistory] = {{"forces", "P3B"}};
  static constexpr int kHistory = 3;
  static constexpr int kGiven = 3;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = false;
};

struct Rescaled {
  static constexpr const char* kType = "Rescaled";
  static constexpr Leaf kLeaves[kMaxHistory] = {{"forces", "P3B"}, {"overlaps", "P1B"}};
  static constexpr int kHistory = 4;  // force, overlap
  static constexpr int kGiven = 4;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = false;
};

template <Variant variant_>
struct Layered {
  static constexpr const char* kType = variant_ == Variant::averaged ? "Layered<Variant::averaged>"
                                       : variant_ == Variant::paper  ? "Layered<Variant::paper>"
                                                                     : "Layered<Variant::exact>";
  static constexpr Leaf kLeaves[kMaxHistory] = {{"layers", "PQ2B"}, {"frames", "P3B"}, {"overlaps", "P1B"}};
  static constexpr int kHistory = 10;  // frame, overlap, `Layers`; the segments are kept elsewhere
  static constexpr int kGiven = 4;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = true;
  static constexpr Variant variant = variant_;
};

// Calls `function` with a law as a type: the one place where a number becomes a law, on every platform.
template <class Function>
auto with_law(Law law, Variant variant, const Function& function) {
  switch (law) {
    case Law::hooke: return function(Hooke{});
    case Law::mindlin_rescaled: return function(Rescaled{});
    case Law::mindlin:
      switch (variant) {
        case Variant::averaged: return function(Layered<Variant::averaged>{});
        case Variant::paper: return function(Layered<Variant::paper>{});
        default: return function(Layered<Variant::exact>{});
      }
    default: return function(Frictionless{});
  }
}

}  // namespace gmem
