// The motion of grains and their contacts with the walls.

#pragma once

#include "physics/laws.h"
#include "physics/rotation.h"

namespace gmem {
namespace GMEM_ISA {

template <class V>
struct WallState {
  Vec<V> lower, upper, lower_velocity, upper_velocity;
};

// A grain at the beginning of a step.
template <class V>
struct Grain {
  Vec<V> position;
  Quaternion<V> orientation;
  Vec<V> velocity, spin, acceleration, spin_rate;
};

// ... with position and orientation at its end, and velocities of its middle.
template <class V>
struct HalfStep {
  Vec<V> position;
  Quaternion<V> orientation;
  Vec<V> velocity, spin;
};

// A grain's constants, of the parameter array.
template <class V>
struct GrainParameters {
  V dt, half_dt, drag, slowed, inertia[3], inverse_mass, inverse_inertia[3], wall_stiffness, normal_damping;

  GrainParameters() = default;

  constexpr explicit GrainParameters(const V* parameter)
      : dt(parameter[kDt]), half_dt(splat<V>(0.5) * dt), drag(parameter[kDrag]),
        slowed(splat<V>(1.0) / fma(half_dt, drag, splat<V>(1.0))), inverse_mass(splat<V>(1.0) / parameter[kMass]), wall_stiffness(parameter[kWallStiffness]),
        normal_damping(parameter[kNormalDamping]) {
    for (int axis = 0; axis < 3; ++axis) {
      inertia[axis] = parameter[kInertia + axis];
      inverse_inertia[axis] = splat<V>(1.0) / inertia[axis];
    }
  }
};

// First half of a step.
// gmem_jax/physics/step.py: step (up to the forces)
template <class V>
constexpr GMEM_INLINE HalfStep<V> begin_step(const GrainParameters<V>& p, const Grain<V>& g) {
  const Vec<V> velocity = fma(p.half_dt, g.acceleration, g.velocity), spin = fma(p.half_dt, g.spin_rate, g.spin);
  return {fma(p.dt, velocity, g.position), turn(g.orientation, p.dt * spin), velocity, spin};
}

// gmem_jax/physics/step.py: _angular_acceleration
template <class V>
constexpr Vec<V> angular_acceleration(const GrainParameters<V>& p, bool isotropic, Quaternion<V> orientation,
                                      Vec<V> spin, Vec<V> torque) {
  if (isotropic) return p.inverse_inertia[0] * torque;
  const Matrix<V> rotation = matrix(orientation);
  const Vec<V> body_spin = transposed(rotation, spin);
  const Vec<V> body_torque = transposed(rotation, torque);
  const auto rate = [&](Vec<V> spin) {
    const Vec<V> left = body_torque - cross(spin, {p.inertia[0] * spin.x, p.inertia[1] * spin.y, p.inertia[2] * spin.z});
    return Vec<V>{p.inverse_inertia[0] * left.x, p.inverse_inertia[1] * left.y, p.inverse_inertia[2] * left.z};
  };
  return rotation * rate(fma(p.half_dt, rate(body_spin), body_spin));
}

// Second half: accelerations and velocities; position and orientation stay.
// gmem_jax/physics/step.py: step (from the forces on)
template <class V>
constexpr GMEM_INLINE Grain<V> end_step(const GrainParameters<V>& p, bool isotropic, const HalfStep<V>& m, Vec<V> force,
                                        Vec<V> torque) {
  const Vec<V> acceleration = p.slowed * fnma(p.drag, m.velocity, p.inverse_mass * force);
  const Vec<V> spin_rate =
      p.slowed * fnma(p.drag, m.spin, angular_acceleration(p, isotropic, m.orientation, m.spin, torque));
  return {m.position,   m.orientation, fma(p.half_dt, acceleration, m.velocity), fma(p.half_dt, spin_rate, m.spin),
          acceleration, spin_rate};
}

template <class V>
struct WallForces {
  Vec<V> force, torque;  // on a grain
  Vec<V> lower, upper;   // on the walls, as magnitudes
};

// Largest overlap with any wall of a sphere of radius `reach` around `centre`.
template <class V>
constexpr V deepest(V reach, Vec<V> centre, const WallState<V>& box) {
  const Vec<V> all{reach, reach, reach};
  const Vec<V> lower = all - (centre - box.lower), upper = all - (box.upper - centre);
  return max(max(max(lower.x, upper.x), max(lower.y, upper.y)), max(lower.z, upper.z));
}

// gmem_jax/physics/contact/wall.py: wall_forces
template <class V>
constexpr Vec<V> wall_force(const GrainParameters<V>& parameters, Vec<V> overlap, Vec<V> closing) {
  const auto axis = [&](V p, V c) {
    const Mask<V> touching = p > V{};
    if (!bits_less(V{}, p)) return V{};
    const V safe = select(touching, p, splat<V>(1.0));
    return hertz(touching, safe, root(safe), c, parameters.wall_stiffness, parameters.normal_damping);
  };
  return {axis(overlap.x, closing.x), axis(overlap.y, closing.y), axis(overlap.z, closing.z)};
}

// Adds to `on` the forces of the walls on one sphere of a grain.
// gmem_jax/physics/step.py: _forces
template <class V>
constexpr void touch_walls(const GrainParameters<V>& p, Vec<V> centre, Vec<V> lever, Vec<V> velocity,
                        const WallState<V>& box, WallForces<V>& on) {
  const Vec<V> one{splat<V>(1.0), splat<V>(1.0), splat<V>(1.0)};
  if (!bits_less(V{}, deepest(one.x, centre, box))) return;
  const Vec<V> lower = one - (centre - box.lower), upper = one - (box.upper - centre);
  const Vec<V> low = wall_force(p, lower, box.lower_velocity - velocity);
  const Vec<V> up = wall_force(p, upper, velocity - box.upper_velocity);
  on.lower = on.lower + low;
  on.upper = on.upper + up;
  on.force = on.force + (low - up);
  on.torque = add_cross(on.torque, lever, low - up);
}

// The centre of a sphere of a grain, and what the walls do to it if they are near.
template <class V>
constexpr GMEM_INLINE Vec<V> sphere_of(const GrainParameters<V>& p, const HalfStep<V>& m, const Matrix<V>& rotation,
                                       Vec<V> body, bool near, const WallState<V>& box, WallForces<V>& on) {
  const Vec<V> lever = rotation * body, centre = m.position + lever;
  if (near) touch_walls(p, centre, lever, add_cross(m.velocity, m.spin, lever), box, on);
  return centre;
}

// Finds the spheres of a grain, handed to `put(k, centre)`, and what the walls do to them; whether they are near them.
// gmem_jax/physics/step.py: sphere_table
template <class V, class Put>
GMEM_INLINE bool spheres_of(const GrainParameters<V>& p, const HalfStep<V>& m, const double* offsets, int spheres,
                            double arm, const WallState<V>& box, WallForces<V>& on, const Put& put) {
  const Matrix<V> rotation = matrix(m.orientation);
  const bool near = bits_less(V{}, deepest(splat<V>(1.0 + arm), m.position, box)) != 0;
  for (int k = 0; k < spheres; ++k) {
    const double* body = offsets + 3 * k;
    put(k, sphere_of(p, m, rotation, {splat<V>(body[0]), splat<V>(body[1]), splat<V>(body[2])}, near, box, on));
  }
  return near;
}

// p of each axis from the sum of the forces on its two walls: (F_lower + F_upper) / (2 A).
// gmem_jax/physics/step.py: wall_pressure
template <class V>
constexpr Vec<V> pressure(const WallState<V>& box, Vec<V> force) {
  const Vec<V> lengths = box.upper - box.lower;
  const V two = splat<V>(2.0);
  return {force.x / (two * (lengths.y * lengths.z)), force.y / (two * (lengths.x * lengths.z)),
          force.z / (two * (lengths.x * lengths.y))};
}

}  // namespace GMEM_ISA
}  // namespace gmem
