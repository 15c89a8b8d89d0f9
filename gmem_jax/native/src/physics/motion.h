// The motion of grains and their contacts with the walls.

#pragma once

#include "physics/contact.h"
#include "physics/rotation.h"

namespace gmem {
namespace GMEM_ISA {

template <class V>
struct WallState {
  Vec<V> lower, upper, lower_velocity, upper_velocity;
};

// A box that is periodic along the axes whose bits are set in `periodic`. Along the others `rate` and `lower` are 0,
// and `lengths` are 1.
// gmem_jax/physics/step.py: _carried
// gmem_jax/physics/forces.py: strain_rate
template <class V>
struct Cell {
  Vec<V> lower, lengths, rate;

  static constexpr Cell of(int periodic, const WallState<V>& w) {
    const auto axis = [&](int bit, V lower, V upper, V slow, V fast, V& from, V& length, V& rate) {
      const bool is = periodic >> bit & 1;
      from = is ? lower : V{}, length = is ? upper - lower : splat<V>(1.0), rate = is ? (fast - slow) / length : V{};
    };
    Cell c{};
    axis(0, w.lower.x, w.upper.x, w.lower_velocity.x, w.upper_velocity.x, c.lower.x, c.lengths.x, c.rate.x);
    axis(1, w.lower.y, w.upper.y, w.lower_velocity.y, w.upper_velocity.y, c.lower.y, c.lengths.y, c.rate.y);
    axis(2, w.lower.z, w.upper.z, w.lower_velocity.z, w.upper_velocity.z, c.lower.z, c.lengths.z, c.rate.z);
    return c;
  }

  // The vector from a place to its image, which is `image` edges away.
  constexpr Vec<V> shift(Vec<V> image) const { return {image.x * lengths.x, image.y * lengths.y, image.z * lengths.z}; }
  constexpr Vec<V> shift(double x, double y, double z) const { return shift({splat<V>(x), splat<V>(y), splat<V>(z)}); }
  constexpr Vec<V> flow(Vec<V> apart) const { return {rate.x * apart.x, rate.y * apart.y, rate.z * apart.z}; }
};

// The walls, with those of periodic axes so far away that nothing touches them.
template <class V>
constexpr WallState<V> without(int periodic, WallState<V> w) {
  const V far = splat<V>(1e300);
  if (periodic & 1) w.lower.x = -far, w.upper.x = far;
  if (periodic & 2) w.lower.y = -far, w.upper.y = far;
  if (periodic & 4) w.lower.z = -far, w.upper.z = far;
  return w;
}

// A grain at the beginning of a step.
template <class V>
struct Grain {
  Vec<V> position;
  Quaternion<V> orientation;
  Vec<V> velocity, spin, acceleration, spin_rate;
};

// A grain midway in a step: position and orientation at the end of the step, velocity and spin in its middle.
template <class V>
struct HalfStep {
  Vec<V> position;
  Quaternion<V> orientation;
  Vec<V> velocity, spin;
};

// A grain's constants, from the parameter array.
template <class V>
struct GrainParameters {
  V dt, half_dt, drag, slowed, inertia[3], inverse_mass, inverse_inertia[3], wall_stiffness, normal_damping, gravity;

  GrainParameters() = default;

  constexpr explicit GrainParameters(const V* parameter)
      : dt(parameter[kDt]), half_dt(splat<V>(0.5) * dt), drag(parameter[kDrag]),
        slowed(splat<V>(1.0) / fma(half_dt, drag, splat<V>(1.0))), inverse_mass(splat<V>(1.0) / parameter[kMass]),
        wall_stiffness(parameter[kWallStiffness]), normal_damping(parameter[kNormalDamping]),
        gravity(parameter[kGravity]) {
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

// The same in a periodic box that goes from `before` to `cell`, and carries its grains along. Velocities are relative
// to the box.
template <class V>
constexpr GMEM_INLINE HalfStep<V> begin_step(const GrainParameters<V>& p, const Grain<V>& g, const Cell<V>& before,
                                             const Cell<V>& cell) {
  HalfStep<V> m = begin_step(p, g);
  const auto carried = [&](V at, V from, V old, V to, V now, V velocity) {
    const V stretch = now / old, half = splat<V>(0.5) * (splat<V>(1.0) + stretch);
    return to + stretch * (at - from) + half * (p.dt * velocity);
  };
  m.position = {carried(g.position.x, before.lower.x, before.lengths.x, cell.lower.x, cell.lengths.x, m.velocity.x),
                carried(g.position.y, before.lower.y, before.lengths.y, cell.lower.y, cell.lengths.y, m.velocity.y),
                carried(g.position.z, before.lower.z, before.lengths.z, cell.lower.z, cell.lengths.z, m.velocity.z)};
  return m;
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
    const Vec<V> left =
        body_torque - cross(spin, {p.inertia[0] * spin.x, p.inertia[1] * spin.y, p.inertia[2] * spin.z});
    return Vec<V>{p.inverse_inertia[0] * left.x, p.inverse_inertia[1] * left.y, p.inverse_inertia[2] * left.z};
  };
  return rotation * rate(fma(p.half_dt, rate(body_spin), body_spin));
}

// Second half: accelerations and velocities; position and orientation stay. For a grain of another size than 1 the
// caller divides the force by the third power of the size, and the torque by the fifth.
// gmem_jax/physics/grain.py: Clump.scaled
// gmem_jax/physics/step.py: step (from the forces on)
template <class V>
constexpr GMEM_INLINE Grain<V> end_step(const GrainParameters<V>& p, bool isotropic, const HalfStep<V>& m, Vec<V> force,
                                        Vec<V> torque) {
  Vec<V> pull = fnma(p.drag, m.velocity, p.inverse_mass * force);
  pull.z = pull.z - p.gravity;
  const Vec<V> acceleration = p.slowed * pull;
  const Vec<V> spin_rate =
      p.slowed * fnma(p.drag, m.spin, angular_acceleration(p, isotropic, m.orientation, m.spin, torque));
  return {m.position,   m.orientation, fma(p.half_dt, acceleration, m.velocity), fma(p.half_dt, spin_rate, m.spin),
          acceleration, spin_rate};
}

// The same in a periodic box, where velocities are relative to its strain.
template <class V>
constexpr GMEM_INLINE Grain<V> end_step(const GrainParameters<V>& p, bool isotropic, const HalfStep<V>& m, Vec<V> force,
                                        Vec<V> torque, const Cell<V>& cell) {
  Grain<V> g = end_step(p, isotropic, m, force, torque);
  const auto acceleration = [&](V velocity, V force, V rate, V gravity) {
    const V slowing = p.drag + rate;
    return (fnma(slowing, velocity, p.inverse_mass * force) - gravity) / fma(p.half_dt, slowing, splat<V>(1.0));
  };
  g.acceleration = {acceleration(m.velocity.x, force.x, cell.rate.x, V{}),
                    acceleration(m.velocity.y, force.y, cell.rate.y, V{}),
                    acceleration(m.velocity.z, force.z, cell.rate.z, p.gravity)};
  g.velocity = fma(p.half_dt, g.acceleration, m.velocity);
  return g;
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

// Adds to `on` the forces of the walls on one sphere of a grain. The wall stiffness in `p` holds for `radius`.
// gmem_jax/physics/forces.py: forces_on_grains
template <class V>
constexpr void touch_walls(const GrainParameters<V>& p, Vec<V> centre, Vec<V> lever, Vec<V> velocity,
                           const WallState<V>& box, WallForces<V>& on, V radius = splat<V>(1.0)) {
  const Vec<V> all{radius, radius, radius};
  if (!bits_less(V{}, deepest(radius, centre, box))) return;
  const Vec<V> lower = all - (centre - box.lower), upper = all - (box.upper - centre);
  const Vec<V> low = wall_force(p, lower, box.lower_velocity - velocity);
  const Vec<V> up = wall_force(p, upper, velocity - box.upper_velocity);
  on.lower = on.lower + low;
  on.upper = on.upper + up;
  on.force = on.force + (low - up);
  on.torque = add_cross(on.torque, lever, low - up);
}

// Force and torque on a grain by friction of the walls.
template <class V>
struct WallFriction {
  Vec<V> force, torque;
};

// The friction law at walls, and the other parameters that contacts with walls need. `rub` treats these as contacts
// between unequal spheres: the root of the harmonic mean is the factor by which the wall is stiffer than a contact
// between spheres of radius 1 (`stiffer`).
template <class V>
struct WallLaw {
  LawParameters<V> law;
  V quarter_dt, normal_stiffness;

  WallLaw() = default;

  constexpr WallLaw(const V* parameter, V mu)
      : law(parameter + kLaw, parameter[kDt]), quarter_dt(splat<V>(0.25) * parameter[kDt] * parameter[kSpinning]),
        normal_stiffness(parameter[kNormalStiffness]) {
    law.mu = mu;
  }
};

// A sphere's contact with the plane that lies in the direction `normal`, without its friction and its history.
// gmem_jax/physics/contact/wall.py: wall_kinematics
template <class V>
constexpr GMEM_INLINE void meet_plane(Vec<V> normal, const WallLaw<V>& walls, V damping_time, Vec<V> lever,
                                      Vec<V> velocity, Vec<V> spin, V radius, V overlap, V closing, Contact<V>& now) {
  now.normal = normal;
  now.overlap = overlap;
  const Vec<V> arm = radius * now.normal;
  now.lever_one = lever + arm;
  now.sliding = dot(velocity, now.normal) * now.normal - velocity - cross(spin, arm);
  now.turned = walls.quarter_dt * dot(spin, now.normal);
  const V safe = now.safe_overlap();
  now.root_overlap = root(safe);
  now.normal_force = hertz(now.touching(), safe, now.root_overlap, closing, walls.normal_stiffness, damping_time);
}

// The unit vector from the centre of the box to plane w.
template <class V>
constexpr Vec<V> normal_of_plane(int w) {
  const V zero{}, side = splat<V>(w < 3 ? -1.0 : 1.0);
  return {w % 3 == 0 ? side : zero, w % 3 == 1 ? side : zero, w % 3 == 2 ? side : zero};
}

// Adds to `on` the friction of the walls on one sphere of a grain. The wall stiffness in `p` is that for the sphere's
// radius. `history` is the sphere's history at each plane, [kPlanes, Law::kHistory]; `segments_of(w)` are Mindlin's
// segments at plane w. Bit w of `remembered` is set where the history at plane w may differ from 0. Returns the new
// bits: the planes that the sphere touches.
// gmem_jax/physics/contact/wall.py: wall_friction
template <class Law, class V, class SegmentsOf>
GMEM_INLINE unsigned rub_walls(const GrainParameters<V>& p, const WallLaw<V>& walls, Vec<V> centre, Vec<V> lever,
                               Vec<V> velocity, Vec<V> spin, const WallState<V>& box, V radius, V* history,
                               unsigned remembered, const SegmentsOf& segments_of, WallFriction<V>& on) {
  if (!remembered && !bits_less(V{}, deepest(radius, centre, box))) return 0;
  const Vec<V> all{radius, radius, radius};
  const Vec<V> lower = all - (centre - box.lower), upper = all - (box.upper - centre);
  const Vec<V> low = box.lower_velocity - velocity, up = velocity - box.upper_velocity;
  const V overlap[kPlanes] = {lower.x, lower.y, lower.z, upper.x, upper.y, upper.z};
  const V closing[kPlanes] = {low.x, low.y, low.z, up.x, up.y, up.z};
  const V stiffer_by = p.wall_stiffness / walls.normal_stiffness;
  Contact<V> c[kPlanes];
  Unequal<V> stiffer[kPlanes];
  int count = 0, plane[kPlanes];
  unsigned touched = 0;
  for (int w = 0; w < kPlanes; ++w) {
    V* const own = history + w * Law::kHistory;
    if (!bits_less(V{}, overlap[w])) {
      if (!(remembered >> w & 1)) continue;
      for (int q = 0; q < Law::kHistory; ++q) own[q] = V{};
      if constexpr (Law::kLayered) segments_of(w).forget();
      continue;
    }
    touched |= 1u << w;
    c[count].history = own;
    stiffer[count].root = stiffer_by;
    meet_plane(normal_of_plane<V>(w), walls, p.normal_damping, lever, velocity, spin, radius, overlap[w], closing[w],
               c[count]);
    plane[count++] = w;
  }
  for (int done = 0; done < count; done += kTogether) {
    const int more = count - done < kTogether ? count - done : kTogether;
    rub<Law>(c + done, more, walls.law, stiffer + done, [&](int n) { return segments_of(plane[done + n]); });
  }
  for (int n = 0; n < count; ++n) {
    on.force = on.force + c[n].force;
    on.torque = add_cross(on.torque, c[n].lever_one, c[n].force);
  }
  return touched;
}

// The centre of a sphere of a grain. If the walls are `near`, adds their forces on the sphere to `on`.
template <class V>
constexpr GMEM_INLINE Vec<V> sphere_of(const GrainParameters<V>& p, const HalfStep<V>& m, const Matrix<V>& rotation,
                                       Vec<V> body, bool near, const WallState<V>& box, WallForces<V>& on,
                                       V radius = splat<V>(1.0)) {
  const Vec<V> lever = rotation * body, centre = m.position + lever;
  if (near) touch_walls(p, centre, lever, add_cross(m.velocity, m.spin, lever), box, on, radius);
  return centre;
}

// The centre of a sphere in a grain: three doubles, or numbers that carry derivatives.
template <class V, class Number>
constexpr GMEM_INLINE Vec<V> body_at(const Number* at) {
  if constexpr (__is_class(Number)) {
    return load_vec(at);
  } else {
    return {splat<V>(at[0]), splat<V>(at[1]), splat<V>(at[2])};
  }
}

// Calls `put(k, centre)` for the spheres of a grain, adds the walls' forces to `on`, and returns whether walls are
// near.
// gmem_jax/physics/forces.py: sphere_table
template <class V, class Number, class Put>
GMEM_INLINE bool spheres_of(const GrainParameters<V>& p, const HalfStep<V>& m, const Number* offsets, int spheres,
                            double arm, const WallState<V>& box, WallForces<V>& on, const Put& put) {
  const Matrix<V> rotation = matrix(m.orientation);
  const bool near = bits_less(V{}, deepest(splat<V>(1.0 + arm), m.position, box)) != 0;
  for (int k = 0; k < spheres; ++k) {
    put(k, sphere_of(p, m, rotation, body_at<V>(offsets + 3 * k), near, box, on));
  }
  return near;
}

// The same for a grain of size `size`. In one of size 1 the spheres have `radii`, and lie within `outer` of its centre.
template <class V, class Number, class Put>
GMEM_INLINE bool spheres_of(const GrainParameters<V>& p, const HalfStep<V>& m, const Number* offsets,
                            const double* radii, int spheres, V size, double outer, const WallState<V>& box,
                            WallForces<V>& on, const Put& put) {
  const Matrix<V> rotation = matrix(m.orientation);
  const bool near = bits_less(V{}, deepest(splat<V>(outer) * size, m.position, box)) != 0;
  for (int k = 0; k < spheres; ++k) {
    const Vec<V> body = size * body_at<V>(offsets + 3 * k);
    if (!near) {
      put(k, m.position + rotation * body);
      continue;
    }
    const V radius = splat<V>(radii[k]) * size;
    GrainParameters<V> own = p;
    own.wall_stiffness = root(radius) * p.wall_stiffness;
    put(k, sphere_of(own, m, rotation, body, near, box, on, radius));
  }
  return near;
}

// A grain's part of L times the force across a section of a periodic box, along each axis; L is the box's length.
// gmem_jax/physics/forces.py: section_force
template <class V>
constexpr Vec<V> section(const Cell<V>& cell, V mass, const HalfStep<V>& m, Vec<V> force) {
  const auto axis = [&](V at, V lower, V velocity, V force) {
    return fma(force, at - lower, mass * (velocity * velocity));
  };
  return {axis(m.position.x, cell.lower.x, m.velocity.x, force.x),
          axis(m.position.y, cell.lower.y, m.velocity.y, force.y),
          axis(m.position.z, cell.lower.z, m.velocity.z, force.z)};
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

// Pressures along the periodic axes, from the sum of `section` over all grains and the forces through the box's faces.
template <class V>
constexpr Vec<V> section_pressure(int periodic, const WallState<V>& box, const Cell<V>& cell, Vec<V> sections,
                                  Vec<V> through) {
  const V two = splat<V>(2.0);
  const Vec<V> p =
      pressure(box, {two * (through.x + sections.x / cell.lengths.x), two * (through.y + sections.y / cell.lengths.y),
                     two * (through.z + sections.z / cell.lengths.z)});
  return {periodic & 1 ? p.x : V{}, periodic & 2 ? p.y : V{}, periodic & 4 ? p.z : V{}};
}

}  // namespace GMEM_ISA
}  // namespace gmem
