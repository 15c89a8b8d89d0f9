// The motion of grains and their contacts with the walls. Included inside the instruction set's namespace.

struct WallState {
  Vec lower, upper, lower_velocity, upper_velocity;
};

// A grain at the beginning of a step.
struct Grain {
  Vec position;
  Quaternion orientation;
  Vec velocity, spin, acceleration, spin_rate;
};

// ... with position and orientation at its end, velocities predicted for it, and those of the middle of the step.
struct Midway {
  Vec position;
  Quaternion orientation;
  Vec velocity, spin, half_velocity, half_spin;
};

// A grain's constants, of the parameter array.
struct GrainParameters {
  V dt, half_dt, drag, inertia[3], inverse_mass, inverse_inertia[3], wall_stiffness, normal_damping;

  GrainParameters() = default;

  explicit GrainParameters(const V* parameter)
      : dt(parameter[kDt]), half_dt(splat(0.5) * dt), drag(parameter[kDrag]),
        inverse_mass(splat(1.0) / parameter[kMass]), wall_stiffness(parameter[kWallStiffness]),
        normal_damping(parameter[kNormalDamping]) {
    for (int axis = 0; axis < 3; ++axis) {
      inertia[axis] = parameter[kInertia + axis];
      inverse_inertia[axis] = splat(1.0) / inertia[axis];
    }
  }
};

// First half of a step: positions and orientations at its end, and velocities predicted for it.
GMEM_INLINE Midway begin_step(const GrainParameters& p, const Grain& g) {
  const Vec half_velocity = fma(p.half_dt, g.acceleration, g.velocity), half_spin = fma(p.half_dt, g.spin_rate, g.spin);
  return {fma(p.dt, half_velocity, g.position),
          turn(g.orientation, p.dt * half_spin),
          fma(p.dt, g.acceleration, g.velocity),
          fma(p.dt, g.spin_rate, g.spin),
          half_velocity,
          half_spin};
}

inline Vec angular_acceleration(const GrainParameters& p, bool isotropic, Quaternion orientation, Vec spin, Vec torque) {
  if (isotropic) return p.inverse_inertia[0] * torque;
  const Matrix rotation = matrix(orientation);
  const Vec body_spin = transposed(rotation, spin);
  const Vec momentum{p.inertia[0] * body_spin.x, p.inertia[1] * body_spin.y, p.inertia[2] * body_spin.z};
  const Vec rate = transposed(rotation, torque) - cross(body_spin, momentum);
  return rotation * Vec{p.inverse_inertia[0] * rate.x, p.inverse_inertia[1] * rate.y, p.inverse_inertia[2] * rate.z};
}

// Second half: accelerations and velocities; position and orientation stay.
GMEM_INLINE Grain end_step(const GrainParameters& p, bool isotropic, const Midway& m, Vec force, Vec torque) {
  const Vec acceleration = fnma(p.drag, m.velocity, p.inverse_mass * force);
  const Vec spin_rate = fnma(p.drag, m.spin, angular_acceleration(p, isotropic, m.orientation, m.spin, torque));
  return {m.position,   m.orientation, fma(p.half_dt, acceleration, m.half_velocity), fma(p.half_dt, spin_rate, m.half_spin),
          acceleration, spin_rate};
}

struct WallForces {
  Vec force, torque;  // on a grain
  Vec lower, upper;   // on the walls, as magnitudes
};

// Largest overlap with any wall of a sphere of radius `reach` around `centre`.
inline V deepest(V reach, Vec centre, const WallState& box) {
  const Vec all{reach, reach, reach};
  const Vec lower = all - (centre - box.lower), upper = all - (box.upper - centre);
  return max(max(max(lower.x, upper.x), max(lower.y, upper.y)), max(lower.z, upper.z));
}

inline Vec wall_force(const GrainParameters& parameters, Vec overlap, Vec closing) {
  const auto axis = [&](V p, V c) {
    const Mask touching = p > V{};
    if (!bits_less(V{}, p)) return V{};
    const V safe = select(touching, p, splat(1.0));
    return hertz(touching, safe, root(safe), c, parameters.wall_stiffness, parameters.normal_damping);
  };
  return {axis(overlap.x, closing.x), axis(overlap.y, closing.y), axis(overlap.z, closing.z)};
}

// Adds to `on` the forces of the walls on one sphere of a grain.
inline void touch_walls(const GrainParameters& p, Vec centre, Vec lever, Vec velocity, const WallState& box, WallForces& on) {
  const Vec one{splat(1.0), splat(1.0), splat(1.0)};
  if (!bits_less(V{}, deepest(one.x, centre, box))) return;
  const Vec lower = one - (centre - box.lower), upper = one - (box.upper - centre);
  const Vec low = wall_force(p, lower, box.lower_velocity - velocity);
  const Vec up = wall_force(p, upper, velocity - box.upper_velocity);
  on.lower = on.lower + low;
  on.upper = on.upper + up;
  on.force = on.force + (low - up);
  on.torque = add_cross(on.torque, lever, low - up);
}

// Finds the spheres of a grain, handed to `put(k, centre)`, and what the walls do to them; whether they are near them.
template <class Put>
GMEM_INLINE bool spheres_of(const GrainParameters& p, const Midway& m, const double* offsets, int spheres, double arm,
                            const WallState& box, WallForces& on, const Put& put) {
  const Matrix rotation = matrix(m.orientation);
  const bool near = bits_less(V{}, deepest(splat(1.0 + arm), m.position, box)) != 0;
  for (int k = 0; k < spheres; ++k) {
    const double* body = offsets + 3 * k;
    const Vec lever = rotation * Vec{splat(body[0]), splat(body[1]), splat(body[2])};
    const Vec centre = m.position + lever;
    put(k, centre);
    if (near) touch_walls(p, centre, lever, add_cross(m.velocity, m.spin, lever), box, on);
  }
  return near;
}

// p of each axis from the sum of the forces on its two walls: (F_lower + F_upper) / (2 A).
inline Vec pressure(const WallState& box, Vec force) {
  const Vec lengths = box.upper - box.lower;
  const V two = splat(2.0);
  return {force.x / (two * (lengths.y * lengths.z)), force.y / (two * (lengths.x * lengths.z)),
          force.z / (two * (lengths.x * lengths.y))};
}
