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

// The numbers of a contact that depend on its radii, where spheres differ in radius.
// gmem_jax/physics/contact/kinematics.py: Unequal
template <class V>
struct Unequal {
  V reach, lean, root;  // as in `Radii` of cpu/problem.h
};

// Adds the velocity that the strain of a periodic box (`Cell` of motion.h) gives to the second grain, or to its image.
// `lever_other` begins at the centre of that grain or image.
template <class V, class Cell>
constexpr GMEM_INLINE void drift(ContactInput<V>& m, const Cell& cell) {
  m.velocity = m.velocity + cell.flow(m.lever_one - m.lever_other);
}

// Puts the image of the second grain in a periodic box (`Cell` of motion.h) in the place of the grain; `shift` leads
// from the grain to the image. The levers already end at the contact with the image.
// gmem_jax/physics/forces.py: relative_motion
template <class V, class Cell>
constexpr GMEM_INLINE void to_image(ContactInput<V>& m, Vec<V> shift, const Cell& cell) {
  m.lever_other = m.lever_other - shift;
  drift(m, cell);
}

// The same for a contact whose separation and levers are still those of the second grain itself. `image` is the number
// of edges of the box from the grain to its image, along each axis.
template <class V, class Cell>
constexpr void move_to_image(ContactInput<V>& m, Vec<V> image, const Cell& cell) {
  const Vec<V> shift = cell.shift(image), half = splat<V>(0.5) * shift;
  m.separation = m.separation + shift;
  m.lever_one = m.lever_one + half;
  m.lever_other = m.lever_other + half;
  to_image(m, shift, cell);
}

// A contact's part of the force through the faces of a periodic box; `force` acts on the first grain of the contact.
template <class V>
constexpr GMEM_INLINE Vec<V> through_faces(Vec<V> image, Vec<V> force) {
  return {-(image.x * force.x), -(image.y * force.y), -(image.z * force.z)};
}

// Levers and relative motion before its projection. The first part of
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

// The overlap of spheres of radius 1, from the square of their distance and the inverse distance.
template <class V>
constexpr GMEM_INLINE V overlap_of(const Contact<V>& c) {
  return fnma(c.square, c.inverse, splat<V>(2.0));
}

// Moves the contact point by `lean` along the normal, away from the place halfway between the spheres. `spin` is the
// spin of the second grain minus that of the first.
template <class V>
constexpr GMEM_INLINE void lean_over(Vec<V> spin, V lean, Contact<V>& c) {
  const Vec<V> moved = lean * c.normal;
  c.lever_one = c.lever_one + moved;
  c.lever_other = c.lever_other + moved;
  c.sliding = add_cross(c.sliding, spin, moved);
}

// The same for a contact whose motion halfway between the spheres has not been computed.
template <class V>
constexpr GMEM_INLINE void lean_over(ContactInput<V> m, V lean, Contact<V>& c) {
  m.separation = c.normal;
  relative_motion(m, c.square, c);
  lean_over(m.spin_other - m.spin_one, lean, c);
}

// The `motion_of` of contacts halfway between the spheres, whose motion is complete.
struct Halfway {
  constexpr void operator()(int) const {}
};

// Finds normals, sliding velocities and normal forces after `relative_motion`. The second part of
// gmem_jax/physics/contact/kinematics.py: kinematics
// Where spheres differ in radius, `motion_of(n)` returns the first argument of `lean_over`. If that is a
// `ContactInput`, contacts need only have separations and squares before. Roots of overlaps and forces are those of
// radii whose harmonic mean is 1; `rub` corrects them.
template <bool differ = false, class V, class MotionOf = Halfway>
constexpr void close(Contact<V>* c, int count, const V* parameter, const Unequal<V>* unequal = nullptr,
                     const MotionOf& motion_of = {}) {
  const V quarter_dt = splat<V>(0.25) * parameter[kDt] * parameter[kSpinning];
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    const Vec<V> normal = c[n].inverse * c[n].normal;
    c[n].normal = normal;
    if constexpr (differ) lean_over(motion_of(n), unequal[n].lean, c[n]);
    const V along = dot(c[n].sliding, normal);
    c[n].sliding = fnma(along, normal, c[n].sliding);
    c[n].normal_force = -along;                             // for now, the closing velocity
    c[n].turned = quarter_dt * dot(c[n].spin_sum, normal);  // with the mean spin of the two grains
    if constexpr (differ) {
      c[n].overlap = fnma(c[n].square, c[n].inverse, unequal[n].reach);
    } else {
      c[n].overlap = overlap_of(c[n]);
    }
    c[n].square = c[n].safe_overlap();
  }
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    c[n].root_overlap = c[n].square * c[n].inverse;
    c[n].normal_force = hertz(c[n].touching(), c[n].square, c[n].root_overlap, c[n].normal_force,
                              parameter[kNormalStiffness], parameter[kNormalDamping]);
  }
}

// Finds the tangential forces of a batch after `close`. Between spheres whose radii have the harmonic mean r all forces
// are root(r) times those of spheres of radius 1, except those of tangential springs that do not depend on the overlap.
template <class Law, class V, class SegmentsOf>
constexpr GMEM_INLINE void rub(Contact<V>* c, int count, const LawParameters<V>& law, const Unequal<V>* unequal,
                               const SegmentsOf& segments_of) {
  if constexpr (Law::kLayered) {
    friction(Law{}, c, count, law, segments_of);
    for (int n = 0; unequal && n < count; ++n)
      c[n].normal_force = unequal[n].root * c[n].normal_force, c[n].force = unequal[n].root * c[n].force;
  } else {
    for (int n = 0; unequal && n < count; ++n)
      c[n].normal_force = unequal[n].root * c[n].normal_force, c[n].root_overlap = unequal[n].root * c[n].root_overlap;
    friction(Law{}, c, count, law);
  }
}

// Force on i, and torques about the centres of both grains (j takes the opposite force).
// gmem_jax/physics/forces.py: contact_forces
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
