// All steps of one block: velocity Verlet as in gmem_jax/dynamics.py, in two phases per step that the threads of a
// team share - contacts, then grains (the end of one step and the beginning of the next).
//
// Forces are summed in the order that the plan fixes, wall forces in chunks of grains of fixed size. So neither the
// number of threads, nor which of them did what, nor the way replicas share blocks can change a number.
//
// Included inside the instruction set's namespace.

constexpr int kChunk = 16;  // grains per piece of work, and per partial sum of the wall forces
static_assert(kChunk % kMaxWidth == 0, "a chunk holds whole vectors of grains");

// The numbers of one unit - a grain of W replicas, or W grains of one replica - that contacts look at ...
enum Hot { kPosition = 0, kVelocity = 3, kSpin = 6, kForce = 9, kTorque = 12, kHot = 15 };
// ... and those that only its integration needs. Half-step velocities wait in the place of accelerations.
enum Cold { kQuaternion = 0, kAcceleration = 4, kSpinRate = 7, kCold = 10 };

struct FieldPlace {
  bool hot;
  int slot, size;
};
constexpr FieldPlace kField[kFields] = {{true, kPosition, 3}, {false, kQuaternion, 4},   {true, kVelocity, 3},
                                        {true, kSpin, 3},     {false, kAcceleration, 3}, {false, kSpinRate, 3}};

// Hands out aligned pieces of the scratch memory; every thread of a team repeats the same sequence.
struct Carver {
  char* base;
  std::size_t used = 0;

  template <class T>
  T* take(std::size_t count) {
    T* piece = reinterpret_cast<T*>(base + used);
    used += (count * sizeof(T) + 63) / 64 * 64;
    return piece;
  }
};

struct WallState {
  Vec lower, upper, lower_velocity, upper_velocity;
};

template <class Mode>
struct Engine {
  const Problem& problem;
  const Block& block;
  const Plan& plan;
  Team& team;
  const int rank;
  Mode mode;
  V* hot;         // [units, kHot]
  V* cold;        // [units, kCold]
  double* walls;  // partial sums, [chunks, 2, 3] in the mode's own layout
  V* fastest;     // squares of the largest half-step velocity and spin, [chunks, 2]
  V parameter[kParameters];
  V inverse_mass, inverse_inertia[3];
  double arm;           // of the outermost sphere of a grain
  double travel = 0.0;  // how much closer any two spheres can have come since the call began

  static std::size_t carve(const Problem& p, const Block& block, Carver& carver, Engine* engine) {
    const std::size_t units = Mode::units(p);
    V* hot = carver.take<V>(units * kHot);
    V* cold = carver.take<V>(units * kCold);
    double* walls = carver.take<double>(static_cast<std::size_t>(chunks(p)) * 6 * W);
    V* fastest = carver.take<V>(static_cast<std::size_t>(chunks(p)) * 2);
    if (engine) engine->hot = hot, engine->cold = cold, engine->walls = walls, engine->fastest = fastest;
    return Mode::carve(p, *block.pack->plan, carver, engine ? &engine->mode : nullptr);
  }

  static int chunks(const Problem& p) { return (p.grains + kChunk - 1) / kChunk; }

  Engine(const Problem& problem, const Block& block, Team& team, int rank, void* scratch)
      : problem(problem), block(block), plan(*block.pack->plan), team(team), rank(rank), mode(problem, block) {
    Carver carver{static_cast<char*>(scratch)};
    carve(problem, block, carver, this);
    mode.hot = hot;
    for (int row = 0; row < kParameters; ++row) parameter[row] = mode.per_lane(&Lane::parameters, row);
    inverse_mass = splat(1.0) / parameter[kMass];
    for (int axis = 0; axis < 3; ++axis) inverse_inertia[axis] = splat(1.0) / parameter[kInertia + axis];
    arm = 0.0;
    for (int k = 0; k < problem.spheres_per_grain; ++k) {
      const double* body = block.pack->offsets + 3 * k;
      const double length = __builtin_sqrt(body[0] * body[0] + body[1] * body[1] + body[2] * body[2]);
      arm = length > arm ? length : arm;
    }
  }

  WallState walls_at(int step) const {
    V w[kWalls];
    for (int row = 0; row < kWalls; ++row) w[row] = mode.per_lane(&Lane::walls, step * kWalls + row);
    return {load_vec(w), load_vec(w + 3), load_vec(w + 6), load_vec(w + 9)};
  }

  // First half of a step of unit u: positions, orientations and predicted velocities at its end, and wall forces.
  void begin(int u, const WallState& box, double* wall_sums, V* speeds) {
    V* h = hot + static_cast<std::size_t>(u) * kHot;
    V* c = cold + static_cast<std::size_t>(u) * kCold;
    const V dt = parameter[kDt], half_dt = splat(0.5) * dt;
    const Vec acceleration = load_vec(c + kAcceleration), spin_rate = load_vec(c + kSpinRate);
    const Vec old_velocity = load_vec(h + kVelocity), old_spin = load_vec(h + kSpin);
    const Vec half_velocity = fma(half_dt, acceleration, old_velocity), half_spin = fma(half_dt, spin_rate, old_spin);
    const Vec position = fma(dt, half_velocity, load_vec(h + kPosition));
    const Vec velocity = fma(dt, acceleration, old_velocity), spin = fma(dt, spin_rate, old_spin);
    const Quaternion orientation = turn({c[kQuaternion], load_vec(c + kQuaternion + 1)}, dt * half_spin);
    c[kQuaternion] = orientation.w;
    store_vec(c + kQuaternion + 1, orientation.v);
    speeds[0] = max(speeds[0], dot(half_velocity, half_velocity));
    speeds[1] = max(speeds[1], dot(half_spin, half_spin));
    store_vec(c + kAcceleration, half_velocity);
    store_vec(c + kSpinRate, half_spin);
    store_vec(h + kPosition, position);
    store_vec(h + kVelocity, velocity);
    store_vec(h + kSpin, spin);

    const Matrix rotation = matrix(orientation);
    const V reach = splat(1.0 + arm);
    const bool near = bits_less(V{}, deepest({reach, reach, reach}, position, box)) != 0;
    WallForces on{};
    for (int k = 0; k < problem.spheres_per_grain; ++k) {
      const double* body = block.pack->offsets + 3 * k;
      const Vec lever = rotation * Vec{splat(body[0]), splat(body[1]), splat(body[2])};
      const Vec centre = position + lever;
      mode.put_sphere(u, k, centre);
      if (near) touch_walls(centre, lever, add_cross(velocity, spin, lever), box, on);
    }
    mode.put_grain(u, position, velocity, spin, on.force, on.torque);
    if (near) mode.add_walls(u, wall_sums, on.lower, on.upper);
  }

  struct WallForces {
    Vec force, torque;  // on a grain
    Vec lower, upper;   // on the walls, as magnitudes
  };

  // Largest overlap with any wall of a sphere of radius `reach` around `centre`.
  static V deepest(Vec reach, Vec centre, const WallState& box) {
    const Vec lower = reach - (centre - box.lower), upper = reach - (box.upper - centre);
    return max(max(max(lower.x, upper.x), max(lower.y, upper.y)), max(lower.z, upper.z));
  }

  void touch_walls(Vec centre, Vec lever, Vec velocity, const WallState& box, WallForces& on) const {
    const V one = splat(1.0);
    if (!bits_less(V{}, deepest({one, one, one}, centre, box))) return;
    const Vec lower = Vec{one, one, one} - (centre - box.lower), upper = Vec{one, one, one} - (box.upper - centre);
    const Vec low = wall_force(lower, box.lower_velocity - velocity);
    const Vec up = wall_force(upper, velocity - box.upper_velocity);
    on.lower = on.lower + low;
    on.upper = on.upper + up;
    on.force = on.force + (low - up);
    on.torque = add_cross(on.torque, lever, low - up);
  }

  Vec wall_force(Vec overlap, Vec closing) const {
    const auto axis = [&](V p, V c) {
      const Mask touching = p > V{};
      if (!bits_less(V{}, p)) return V{};
      const V safe = select(touching, p, splat(1.0));
      return hertz(touching, safe, root(safe), c, parameter[kWallStiffness], parameter[kNormalDamping]);
    };
    return {axis(overlap.x, closing.x), axis(overlap.y, closing.y), axis(overlap.z, closing.z)};
  }

  // Second half: accelerations and velocities.
  void finish(int u) {
    V* h = hot + static_cast<std::size_t>(u) * kHot;
    V* c = cold + static_cast<std::size_t>(u) * kCold;
    const V half_dt = splat(0.5) * parameter[kDt], drag = parameter[kDrag];
    Vec force, torque;
    mode.total_force(u, force, torque);
    const Vec spin = load_vec(h + kSpin);
    const Vec acceleration = fnma(drag, load_vec(h + kVelocity), inverse_mass * force);
    const Vec spin_rate = fnma(drag, spin, angular_acceleration(c, spin, torque));
    store_vec(h + kVelocity, fma(half_dt, acceleration, load_vec(c + kAcceleration)));
    store_vec(h + kSpin, fma(half_dt, spin_rate, load_vec(c + kSpinRate)));
    store_vec(c + kAcceleration, acceleration);
    store_vec(c + kSpinRate, spin_rate);
  }

  Vec angular_acceleration(const V* c, Vec spin, Vec torque) const {
    if (problem.isotropic) return inverse_inertia[0] * torque;
    const Matrix rotation = matrix({c[kQuaternion], load_vec(c + kQuaternion + 1)});
    const Vec body_spin = transposed(rotation, spin);
    const Vec momentum{parameter[kInertia] * body_spin.x, parameter[kInertia + 1] * body_spin.y,
                       parameter[kInertia + 2] * body_spin.z};
    const Vec rate = transposed(rotation, torque) - cross(body_spin, momentum);
    return rotation * Vec{inverse_inertia[0] * rate.x, inverse_inertia[1] * rate.y, inverse_inertia[2] * rate.z};
  }

  // One pass over the grains: `ends` the step in progress and/or `begins` step number `step`.
  void grains(bool ends, bool begins, int step) {
    const WallState box = walls_at(begins ? step : 0);
    team.share(Team::kGrains, rank, chunks(problem));
    for (int chunk; team.take(Team::kGrains, rank, &chunk);) {
      double* sums = walls + static_cast<std::size_t>(chunk) * 6 * W;
      V* speeds = fastest + 2 * static_cast<std::size_t>(chunk);
      if (begins) {
        std::memset(sums, 0, 6 * W * sizeof(double));
        speeds[0] = speeds[1] = V{};
      }
      const int first = Mode::unit_of(chunk * kChunk), last = Mode::unit_of((chunk + 1) * kChunk);
      for (int u = first; u < last && u < Mode::units(problem); ++u) {
        if (ends) finish(u);
        if (begins) begin(u, box, sums, speeds);
      }
    }
    team.barrier();
    if (begins) add_travel();
  }

  // A sphere moves by at most dt (|v| + |spin| arm) in a step; two may approach each other by twice that.
  void add_travel() {
    V speed{}, spin{};
    for (int chunk = 0; chunk < chunks(problem); ++chunk) {
      speed = max(speed, fastest[2 * chunk]);
      spin = max(spin, fastest[2 * chunk + 1]);
    }
    const V step = parameter[kDt] * fma(splat(arm), root(spin), root(speed));
    travel += 2.0 * (1.0 + 1e-9) * largest(step);
  }

  void contacts() {
    const LawParameters law(parameter + kLaw, parameter[kDt]);
    team.share(Team::kContacts, rank, plan.domains);
    for (int domain; team.take(Team::kContacts, rank, &domain);)
      mode.contacts(plan.domain_candidate[domain], plan.domain_candidate[domain + 1], parameter, law, travel);
    team.barrier();
  }

  // p of each axis from the partial sums of `step`: (F_lower + F_upper) / (2 A).
  Vec pressure(int step) const {
    const WallState box = walls_at(step);
    const Vec lengths = box.upper - box.lower;
    const Vec force = mode.sum_walls(walls, chunks(problem));
    const V two = splat(2.0);
    return {force.x / (two * (lengths.y * lengths.z)), force.y / (two * (lengths.x * lengths.z)),
            force.z / (two * (lengths.x * lengths.y))};
  }

  int share_begin(int count, int next = 0) const {
    return static_cast<int>(static_cast<int64_t>(count) * (rank + next) / team.size());
  }

  void load() {
    const int units = Mode::units(problem);
    for (int u = share_begin(units); u < share_begin(units, 1); ++u) mode.load_unit(u, hot, cold);
    for (int c = share_begin(plan.candidates); c < share_begin(plan.candidates, 1); ++c) mode.load_history(c);
    if (rank == 0) mode.load_dummies();
    team.barrier();
  }

  bool any_ends(int steps_done) const {
    for (int l = 0; l < block.count; ++l)
      if (block.lanes[l].steps == steps_done) return true;
    return false;
  }

  // Write the results of the lanes that have done all their steps.
  void deliver(int steps_done, Vec pressure) {
    const V p[3] = {pressure.x, pressure.y, pressure.z};
    for (int l = 0; rank == 0 && l < block.count; ++l)
      for (int axis = 0; axis < 3; ++axis)
        if (block.lanes[l].steps == steps_done) block.lanes[l].pressure[axis * problem.stride] = p[axis][l];
    const int units = Mode::units(problem);
    for (int u = share_begin(units); u < share_begin(units, 1); ++u) mode.unload_unit(u, hot, cold, steps_done);
    for (int c = share_begin(plan.candidates); c < share_begin(plan.candidates, 1); ++c)
      mode.unload_history(c, steps_done);
    for (int c = share_begin(plan.padding); c < share_begin(plan.padding, 1); ++c) mode.unload_padding(c, steps_done);
    team.barrier();
  }

  void run() {
    int steps = 0;
    for (int l = 0; l < block.count; ++l) steps = block.lanes[l].steps > steps ? block.lanes[l].steps : steps;
    load();
    Vec total{V{}, V{}, V{}};
    if (any_ends(0)) deliver(0, total);
    if (steps > 0) grains(false, true, 0);
    for (int step = 0; step < steps; ++step) {
      if (rank == 0) total = total + pressure(step);
      contacts();
      const bool more = step + 1 < steps;
      if (!any_ends(step + 1)) {
        grains(true, more, step + 1);
        continue;
      }
      grains(true, false, 0);
      deliver(step + 1, total);
      if (more) grains(false, true, step + 1);
    }
  }
};
