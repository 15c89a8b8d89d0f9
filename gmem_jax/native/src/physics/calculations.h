// The calculations that reverse mode goes back through, as programs (numbers/program.h): a contact of each law, the two
// halves of a grain's step, a sphere of a grain and its friction at a wall, the pressures, and the parameters.
// The "bar" of a number is the derivative of the final result by it.

#pragma once

#include "numbers/program.h"
#include "physics/contact.h"
#include "physics/motion.h"

namespace gmem {
namespace GMEM_ISA {

// Rows of one grain's numbers, and of their bars. At the beginning of a step: the fields in order.
enum StateRow {
  kStatePosition = 0,
  kStateQuaternion = 3,
  kStateVelocity = 7,
  kStateSpin = 10,
  kStateAcceleration = 13,
  kStateSpinRate = 16,
  kState = 19
};
// Midway in a step: a `HalfStep`, and the force and torque found there.
enum MidRow {
  kMidPosition = 0,
  kMidQuaternion = 3,
  kMidVelocity = 7,
  kMidSpin = 10,
  kMidForce = 13,
  kMidTorque = 16,
  kMid = 19
};
// Midway in a step, with the rotation matrix in the place of force and torque.
enum TurnedRow { kTurnedRotation = 13, kTurned = 22 };
// Numbers of a `ContactInput`; the contact's history follows them.
constexpr int kInputs = 18;

// Calls `each` for all numbers of a structure, in order.
template <class V, class Each>
constexpr void for_numbers(LawParameters<V>& law, const Each& each) {
  each(law.mu), each(law.spacing), each(law.inverse_spacing), each(law.growth), each(law.dashpot);
}
constexpr int kLawNumbers = 5;

template <class V, class Each>
constexpr void for_numbers(GrainParameters<V>& p, const Each& each) {
  each(p.dt), each(p.half_dt), each(p.drag), each(p.slowed), each(p.inverse_mass), each(p.wall_stiffness),
      each(p.normal_damping);
  each(p.gravity);
  for (int axis = 0; axis < 3; ++axis) each(p.inertia[axis]), each(p.inverse_inertia[axis]);
}
constexpr int kGrainNumbers = 14;

template <class V, class Each>
constexpr void for_numbers(WallLaw<V>& walls, const Each& each) {
  for_numbers(walls.law, each), each(walls.quarter_dt), each(walls.normal_stiffness);
}
constexpr int kWallLawNumbers = kLawNumbers + 2;

template <class V, class Each>
constexpr void for_numbers(Vec<V>& a, const Each& each) {
  each(a.x), each(a.y), each(a.z);
}
template <class V, class Each>
constexpr void for_numbers(Quaternion<V>& a, const Each& each) {
  each(a.w), for_numbers(a.v, each);
}
template <class V, class Each>
constexpr void for_numbers(Matrix<V>& a, const Each& each) {
  for (int row = 0; row < 3; ++row) for_numbers(a.row[row], each);
}
template <class V, class Each>
constexpr void for_numbers(ContactInput<V>& a, const Each& each) {
  for_numbers(a.separation, each), for_numbers(a.lever_one, each), for_numbers(a.lever_other, each);
  for_numbers(a.velocity, each), for_numbers(a.spin_one, each), for_numbers(a.spin_other, each);
}
template <class V, class Each>
constexpr void for_numbers(Grain<V>& a, const Each& each) {
  for_numbers(a.position, each), for_numbers(a.orientation, each), for_numbers(a.velocity, each);
  for_numbers(a.spin, each), for_numbers(a.acceleration, each), for_numbers(a.spin_rate, each);
}
template <class V, class Each>
constexpr void for_numbers(HalfStep<V>& a, const Each& each) {
  for_numbers(a.position, each), for_numbers(a.orientation, each), for_numbers(a.velocity, each);
  for_numbers(a.spin, each);
}
template <class V, class Each>
constexpr void for_numbers(WallState<V>& a, const Each& each) {
  for_numbers(a.lower, each), for_numbers(a.upper, each);
  for_numbers(a.lower_velocity, each), for_numbers(a.upper_velocity, each);
}
template <class V, class Each>
constexpr void for_numbers(Cell<V>& a, const Each& each) {
  for_numbers(a.lower, each), for_numbers(a.lengths, each), for_numbers(a.rate, each);
}
constexpr int kCellNumbers = 9;

// Copy the numbers of a structure to an array, and from an array.
template <class V, class T>
inline void store_numbers(V* to, T a) {
  for_numbers(a, [&](V number) { *to++ = number; });
}
template <class T, class V>
inline T load_numbers(const V* from) {
  T a;
  for_numbers(a, [&](V& number) { number = *from++; });
  return a;
}

// A structure of inputs of a program: the numbers of array `array` from `first` on.
template <class T>
constexpr T inputs(Program& program, int array, Bar bar, int first = 0) {
  T a{};
  for_numbers(a, [&](Symbol& number) { number = input(program, array, first++, bar); });
  return a;
}

template <class T>
constexpr void results(Program& program, T a) {
  for_numbers(a, [&](const Symbol& number) { result(program, number); });
}

// Mindlin's segments of a contact whose outermost ring stays the same in all lanes.
struct SameRings {
  Symbol end;

  constexpr Symbol last() const { return end; }
};
constexpr void reattach(SameRings&, Layers<Symbol>&, Symbol, Symbol, double) {}

// The constants of one contact, where boxes are periodic or spheres differ in radius: see `Image` and `Radii`.
enum ContactConstant { kImage = 0, kReach = 3, kLean, kRoot, kContactConstants };
// The constants of one grain, of one of its spheres, and of that sphere at a plane.
enum GrainConstant { kCube = 0, kInverseCube, kInverseFifth, kGrainConstants };
enum SphereConstant { kSize = 0, kRadius, kSphereConstants, kNormal = kSphereConstants, kPlaneConstants = kNormal + 3 };

// Calculations are `general` where boxes are periodic or spheres differ in radius. If only one of the two holds, the
// numbers of the other have no effect.

// Arrays: the contact's input and history; the parameters; `LawParameters`; the ring number `last` of `Reach`; if
// general, the cell and the constants of the contact.
// Results: `ContactLoads`; the history; if general, the force through the faces of the cell.
template <class Law, bool general = false>
struct OneContact {
  static constexpr int kNumbers = kInputs + Law::kHistory, kResults = 9 + Law::kHistory + (general ? 3 : 0);

  static constexpr Program record() {
    Program program;
    auto meeting = inputs<ContactInput<Symbol>>(program, 0, Bar::set);
    Symbol history[Law::kHistory + 1] = {}, parameter[kParameters] = {};
    for (int q = 0; q < Law::kHistory; ++q) history[q] = input(program, 0, kInputs + q, Bar::set);
    for (int r = 0; r < kParameters; ++r) parameter[r] = input(program, 1, r, Bar::add);
    const auto law = inputs<LawParameters<Symbol>>(program, 2, Bar::add);
    Vec<Symbol> image{};
    Unequal<Symbol> unequal{};
    if (general) {
      const auto cell = inputs<Cell<Symbol>>(program, 4, Bar::add);
      image = inputs<Vec<Symbol>>(program, 5, Bar::none, kImage);
      move_to_image(meeting, image, cell);
      unequal = {input(program, 5, kReach, Bar::none), input(program, 5, kLean, Bar::none),
                 input(program, 5, kRoot, Bar::none)};
    }
    Contact<Symbol> contact{};
    contact.history = history;
    relative_motion(meeting, dot(meeting.separation, meeting.separation), contact);
    if constexpr (general)
      close<true>(&contact, 1, parameter, &unequal, [&](int) { return meeting.spin_other - meeting.spin_one; });
    else close(&contact, 1, parameter);
    SameRings rings{};
    if constexpr (Law::kLayered) rings.end = input(program, 3, 0, Bar::none);
    rub<Law>(&contact, 1, law, general ? &unequal : nullptr, [&](int) { return rings; });
    const ContactLoads<Symbol> found = push(contact);
    result(program, found.force), result(program, found.torque_one), result(program, found.torque_other);
    for (int q = 0; q < Law::kHistory; ++q) result(program, history[q]);
    if (general) result(program, through_faces(image, found.force));
    return program;
  }
};

// Arrays: the grain's numbers; `GrainParameters`; if general, the cell before the step and at its end.
// Results: the grain midway, and its rotation matrix.
template <bool general = false>
struct StepBegin {
  static constexpr Program record() {
    Program program;
    const auto grain = inputs<Grain<Symbol>>(program, 0, Bar::set);
    const auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    HalfStep<Symbol> half{};
    if (general) {
      const auto before = inputs<Cell<Symbol>>(program, 2, Bar::add), cell = inputs<Cell<Symbol>>(program, 3, Bar::add);
      half = begin_step(parameters, grain, before, cell);
    } else {
      half = begin_step(parameters, grain);
    }
    results(program, half);
    results(program, matrix(half.orientation));
    return program;
  }
};

// Arrays: the grain's numbers midway, with force and torque; `GrainParameters`; if general, the cell, the mass of a
// grain of size 1, the constants of the grain, and the part of the force that is friction of walls.
// Results: the grain at the end of the step; if general, its `section`.
template <bool isotropic, bool general = false>
struct StepEnd {
  static constexpr Program record() {
    Program program;
    const auto half = inputs<HalfStep<Symbol>>(program, 0, Bar::set);
    const auto force = inputs<Vec<Symbol>>(program, 0, Bar::set, kMidForce);
    const auto torque = inputs<Vec<Symbol>>(program, 0, Bar::set, kMidTorque);
    const auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    if (general) {
      const auto cell = inputs<Cell<Symbol>>(program, 2, Bar::add);
      const Symbol mass = input(program, 3, 0, Bar::add);
      Symbol power[kGrainConstants] = {};
      for (int n = 0; n < kGrainConstants; ++n) power[n] = input(program, 4, n, Bar::none);
      const auto by_mass = power[kInverseCube] * force, by_inertia = power[kInverseFifth] * torque;
      results(program, end_step(parameters, isotropic, half, by_mass, by_inertia, cell));
      const auto rubbed = inputs<Vec<Symbol>>(program, 5, Bar::set);
      result(program, section(cell, power[kCube] * mass, half, force - rubbed));
    } else {
      results(program, end_step(parameters, isotropic, half, force, torque));
    }
    return program;
  }
};

// Scales a sphere's place in the grain and the wall stiffness by the sphere's constants, array 4. Returns its radius.
constexpr Symbol scale(Program& program, Vec<Symbol>& body, GrainParameters<Symbol>& parameters) {
  const Symbol radius = input(program, 4, kRadius, Bar::none);
  body = input(program, 4, kSize, Bar::none) * body;
  parameters.wall_stiffness = root(radius) * parameters.wall_stiffness;
  return radius;
}

// Arrays: the grain's numbers midway, and its rotation matrix; `GrainParameters`; the sphere's place in the grain; the
// walls; if general, the constants of the sphere.
// Results: the sphere's centre; if walls are `near`, force, torque, and the forces on lower and upper walls.
template <bool near, bool general = false>
struct OneSphere {
  static constexpr int kResults = 15;

  static constexpr Program record() {
    Program program;
    const auto half = inputs<HalfStep<Symbol>>(program, 0, Bar::add);
    const auto rotation = inputs<Matrix<Symbol>>(program, 0, Bar::add, kTurnedRotation);
    auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    auto body = inputs<Vec<Symbol>>(program, 2, Bar::add);
    const auto box = inputs<WallState<Symbol>>(program, 3, Bar::add);
    const Symbol radius = general ? scale(program, body, parameters) : Symbol::of(1.0);
    WallForces<Symbol> on{};
    result(program, sphere_of(parameters, half, rotation, body, near, box, on, radius));
    if (!near) return program;
    result(program, on.force), result(program, on.torque), result(program, on.lower), result(program, on.upper);
    return program;
  }
};

// Arrays: the walls; the sum of the forces on the two walls of each axis. Results: the pressures.
struct WallPressure {
  static constexpr Program record() {
    Program program;
    const auto box = inputs<WallState<Symbol>>(program, 0, Bar::add);
    result(program, pressure(box, inputs<Vec<Symbol>>(program, 1, Bar::set)));
    return program;
  }
};

// Arrays: the parameters. Results: the numbers of `LawParameters`, then those of `GrainParameters`.
struct ParameterNumbers {
  static constexpr Program record() {
    Program program;
    Symbol parameter[kParameters] = {};
    for (int r = 0; r < kParameters; ++r) parameter[r] = input(program, 0, r, Bar::set);
    results(program, LawParameters<Symbol>(parameter + kLaw, parameter[kDt]));
    results(program, GrainParameters<Symbol>(parameter));
    return program;
  }
};

// Friction of a plane of the walls on a sphere, as a force and a torque on its grain. `at` and `moves` are position and
// velocity of the plane, and `normal` points to it; so `side` is -1 for a lower plane and 1 for an upper one.
template <class Law, class V, class SegmentsOf>
constexpr WallFriction<V> rub_plane(const HalfStep<V>& half, const Matrix<V>& rotation, Vec<V> body, V radius,
                                    V stiffness, V damping_time, V at, V moves, Vec<V> normal, const WallLaw<V>& walls,
                                    V* history, const SegmentsOf& segments_of, Contact<V>& contact) {
  const Vec<V> lever = rotation * body;
  const Vec<V> velocity = add_cross(half.velocity, half.spin, lever);
  const V side = normal.x + (normal.y + normal.z);
  const V inside = side * at - dot(half.position + lever, normal), closing = dot(velocity, normal) - side * moves;
  Unequal<V> stiffer{};
  stiffer.root = stiffness / walls.normal_stiffness;
  contact.history = history;
  meet_plane(normal, walls, damping_time, lever, velocity, half.spin, radius, radius - inside, closing, contact);
  rub<Law>(&contact, 1, walls.law, &stiffer, segments_of);
  return {contact.force, cross(contact.lever_one, contact.force)};
}

// Arrays: those of a general `OneSphere`, but instead of the walls the plane's position and, `kPlanes` further on, its
// velocity; the normal of the plane follows the constants. Then the history of the sphere at the plane; `WallLaw`; and
// the ring number `last` of `Reach`. Results: force and torque by friction of the wall, and the history.
template <class Law>
struct OnePlane {
  static constexpr int kResults = 6 + Law::kHistory;

  static constexpr Program record() {
    Program program;
    const auto half = inputs<HalfStep<Symbol>>(program, 0, Bar::add);
    const auto rotation = inputs<Matrix<Symbol>>(program, 0, Bar::add, kTurnedRotation);
    auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    auto body = inputs<Vec<Symbol>>(program, 2, Bar::add);
    const Symbol at = input(program, 3, 0, Bar::add), moves = input(program, 3, kPlanes, Bar::add);
    const auto normal = inputs<Vec<Symbol>>(program, 4, Bar::none, kNormal);
    const Symbol radius = scale(program, body, parameters);
    Symbol history[Law::kHistory + 1] = {};
    for (int q = 0; q < Law::kHistory; ++q) history[q] = input(program, 5, q, Bar::set);
    const auto walls = inputs<WallLaw<Symbol>>(program, 6, Bar::add);
    SameRings rings{};
    if constexpr (Law::kLayered) rings.end = input(program, 7, 0, Bar::none);
    Contact<Symbol> contact{};
    const auto on = rub_plane<Law>(
        half, rotation, body, radius, parameters.wall_stiffness, parameters.normal_damping, at, moves, normal, walls,
        history, [&](int) { return rings; }, contact);
    result(program, on.force), result(program, on.torque);
    for (int q = 0; q < Law::kHistory; ++q) result(program, history[q]);
    return program;
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
