// Force and torques of a vector of sphere-sphere contacts. Included inside the instruction set's namespace.

// The two spheres of a contact, i and j, and their grains.
struct Meeting {
  Vec separation;                // of the spheres, j - i
  V square;                      // of the distance
  Vec lever_one, lever_other;    // from the grains' centres to the contact point, halfway between the spheres
  Vec velocity;                  // of the grains, j - i
  Vec spin_one, spin_other;
};

// Force on i, and torques about the centres of both grains (j takes the opposite force).
struct Push {
  Vec force, torque_one, torque_other;
};

template <class Law, class Layers>
inline Push contact_push(const Meeting& m, const V* parameter, const LawParameters& law, V* history, Layers& layers) {
  const V one = splat(1.0);
  const V inverse = inverse_root(m.square);
  const V overlap = splat(2.0) - m.square * inverse;
  Contact c;
  c.touching = overlap > V{};
  c.normal = inverse * m.separation;
  c.overlap = select(c.touching, overlap, one);
  c.dt = parameter[kDt];
  const Vec relative =
      subtract_cross(add_cross(m.velocity, m.spin_other, m.lever_other), m.spin_one, m.lever_one);
  const V along = dot(relative, c.normal);
  c.sliding = fnma(along, c.normal, relative);
  const V turned = splat(0.25) * dot(m.spin_one + m.spin_other, c.normal) * c.dt;  // half the mean spin's turn
  const V turned2 = turned * turned;
  const V shrink = one / (one + turned2);
  c.cosine = (one - turned2) * shrink;
  c.sine = (turned + turned) * shrink;
  const V normal_force = hertz(c.touching, c.overlap, -along, parameter[kNormalStiffness], parameter[kNormalDamping]);
  const Vec tangential = friction(Law{}, c, normal_force, law, history, layers);
  const Vec force = fnma(normal_force, c.normal, tangential);
  return {force, cross(m.lever_one, force), cross(force, m.lever_other)};
}
