// All steps of one block: velocity Verlet as in gmem_jax/dynamics.py, in two phases per step that the threads of a
// team share - contacts, then grains (the end of one step and the beginning of the next).
//
// Forces are first stored per contact and then summed per sphere in the order of the incidence table, and wall forces
// are summed in chunks of grains of fixed size. So neither the number of threads, nor which of them did what, nor the
// way replicas share blocks can change a number.
//
// Included inside the instruction set's namespace.

constexpr int kChunkGrains = 16;  // grains per piece of work; also the partial sums of the wall forces
constexpr int kChunkPairs = 128;  // candidate contacts per piece of work
static_assert(kChunkGrains % kMaxWidth == 0, "a chunk holds whole vectors of grains");

// Vectors of one unit (a grain of W replicas, or W grains of one replica) in scratch memory.
enum Slot { kPosition = 0, kQuaternion = 3, kVelocity = 7, kSpin = 10, kAcceleration = 13, kSpinRate = 16, kForce = 19,
            kTorque = 22, kSlots = 25 };
constexpr int kFieldSlot[kFields] = {kPosition, kQuaternion, kVelocity, kSpin, kAcceleration, kSpinRate};
constexpr int kFieldSize[kFields] = {3, 4, 3, 3, 3, 3};

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

// What replicas in lanes and grains in lanes have in common: the state of the units and their integration.
template <class Mode>
struct Engine {
  const Problem& problem;
  const Block& block;
  Team& team;
  const int rank;
  Mode mode;
  V* state;       // [units, kSlots]
  double* walls;  // partial sums, [chunks, 2, 3] in the mode's own layout
  V parameter[kParameters];
  V inverse_mass, inverse_inertia[3];

  static std::size_t carve(const Problem& p, Carver& carver, Engine* engine) {
    V* state = carver.take<V>(static_cast<std::size_t>(Mode::units(p)) * kSlots);
    double* walls = carver.take<double>(static_cast<std::size_t>(chunks(p)) * 6 * W);
    if (engine) engine->state = state, engine->walls = walls;
    return Mode::carve(p, carver, engine ? &engine->mode : nullptr);
  }

  static int chunks(const Problem& p) { return (p.grains + kChunkGrains - 1) / kChunkGrains; }

  Engine(const Problem& problem, const Block& block, Team& team, int rank, void* scratch)
      : problem(problem), block(block), team(team), rank(rank), mode(problem, block) {
    Carver carver{static_cast<char*>(scratch)};
    carve(problem, carver, this);
    for (int row = 0; row < kParameters; ++row) parameter[row] = mode.per_lane(&Lane::parameters, row);
    inverse_mass = splat(1.0) / parameter[kMass];
    for (int axis = 0; axis < 3; ++axis) inverse_inertia[axis] = splat(1.0) / parameter[kInertia + axis];
  }

  WallState walls_at(int step) const {
    V w[kWalls];
    for (int row = 0; row < kWalls; ++row) w[row] = mode.per_lane(&Lane::walls, step * kWalls + row);
    return {load_vec(w), load_vec(w + 3), load_vec(w + 6), load_vec(w + 9)};
  }

  // First half of a step of unit u: positions, orientations and predicted velocities at its end, and wall forces.
  void begin(int u, const WallState& box, double* wall_sums) {
    V* s = state + static_cast<std::size_t>(u) * kSlots;
    const V dt = parameter[kDt], half_dt = splat(0.5) * dt;
    const Vec acceleration = load_vec(s + kAcceleration), spin_rate = load_vec(s + kSpinRate);
    const Vec old_velocity = load_vec(s + kVelocity), old_spin = load_vec(s + kSpin);
    const Vec half_velocity = fma(half_dt, acceleration, old_velocity), half_spin = fma(half_dt, spin_rate, old_spin);
    const Vec position = fma(dt, half_velocity, load_vec(s + kPosition));
    const Quaternion orientation = turn({s[kQuaternion], load_vec(s + kQuaternion + 1)}, dt * half_spin);
    const Vec velocity = fma(dt, acceleration, old_velocity), spin = fma(dt, spin_rate, old_spin);
    store_vec(s + kPosition, position);
    s[kQuaternion] = orientation.w;
    store_vec(s + kQuaternion + 1, orientation.v);
    store_vec(s + kVelocity, velocity);
    store_vec(s + kSpin, spin);
    store_vec(s + kAcceleration, half_velocity);  // these two wait here for the end of the step
    store_vec(s + kSpinRate, half_spin);
    mode.put_spin(u, spin);

    const Vec nothing{V{}, V{}, V{}};
    Vec force = nothing, torque = nothing, on_lower = nothing, on_upper = nothing;
    const Matrix rotation = matrix(orientation);
    const V one = splat(1.0);
    bool touched = false;
    for (int k = 0; k < problem.spheres_per_grain; ++k) {
      const double* body = block.pack->offsets + 3 * k;
      const Vec arm = rotation * Vec{splat(body[0]), splat(body[1]), splat(body[2])};
      const Vec centre = position + arm;
      const Vec surface = add_cross(velocity, spin, arm);
      mode.put_sphere(u, k, centre, surface);
      const Vec lower = Vec{one, one, one} - (centre - box.lower);
      const Vec upper = Vec{one, one, one} - (box.upper - centre);
      const V deepest = max(max(max(lower.x, upper.x), max(lower.y, upper.y)), max(lower.z, upper.z));
      if (!bits_less(V{}, deepest)) continue;
      touched = true;
      const Vec low = wall_force(lower, box.lower_velocity - surface);
      const Vec up = wall_force(upper, surface - box.upper_velocity);
      on_lower = on_lower + low;
      on_upper = on_upper + up;
      force = force + (low - up);
      torque = add_cross(torque, arm, low - up);
    }
    store_vec(s + kForce, force);
    store_vec(s + kTorque, torque);
    if (touched) mode.add_walls(u, wall_sums, on_lower, on_upper);
  }

  static V max(V a, V b) { return select(a > b, a, b); }

  Vec wall_force(Vec overlap, Vec closing) const {
    const V one = splat(1.0), zero{};
    const V stiffness = parameter[kWallStiffness], damping = parameter[kNormalDamping];
    const auto axis = [&](V p, V c) { return hertz(p > zero, select(p > zero, p, one), c, stiffness, damping); };
    return {axis(overlap.x, closing.x), axis(overlap.y, closing.y), axis(overlap.z, closing.z)};
  }

  // Second half: the forces of the contacts, accelerations and velocities.
  void finish(int u) {
    V* s = state + static_cast<std::size_t>(u) * kSlots;
    const V half_dt = splat(0.5) * parameter[kDt], drag = parameter[kDrag];
    const Vec position = load_vec(s + kPosition), velocity = load_vec(s + kVelocity), spin = load_vec(s + kSpin);
    Vec force = load_vec(s + kForce), torque = load_vec(s + kTorque);
    for (int k = 0; k < problem.spheres_per_grain; ++k) {
      Vec f, t;
      if (!mode.contact_sum(u, k, f, t)) continue;
      force = force + f;
      torque = add_cross(torque + t, mode.centre(u, k) - position, f);
    }
    const Vec acceleration = fnma(drag, velocity, inverse_mass * force);
    const Vec spin_rate = fnma(drag, spin, angular_acceleration(s, spin, torque));
    store_vec(s + kVelocity, fma(half_dt, acceleration, load_vec(s + kAcceleration)));
    store_vec(s + kSpin, fma(half_dt, spin_rate, load_vec(s + kSpinRate)));
    store_vec(s + kAcceleration, acceleration);
    store_vec(s + kSpinRate, spin_rate);
  }

  Vec angular_acceleration(const V* s, Vec spin, Vec torque) const {
    if (problem.isotropic) return inverse_inertia[0] * torque;
    const Matrix rotation = matrix({s[kQuaternion], load_vec(s + kQuaternion + 1)});
    const Vec body_spin = transposed(rotation, spin);
    const Vec momentum{parameter[kInertia] * body_spin.x, parameter[kInertia + 1] * body_spin.y,
                       parameter[kInertia + 2] * body_spin.z};
    const Vec rate = transposed(rotation, torque) - cross(body_spin, momentum);
    return rotation * Vec{inverse_inertia[0] * rate.x, inverse_inertia[1] * rate.y, inverse_inertia[2] * rate.z};
  }

  // One pass over the grains: `ends` the step in progress and/or `begins` the one whose walls are `box`.
  void grains(bool ends, bool begins, int step) {
    const WallState box = walls_at(begins ? step : 0);
    team.share(Team::kGrains, rank, chunks(problem));
    for (int chunk; team.take(Team::kGrains, rank, &chunk);) {
      double* sums = walls + static_cast<std::size_t>(chunk) * 6 * W;
      if (begins) std::memset(sums, 0, 6 * W * sizeof(double));
      const int first = Mode::unit_of(chunk * kChunkGrains), last = Mode::unit_of((chunk + 1) * kChunkGrains);
      for (int u = first; u < last && u < Mode::units(problem); ++u) {
        if (ends) finish(u);
        if (begins) begin(u, box, sums);
      }
    }
    team.barrier();
  }

  void contacts() {
    team.share(Team::kPairs, rank, (problem.pairs + kChunkPairs - 1) / kChunkPairs);
    const LawParameters law{parameter[kLaw], parameter[kLaw + 1], parameter[kLaw + 2], parameter[kLaw + 3],
                            splat(1.0) / parameter[kLaw + 3]};
    for (int chunk; team.take(Team::kPairs, rank, &chunk);) {
      const int end = (chunk + 1) * kChunkPairs;
      mode.contacts(chunk * kChunkPairs, end < problem.pairs ? end : problem.pairs, parameter, law);
    }
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

  // Write the results of the lanes that have done all their steps.
  void deliver(int steps_done, Vec pressure) {
    for (int l = 0; l < block.count; ++l) {
      const Lane& lane = block.lanes[l];
      if (lane.steps != steps_done) continue;
      if (rank == 0) {
        const V p[3] = {pressure.x, pressure.y, pressure.z};
        for (int axis = 0; axis < 3; ++axis) lane.pressure[axis * problem.stride] = p[axis][mode.lane_of(l)];
      }
    }
    const int n = Mode::units(problem);
    for (int u = share_begin(n); u < share_begin(n, 1); ++u) mode.unload_unit(u, state, steps_done);
    const int pairs = problem.pairs;
    for (int c = share_begin(pairs); c < share_begin(pairs, 1); ++c) mode.unload_history(c, steps_done);
  }

  int share_begin(int count, int next = 0) const {
    return static_cast<int>(static_cast<int64_t>(count) * (rank + next) / team.size());
  }

  bool any_ends(int steps_done) const {
    for (int l = 0; l < block.count; ++l)
      if (block.lanes[l].steps == steps_done) return true;
    return false;
  }

  void run() {
    int steps = 0;
    for (int l = 0; l < block.count; ++l) steps = block.lanes[l].steps > steps ? block.lanes[l].steps : steps;
    const int n = Mode::units(problem), pairs = problem.pairs;
    for (int u = share_begin(n); u < share_begin(n, 1); ++u) mode.load_unit(u, state);
    for (int c = share_begin(pairs); c < share_begin(pairs, 1); ++c) mode.load_history(c);
    if (rank == 0) mode.load_dummies();
    team.barrier();
    Vec total{V{}, V{}, V{}};
    if (any_ends(0)) deliver(0, total);
    if (steps == 0) return;
    team.barrier();
    grains(false, true, 0);
    for (int step = 0; step < steps; ++step) {
      if (rank == 0) total = total + pressure(step);
      contacts();
      team.barrier();
      const bool more = step + 1 < steps;
      if (!any_ends(step + 1)) {
        grains(true, more, step + 1);
        continue;
      }
      grains(true, false, 0);
      deliver(step + 1, total);
      team.barrier();
      if (more) grains(false, true, step + 1);
    }
  }
};
