// From the motion of grains to the forces between them, for a batch of contacts. Included inside the instruction set's
// namespace.

// The two spheres of a contact, i and j, and their grains.
struct Meeting {
  Vec separation;              // of the spheres, j - i
  Vec lever_one, lever_other;  // from the grains' centres to the contact point, halfway between the spheres
  Vec velocity;                // of the grains, j - i
  Vec spin_one, spin_other;
};

GMEM_INLINE void meet(const Meeting& m, V square, Contact& c) {
  c.normal = m.separation;
  c.square = square;
  c.sliding = add_cross(add_cross(m.velocity, m.spin_other, m.lever_other), m.lever_one, m.spin_one);
  c.lever_one = m.lever_one;
  c.lever_other = m.lever_other;
  c.spin_sum = m.spin_one + m.spin_other;
}

// From what `meet` left to normals, sliding velocities and normal forces.
inline void close(Contact* c, int count, const V* parameter) {
  const V two = splat(2.0), quarter_dt = splat(0.25) * parameter[kDt];
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    const Vec normal = c[n].inverse * c[n].normal;
    const V along = dot(c[n].sliding, normal);
    c[n].normal = normal;
    c[n].sliding = fnma(along, normal, c[n].sliding);
    c[n].normal_force = -along;  // for now, the closing velocity
    c[n].turned = quarter_dt * dot(c[n].spin_sum, normal);  // with the mean spin of the two grains
    c[n].overlap = fnma(c[n].square, c[n].inverse, two);
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
struct Push {
  Vec force, torque_one, torque_other;
};

GMEM_INLINE Push push(const Contact& c) {
  const Vec force = fnma(c.normal_force, c.normal, c.force);
  return {force, cross(c.lever_one, force), cross(force, c.lever_other)};
}
