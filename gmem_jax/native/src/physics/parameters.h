// What a call is asked to do, the contact laws by name and by type, and the rows in which their parameters come.

#pragma once

namespace gmem {

constexpr int kFields = 6;  // position, quaternion, velocity, spin, acceleration, spin rate
constexpr int kWalls = 12;  // lower, upper, lower velocity, upper velocity
constexpr int kMaxHistory = 3;

// What is wanted: all steps; their derivative along a direction; or, back from derivatives by all results, those by all
// arguments.
enum class Task { forward, tangent, adjoint };

// In the order of
// gmem_jax/physics/contact/laws.py: LAWS
enum class Law { frictionless = 0, hooke = 1, mindlin_rescaled = 2, mindlin = 3 };
enum class Variant { exact = 0, averaged = 1, paper = 2 };

// Rows of the parameter array; a law's own follow.
// gmem_jax/native/__init__.py: _parameters
enum Parameter { kDt, kDrag, kMass, kInertia, kNormalStiffness = kInertia + 3, kNormalDamping, kWallStiffness, kLaw };
constexpr int kLawParameters = 5;  // mu, stiffness, damping time, spinning, spacing of Mindlin's points
constexpr int kParameters = kLaw + kLawParameters;
constexpr int kSpinning = kLaw + 3;

// Where a history has the overlap of the last step, if it has it; and Mindlin's `Layers`.
constexpr int kLastOverlap = 3, kLayers = 4;

// The laws as types.
struct Frictionless {
  static constexpr int kHistory = 0;  // numbers remembered of a contact from step to step, beside Mindlin's layers
  static constexpr int kGiven = 0;    // those of them, the first, that come and go in the arrays of a call
  static constexpr int kVectors = 0;  // those of these that are components of a vector
  static constexpr bool kLayered = false;
};

struct Hooke {
  static constexpr int kHistory = 3;
  static constexpr int kGiven = 3;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = false;
};

struct Rescaled {
  static constexpr int kHistory = 4;  // force, overlap
  static constexpr int kGiven = 4;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = false;
};

template <Variant variant_>
struct Layered {
  static constexpr int kHistory = 10;  // frame, overlap, `Layers`; the rings inside are kept apart
  static constexpr int kGiven = 4;
  static constexpr int kVectors = 3;
  static constexpr bool kLayered = true;
  static constexpr Variant variant = variant_;
};

}  // namespace gmem
