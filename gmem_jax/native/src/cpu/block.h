// All steps of one block: velocity Verlet as in gmem_jax/physics/step.py, in two phases per step that the threads of a
// team share - contacts, then grains (the end of one step and the beginning of the next).
//
// Forces are summed in the order that the plan fixes, wall forces in chunks of grains of fixed size. So neither the
// number of threads, nor which of them did what, nor the way replicas share blocks can change a number.

#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>

#include "cpu/histories.h"
#include "cpu/problem.h"
#include "cpu/team.h"
#include "physics/contact.h"
#include "numbers/single.h"
#include "physics/motion.h"

namespace gmem {
namespace GMEM_ISA {

constexpr int kChunk = 16;  // grains per piece of work, and per partial sum of the wall forces
static_assert(kChunk % kMaxWidth == 0, "a chunk holds whole vectors of grains");

// The numbers of one unit (a grain of W replicas, or W grains of one replica). Contacts look at the hot ones;
enum Hot { kPosition = 0, kVelocity = 3, kSpin = 6, kForce = 9, kTorque = 12, kHot = 15 };
// only the integration needs the cold ones. Midway in a step velocities and spins are those of the half step.
enum Cold { kQuaternion = 0, kAcceleration = 4, kSpinRate = 7, kCold = 10 };

struct FieldPlace {
  bool hot;
  int slot, size;
};
constexpr FieldPlace kField[kFields] = {{true, kPosition, 3}, {false, kQuaternion, 4},   {true, kVelocity, 3},
                                        {true, kSpin, 3},     {false, kAcceleration, 3}, {false, kSpinRate, 3}};

// Where field number f of unit u is kept.
template <class V>
inline V* field_at(int f, int u, V* hot, V* cold) {
  V* unit = kField[f].hot ? hot + static_cast<std::size_t>(u) * kHot : cold + static_cast<std::size_t>(u) * kCold;
  return unit + kField[f].slot;
}

inline int chunks(const Problem& p) { return (p.grains + kChunk - 1) / kChunk; }

// A periodic box, and the forces through its faces.
template <class V>
struct Faces {
  Cell<V> cell;
  Vec<V> through;
};

// Bits of the planes at which a sphere of a unit has a history other than 0: now, and at any time since the call began.
struct KnownPlanes {
  unsigned char now, ever;
};

// The histories of contacts before a step changes them, which reverse mode keeps for the way back.
template <class V>
struct Trace {
  int* touching = nullptr;  // [candidates]: those that touch, in order, in each domain from its first candidate on
  int* end = nullptr;       // [candidates]: where those end; given in the place of the domain's first candidate
  V* history = nullptr;     // [candidates, kHistory] of the law: histories, in the order of `touching`
  Segment<V>* segment = nullptr;  // [candidates, Q]: Mindlin's, where a contact came to another ring
  int* segments = nullptr;        // [candidates]: how many; -1 where it stayed in its ring
};

// The memory of an `Engine`.
template <class Mode>
struct EngineLayout {
  using V = typename Mode::Number;
  static constexpr std::ptrdiff_t kNumber = sizeof(V) / sizeof(double);

  V* hot;                           // [units, kHot]
  V* cold;                          // [units, kCold]
  V* offsets;                       // of the pack, where they carry derivatives, [K, 3]
  double* walls;                    // partial sums of wall forces, [chunks, 2, 3] in the mode's own layout
  V* fastest;                       // squares of the largest half-step velocity and spin, [chunks, 2]
  double* sections;                 // in periodic boxes: partial sums of `section`, as `walls`
  V* through;                       // ... and the forces through their faces, [domains, 3]
  V* wall_history;                  // at walls with friction, [units, wall_rows, Law::kHistory]
  KnownPlanes* remembered;          // ... the planes where it is not 0, [units, spheres of a grain]
  bool* remembers;                  // ... whether a unit has such planes, [units]
  Segment<V>* wall_segment;         // ... of the Mindlin law, [Q, units, wall_rows]
  int *wall_segments, *wall_rings;  // ... their number, and `Marks::rings`, [units, wall_rows]
  V* rubbed;                        // in periodic boxes: the friction of walls in the force on a unit, [units, 3]
  typename Mode::Layout of_mode;

  void place(const Problem& p, const Block& block, Arena& arena) {
    const std::size_t units = Mode::units(p), chunks = gmem::GMEM_ISA::chunks(p);
    hot = arena.take<V>(units * kHot);
    cold = arena.take<V>(units * kCold);
    offsets = arena.take<V>(Mode::kDual ? static_cast<std::size_t>(p.spheres_per_grain) * 3 : 0);
    walls = arena.take<double>(chunks * 6 * kNumber);
    fastest = arena.take<V>(chunks * 2);
    sections = arena.take<double>(p.periodic ? chunks * 6 * kNumber : 0);
    through = arena.take<V>(p.periodic ? static_cast<std::size_t>(block.pack->plan->domains) * 3 : 0);
    wall_history = arena.take<V>(p.rubs ? units * p.wall_rows() * Mode::OfLaw::kHistory : 0);
    remembered = arena.take<KnownPlanes>(p.rubs ? units * p.spheres_per_grain : 0);
    remembers = arena.take<bool>(p.rubs ? units : 0);
    const std::size_t layered = p.rubs && Mode::OfLaw::kLayered ? units * p.wall_rows() : 0;
    wall_segment = arena.take<Segment<V>>(layered * p.points);
    wall_segments = arena.take<int>(layered);
    wall_rings = arena.take<int>(layered);
    rubbed = arena.take<V>(p.rubs && p.periodic ? units * 3 : 0);
    of_mode.place(p, *block.pack->plan, arena);
  }
};

template <class Mode>
struct Engine : EngineLayout<Mode> {
  using Layout = EngineLayout<Mode>;
  using V = typename Mode::Number;
  using Layout::hot, Layout::cold, Layout::offsets, Layout::walls, Layout::fastest, Layout::sections, Layout::through,
      Layout::kNumber;
  using Layout::wall_history, Layout::remembered, Layout::remembers;
  using Layout::wall_segment, Layout::wall_segments, Layout::wall_rings, Layout::rubbed;

  const Problem& problem;
  const Block& block;
  const Plan& plan;
  Team& team;
  const int rank;
  Mode mode;
  V parameter[kParameters];
  GrainParameters<V> constants;
  WallLaw<V> wall_law;   // where walls have friction
  double arm;            // of the outermost sphere centre of a grain, in the largest grain
  double outer;          // radius of a ball about the centre of a grain of size 1 that holds the grain
  WallState<V> box_now;  // walls in the step under way, except those of periodic axes
  double travel = 0.0;   // how much closer any two spheres can have come since the call began
  int current = 0;       // step under way
  bool deforms = false;  // whether the shape of a grain has a derivative
  Trace<V> trace;        // of contacts with walls, and only its segments; `Replicas::trace` has the rest

  Engine(const Problem& problem, const Block& block, Team& team, int rank, void* scratch)
      : problem(problem), block(block), plan(*block.pack->plan), team(team), rank(rank), mode(problem, block) {
    Arena arena{static_cast<char*>(scratch)};
    this->place(problem, block, arena);
    mode.use(this->of_mode, hot);
    for (int row = 0; row < kParameters; ++row) parameter[row] = mode.per_lane(&ReplicaArrays::parameters, row);
    constants = GrainParameters<V>(parameter);
    if (problem.rubs) wall_law = WallLaw<V>(parameter, mode.per_lane(&ReplicaArrays::parameters, kWallMu));
    arm = outer = 0.0;
    for (int k = 0; k < problem.spheres_per_grain; ++k) {
      const double* body = block.pack->offsets + 3 * k;
      const double length = __builtin_sqrt(body[0] * body[0] + body[1] * body[1] + body[2] * body[2]);
      const double reach = length + (block.pack->radii ? block.pack->radii[k] : 1.0);
      arm = length > arm ? length : arm;
      outer = reach > outer ? reach : outer;
    }
    arm *= plan.largest;
    if constexpr (Mode::kDual)
      for (int row = 0; row < 3 * problem.spheres_per_grain; ++row)
        for (int l = 0; l < W; ++l) deforms |= mode.offset(row).slope[l] != 0.0;
  }

  // Calls `function` with the sphere centres of a grain.
  template <class Function>
  GMEM_INLINE auto with_offsets(const Function& function) const {
    if constexpr (Mode::kDual)
      if (deforms) return function(offsets);
    return function(block.pack->offsets);
  }

  WallState<V> walls_at(int step) const {
    V w[kWalls];
    for (int row = 0; row < kWalls; ++row) w[row] = mode.per_lane(&ReplicaArrays::walls, step * kWalls + row);
    return {load_vec(w), load_vec(w + 3), load_vec(w + 6), load_vec(w + 9)};
  }

  // The edges of a periodic box at the end of a step, or, if `step` is negative, before the first step.
  WallState<V> cell_edges(int step) const {
    if (step >= 0) return walls_at(step);
    V edge[6];
    for (int row = 0; row < 6; ++row) edge[row] = mode.per_lane(&ReplicaArrays::parameters, kCell + row);
    WallState<V> box{};
    box.lower = load_vec(edge), box.upper = load_vec(edge + 3);
    return box;
  }

  // The periodic box with these edges.
  Cell<V> cell_at(int step) const { return Cell<V>::of(problem.periodic, cell_edges(step)); }

  // Unit u between two steps.
  Grain<V> still(int u) const {
    const V* h = hot + static_cast<std::size_t>(u) * kHot;
    const V* c = cold + static_cast<std::size_t>(u) * kCold;
    return {load_vec(h + kPosition),     {c[kQuaternion], load_vec(c + kQuaternion + 1)},
            load_vec(h + kVelocity),     load_vec(h + kSpin),
            load_vec(c + kAcceleration), load_vec(c + kSpinRate)};
  }

  // Stores unit u midway in a step, and finds its spheres and the forces of the walls.
  GMEM_INLINE void begin(int u, const HalfStep<V>& m, const WallState<V>& box, double* wall_sums, V* speeds) {
    V* h = hot + static_cast<std::size_t>(u) * kHot;
    V* c = cold + static_cast<std::size_t>(u) * kCold;
    speeds[0] = max(speeds[0], dot(m.velocity, m.velocity));
    speeds[1] = max(speeds[1], dot(m.spin, m.spin));
    c[kQuaternion] = m.orientation.w;
    store_vec(c + kQuaternion + 1, m.orientation.v);
    store_vec(h + kPosition, m.position);
    store_vec(h + kVelocity, m.velocity);
    store_vec(h + kSpin, m.spin);
    WallForces<V> on{};
    bool near = false;
    if (plan.size) {
      WallForces<V> found{};
      near = unequal_spheres(u, found);
      if (near) on = found;
    } else
      near = with_offsets([&](const auto* offsets) __attribute__((always_inline)) {
        return spheres_of(constants, m, offsets, problem.spheres_per_grain, arm, box, on,
                          [&](int k, Vec<V> centre) { mode.put_sphere(u, k, centre); });
      });
    WallFriction<V> friction{};
    if (problem.rubs && (near || remembers[u])) {
      friction = rub(u);
      on.force = on.force + friction.force, on.torque = on.torque + friction.torque;
    }
    if (problem.rubs && problem.periodic) store_vec(rubbed + 3 * static_cast<std::size_t>(u), friction.force);
    mode.put_grain(u, m.position, m.velocity, m.spin, on.force, on.torque);
    if (near) mode.add_walls(u, wall_sums, on.lower, on.upper);
  }

  // A function apart from `begin`, which reads the numbers that `begin` has stored: so `begin` keeps those of equal
  // spheres in registers.
  __attribute__((noinline)) bool unequal_spheres(int u, WallForces<V>& on) {
    const HalfStep<V> m = half_step_of(u);
    return with_offsets([&](const auto* offsets) __attribute__((always_inline)) {
      return spheres_of(constants, m, offsets, block.pack->radii, problem.spheres_per_grain,
                        mode.size_of(u, &Size::one), outer, box_now, on,
                        [&](int k, Vec<V> centre) { mode.put_sphere(u, k, centre); });
    });
  }

  // Friction of the walls on unit u; a function apart from `begin` for the same reason.
  __attribute__((noinline)) WallFriction<V> rub(int u) {
    using Law = typename Mode::OfLaw;
    const HalfStep<V> m = half_step_of(u);
    WallFriction<V> on{};
    if constexpr (std::is_same<V, typename Mode::OfContacts>::value) {
      const Matrix<V> rotation = matrix(m.orientation);
      GrainParameters<V> own = constants;
      unsigned any = 0;
      for (int k = 0; k < problem.spheres_per_grain; ++k) {
        const V size = plan.size ? mode.size_of(u, &Size::one) : splat<V>(1.0);
        const V radius = plan.size ? splat<V>(block.pack->radii[k]) * size : size;
        if (plan.size) own.wall_stiffness = root(radius) * constants.wall_stiffness;
        const Vec<V> body = with_offsets([&](const auto* offsets) { return body_at<V>(offsets + 3 * k); });
        const Vec<V> lever = rotation * (plan.size ? size * body : body);
        const std::size_t first = wall_row(u, kPlanes * k);
        KnownPlanes& planes = remembered[first / kPlanes];
        const unsigned now = rub_walls<Law>(
            own, wall_law, m.position + lever, lever, add_cross(m.velocity, m.spin, lever), m.spin, box_now, radius,
            wall_history + first * Law::kHistory, planes.now, [&](int w) { return wall_segments_of(first + w); }, on);
        planes = {static_cast<unsigned char>(now), static_cast<unsigned char>(planes.ever | now)};
        any |= now;
      }
      remembers[u] = any != 0;
    }
    return on;
  }

  // Mindlin's segments in a row of the histories at walls.
  StoredSegments<V> wall_segments_of(std::size_t row) const {
    const std::ptrdiff_t rows = static_cast<std::ptrdiff_t>(Mode::units(problem)) * problem.wall_rows();
    StoredSegments<V> found{wall_segment + row, rows, wall_segments + row, problem.points};
    if (trace.segments) found.seen = trace.segment + row * problem.points, found.seen_count = trace.segments + row;
    return found;
  }

  // The outermost ring in a row of these histories.
  V wall_outermost(std::size_t row) const {
    using Law = typename Mode::OfLaw;
    const V last = splat<V>(problem.points - 2.0);
    return Reach<V, Law::variant>(wall_history[row * Law::kHistory + kLastOverlap], wall_law.law, last).outer;
  }

  // The row in the histories at walls, for row `row` of those of unit u.
  std::size_t wall_row(int u, int row) const { return static_cast<std::size_t>(u) * problem.wall_rows() + row; }

  // Calls `each(row, of_all, planes)` for the rows of unit u in the histories at walls. `row` counts those of a grain,
  // `of_all` those of all grains; `planes` are the known planes of the row's sphere.
  template <class Each>
  void for_walls(int u, const Each& each) const {
    for (int row = 0; row < problem.wall_rows(); ++row)
      each(row, wall_row(u, row), remembered[wall_row(u, row) / kPlanes]);
  }

  // Copies the histories at walls of unit u from the arrays of the call ...
  void load_walls(int u) {
    using Law = typename Mode::OfLaw;
    remembers[u] = false;
    for_walls(u, [&](int row, std::size_t of_all, KnownPlanes& planes) {
      const int w = row % kPlanes;
      V* const numbers = wall_history + of_all * Law::kHistory;
      bool any = Mode::kDual;  // a derivative may be where the value is 0
      for (int q = 0; q < Law::kGiven; ++q) {
        numbers[q] = mode.wall_in(u, row, [q](std::ptrdiff_t at) { return place_of<Law>(at, q); });
        any |= (bits_less(numbers[q], V{}) | bits_less(V{}, numbers[q])) != 0;
      }
      if (w == 0) planes = {};
      if constexpr (Law::kLayered) {
        const V outer = wall_outermost(of_all);
        wall_rings[of_all] = rings_of(problem, outer);
        load_rings<Law>(numbers, wall_segments_of(of_all), outer, mode.apart, [&](int j, int axis) {
          return mode.wall_in(u, row, [&](std::ptrdiff_t at) { return ring_place(problem, at, j, axis); });
        });
      }
      if (any) planes.now |= 1u << w, planes.ever |= 1u << w, remembers[u] = true;
    });
  }

  // ... and back.
  void unload_walls(int u, int steps_done) const {
    using Law = typename Mode::OfLaw;
    for_walls(u, [&](int row, std::size_t of_all, const KnownPlanes& planes) {
      if (problem.history_aliased && !(planes.ever >> row % kPlanes & 1)) return;
      const V* const numbers = wall_history + of_all * Law::kHistory;
      for (int q = 0; q < Law::kGiven; ++q)
        mode.wall_out(u, row, [q](std::ptrdiff_t at) { return place_of<Law>(at, q); }, numbers[q], steps_done);
      if constexpr (Law::kLayered)
        unload_rings(problem, numbers, wall_segments_of(of_all), wall_outermost(of_all), wall_rings[of_all],
                     [&](int j, int axis, const V& number) {
                       mode.wall_out(
                           u, row, [&](std::ptrdiff_t at) { return ring_place(problem, at, j, axis); }, number,
                           steps_done);
                     });
    });
  }

  // Unit u midway in a step, which `begin` stored in the places of `still`.
  HalfStep<V> half_step_of(int u) const {
    const Grain<V> g = still(u);
    return {g.position, g.orientation, g.velocity, g.spin};
  }

  // Second half of a step: accelerations and velocities. In a periodic box `cell` adds each `section` to `sums`.
  Grain<V> finish(int u, const Cell<V>* cell, double* sums) const {
    Vec<V> force, torque;
    mode.total_force(u, force, torque);
    const HalfStep<V> half = half_step_of(u);
    if (cell) {
      const V mass = plan.size ? mode.size_of(u, &Size::cube) * parameter[kMass] : parameter[kMass];
      const Vec<V> by_contacts = problem.rubs ? force - load_vec(rubbed + 3 * static_cast<std::size_t>(u)) : force;
      mode.add_walls(u, sums, section(*cell, mass, half, by_contacts), Vec<V>{});
    }
    if (plan.size) {
      force = mode.size_of(u, &Size::inverse_cube) * force;
      torque = mode.size_of(u, &Size::inverse_fifth) * torque;
    }
    return cell ? end_step(constants, problem.isotropic, half, force, torque, *cell)
                : end_step(constants, problem.isotropic, half, force, torque);
  }

  void keep(int u, const Grain<V>& g) {
    V* h = hot + static_cast<std::size_t>(u) * kHot;
    V* c = cold + static_cast<std::size_t>(u) * kCold;
    store_vec(h + kVelocity, g.velocity);
    store_vec(h + kSpin, g.spin);
    store_vec(c + kAcceleration, g.acceleration);
    store_vec(c + kSpinRate, g.spin_rate);
  }

  // One pass over the grains: `ends` the step in progress and/or `begins` step number `step`.
  void grains(bool ends, bool begins, int step) {
    const int periodic = problem.periodic;
    const WallState<V> box = box_now = begins ? without(periodic, walls_at(step)) : WallState<V>{};
    const Cell<V> ended = periodic ? cell_at(current) : Cell<V>{}, before = periodic ? cell_at(step - 1) : Cell<V>{};
    const Cell<V> cell = periodic && begins ? cell_at(step) : Cell<V>{};
    team.share(Team::kGrains, rank, chunks(problem));
    for (int chunk; team.take(Team::kGrains, rank, &chunk);) {
      double* sums = walls + static_cast<std::size_t>(chunk) * 6 * kNumber;
      V* speeds = fastest + 2 * static_cast<std::size_t>(chunk);
      double* of_sections = periodic ? sections + static_cast<std::size_t>(chunk) * 6 * kNumber : nullptr;
      if (ends && periodic) std::memset(of_sections, 0, 6 * sizeof(V));
      if (begins) {
        std::memset(sums, 0, 6 * sizeof(V));
        speeds[0] = speeds[1] = V{};
      }
      const int first = Mode::unit_of(chunk * kChunk), last = Mode::unit_of((chunk + 1) * kChunk);
      for (int u = first; u < last && u < Mode::units(problem); ++u) {
        const Grain<V> grain = ends ? finish(u, periodic ? &ended : nullptr, of_sections) : still(u);
        if (!begins) keep(u, grain);
        else
          begin(u, periodic ? begin_step(constants, grain, before, cell) : begin_step(constants, grain), box, sums,
                speeds);
      }
    }
    team.barrier();
    if (begins) current = step;
    if (begins) add_travel(cell);
  }

  // A sphere moves by at most dt (|v| + |spin| arm) in a step; two may approach each other by twice that. The strain of
  // a periodic box brings grains closer by dt times its rate times the distance of their centres. For spheres no
  // farther apart than `Plan::far`, that distance is at most `Plan::far` + 2 arm.
  void add_travel(const Cell<V>& cell) {
    V speed{}, spin{};
    for (int chunk = 0; chunk < chunks(problem); ++chunk) {
      speed = max(speed, fastest[2 * chunk]);
      spin = max(spin, fastest[2 * chunk + 1]);
    }
    const V step = parameter[kDt] * fma(splat<V>(arm), root(spin), root(speed));
    travel += 2.0 * (1.0 + 1e-9) * largest(step);
    if (!problem.periodic) return;
    const V strain = parameter[kDt] *
                     (max(cell.rate.x, -cell.rate.x) + max(cell.rate.y, -cell.rate.y) + max(cell.rate.z, -cell.rate.z));
    travel += (1.0 + 1e-9) * (plan.far + 2.0 * arm) * largest(strain);
  }

  void contacts() {
    using C = typename Mode::OfContacts;
    C parameter[kParameters];
    for (int row = 0; row < kParameters; ++row) parameter[row] = convert<C>(this->parameter[row]);
    const LawParameters<C> law(parameter + kLaw, parameter[kDt]);
    team.share(Team::kContacts, rank, plan.domains);
    const Cell<V> cell = problem.periodic ? cell_at(current) : Cell<V>{};
    for (int domain; team.take(Team::kContacts, rank, &domain);) {
      Faces<V> faces{cell, {}};
      mode.contacts(plan.domain_candidate[domain], plan.domain_candidate[domain + 1], parameter, law, travel, faces);
      if (problem.periodic) store_vec(through + 3 * static_cast<std::size_t>(domain), faces.through);
    }
    team.barrier();
  }

  // p of the periodic axes in the step that has just ended.
  Vec<V> section_pressure_at(int step) const {
    return section_pressure(problem.periodic, walls_at(step), cell_at(step), mode.sum_walls(sections, chunks(problem)),
                            sum_through());
  }

  Vec<V> sum_through() const {
    Vec<V> sum{};
    for (int domain = 0; domain < plan.domains; ++domain)
      sum = sum + load_vec(through + 3 * static_cast<std::size_t>(domain));
    return sum;
  }

  // p of each axis in `step`.
  Vec<V> pressure_at(int step) const { return pressure(walls_at(step), mode.sum_walls(walls, chunks(problem))); }

  int share_begin(int count, int next = 0) const {
    return static_cast<int>(static_cast<int64_t>(count) * (rank + next) / team.size());
  }

  void load() {
    const int units = Mode::units(problem);
    for (int u = share_begin(units); u < share_begin(units, 1); ++u) mode.load_unit(u, hot, cold);
    for (int u = share_begin(units); problem.rubs && u < share_begin(units, 1); ++u) load_walls(u);
    const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
    for (int c = share_begin(plan.candidates); c < share_begin(plan.candidates, 1); ++c) load_history(mode, c, law);
    if constexpr (Mode::kDual)
      for (int row = 0; rank == 0 && row < 3 * problem.spheres_per_grain; ++row) offsets[row] = mode.offset(row);
    if (rank == 0) mode.load_dummies();
    team.barrier();
  }

  bool any_ends(int steps_done) const {
    for (int l = 0; l < block.count; ++l)
      if (block.lanes[l].steps == steps_done) return true;
    return false;
  }

  // Write the results of the lanes that have done all their steps.
  void deliver(int steps_done, Vec<V> pressure) {
    if (rank == 0) mode.unload_pressure(pressure, steps_done);
    const int units = Mode::units(problem);
    for (int u = share_begin(units); u < share_begin(units, 1); ++u) mode.unload_unit(u, hot, cold, steps_done);
    for (int u = share_begin(units); problem.rubs && u < share_begin(units, 1); ++u) unload_walls(u, steps_done);
    const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
    for (int c = share_begin(plan.candidates); c < share_begin(plan.candidates, 1); ++c)
      unload_history(mode, c, law, steps_done);
    for (int c = share_begin(plan.padding); c < share_begin(plan.padding, 1); ++c) unload_padding(mode, c, steps_done);
    team.barrier();
  }

  void run() {
    int steps = 0;
    for (int l = 0; l < block.count; ++l) steps = block.lanes[l].steps > steps ? block.lanes[l].steps : steps;
    load();
    Vec<V> total{};
    if (any_ends(0)) deliver(0, total);
    if (steps > 0) grains(false, true, 0);
    for (int step = 0; step < steps; ++step) {
      if (rank == 0) total = total + pressure_at(step);
      contacts();
      const bool more = step + 1 < steps;
      const bool delivers = any_ends(step + 1);
      grains(true, more && !delivers, step + 1);
      if (problem.periodic) {
        if (rank == 0) total = total + section_pressure_at(step);
        team.barrier();  // before other threads overwrite the sums
      }
      if (!delivers) continue;
      deliver(step + 1, total);
      if (more) grains(false, true, step + 1);
    }
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
