// From the motion of grains to the forces between them, for a batch of contacts.

#pragma once

#include "physics/laws.h"

namespace gmem {
namespace GMEM_ISA {

// The two spheres of a contact, i and j, and their grains.
template <class V>
struct ContactInput {
  Vec<V> separation;              // of the spheres, j - i
  Vec<V> lever_one, lever_other;  // from the grains' centres to the contact point, halfway between the spheres
  Vec<V> velocity;                // of the grains, j - i
  Vec<V> spin_one, spin_other;
};

// From the second grain to its image in a periodic box (`Cell` of motion.h), which `shift` leads to. Levers already end
// at the contact with that.
// gmem_jax/physics/step.py: relative_motion
template <class V, class Cell>
constexpr GMEM_INLINE void to_image(ContactInput<V>& m, Vec<V> shift, const Cell& cell) {
  m.lever_other = m.lever_other - shift;
  m.velocity = m.velocity + cell.flow(m.lever_one - m.lever_other);
}

// Levers and relative motion, unprojected. The first part of
// gmem_jax/physics/contact/kinematics.py: kinematics
template <class V>
constexpr GMEM_INLINE void relative_motion(const ContactInput<V>& m, V square, Contact<V>& c) {
  c.normal = m.separation;
  c.square = square;
  c.sliding = add_cross(add_cross(m.velocity, m.spin_other, m.lever_other), m.lever_one, m.spin_one);
  c.lever_one = m.lever_one;
  c.lever_other = m.lever_other;
  c.spin_sum = m.spin_one + m.spin_other;
}

// From the square of the distance and the inverse distance.
template <class V>
constexpr GMEM_INLINE V overlap_of(const Contact<V>& c) { return fnma(c.square, c.inverse, splat<V>(2.0)); }

// From what `relative_motion` left to normals, sliding velocities and normal forces. The second part of
// gmem_jax/physics/contact/kinematics.py: kinematics
template <class V>
constexpr void close(Contact<V>* c, int count, const V* parameter) {
  const V quarter_dt = splat<V>(0.25) * parameter[kDt] * parameter[kSpinning];
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    const Vec<V> normal = c[n].inverse * c[n].normal;
    const V along = dot(c[n].sliding, normal);
    c[n].normal = normal;
    c[n].sliding = fnma(along, normal, c[n].sliding);
    c[n].normal_force = -along;  // for now, the closing velocity
    c[n].turned = quarter_dt * dot(c[n].spin_sum, normal);  // with the mean spin of the two grains
    c[n].overlap = overlap_of(c[n]);
    c[n].square = c[n].safe_overlap();
  }
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    c[n].root_overlap = c[n].square * c[n].inverse;
    c[n].normal_force = hertz(c[n].touching(), c[n].square, c[n].root_overlap, c[n].normal_force,
                              parameter[kNormalStiffness], parameter[kNormalDamping]);
  }
}

// Force on i, and torques about the centres of both grains (j takes the opposite force).
// gmem_jax/physics/step.py: contact_forces
template <class V>
struct ContactLoads {
  Vec<V> force, torque_one, torque_other;
};

template <class V>
constexpr GMEM_INLINE ContactLoads<V> push(const Contact<V>& c) {
  const Vec<V> force = fnma(c.normal_force, c.normal, c.force);
  return {force, cross(c.lever_one, force), cross(force, c.lever_other)};
}

}  // namespace GMEM_ISA
}  // namespace gmem
