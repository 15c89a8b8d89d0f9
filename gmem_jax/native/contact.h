// Force and torque of a vector of sphere-sphere contacts. Included inside the instruction set's namespace.

// Differences (j - i) of positions and sphere-centre velocities, sum of the spins; force and tangential torque on i.
template <class Law, class Layers>
inline void contact_force(Vec separation, V square, Vec velocity, Vec spin_sum, const V* parameter,
                          const LawParameters& law, V* history, Layers& layers, Vec& force, Vec& torque) {
  const V one = splat(1.0), half = splat(0.5);
  const V inverse = inverse_root(square);
  const V distance = square * inverse;
  const V overlap = splat(2.0) - distance;
  Contact c;
  c.touching = overlap > V{};
  c.normal = inverse * separation;
  c.overlap = select(c.touching, overlap, one);
  c.arm = half * distance;
  c.dt = parameter[kDt];
  const Vec minus_lever = (-c.arm) * c.normal;
  const Vec relative = add_cross(velocity, spin_sum, minus_lever);
  const V along = dot(relative, c.normal);
  c.sliding = fnma(along, c.normal, relative);
  const V turned = splat(0.25) * dot(spin_sum, c.normal) * c.dt;  // half of the mean spin's turn in this step
  const V turned2 = turned * turned;
  const V shrink = one / (one + turned2);
  c.cosine = (one - turned2) * shrink;
  c.sine = (turned + turned) * shrink;
  const V normal_force = hertz(c.touching, c.overlap, -along, parameter[kNormalStiffness], parameter[kNormalDamping]);
  const Vec tangential = friction(Law{}, c, normal_force, law, history, layers);
  force = fnma(normal_force, c.normal, tangential);
  torque = c.arm * cross(c.normal, tangential);
}
