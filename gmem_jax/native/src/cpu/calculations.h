// What reverse mode goes back through, as programs (numbers/program.h): a contact of each law, the two halves of a step of
// a grain, and one of its spheres.

#pragma once

#include "cpu/problem.h"
#include "numbers/program.h"
#include "physics/contact.h"
#include "physics/motion.h"

namespace gmem {
namespace GMEM_ISA {

// Rows of what is kept, and of the bars, of one grain: at the beginning of a step, the fields in order ...
enum StateRow { kStatePosition = 0, kStateQuaternion = 3, kStateVelocity = 7, kStateSpin = 10, kStateAcceleration = 13,
                kStateSpinRate = 16, kState = 19 };
// ... and midway, with the force and torque found there ...
enum MidRow { kMidPosition = 0, kMidQuaternion = 3, kMidVelocity = 7, kMidSpin = 10, kMidForce = 13, kMidTorque = 16,
              kMid = 19 };
// ... or, instead of these, how it is turned.
enum TurnedRow { kTurnedRotation = 13, kTurned = 22 };
// Rows of a contact's input; its history follows.
constexpr int kInputs = 18;

// Calls `each` for all numbers of a structure, in order.
template <class V, class Each>
constexpr void for_numbers(LawParameters<V>& law, const Each& each) {
  each(law.mu), each(law.spacing), each(law.inverse_spacing), each(law.growth), each(law.dashpot);
}
constexpr int kLawNumbers = 5;

template <class V, class Each>
constexpr void for_numbers(GrainParameters<V>& p, const Each& each) {
  each(p.dt), each(p.half_dt), each(p.drag), each(p.slowed), each(p.inverse_mass), each(p.wall_stiffness), each(p.normal_damping);
  each(p.gravity);
  for (int axis = 0; axis < 3; ++axis) each(p.inertia[axis]), each(p.inverse_inertia[axis]);
}
constexpr int kGrainNumbers = 14;

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

// To and from arrays of them.
template <class T>
inline void store_numbers(Real* to, T a) {
  for_numbers(a, [&](Real number) { *to++ = number; });
}
template <class T>
inline T load_numbers(const Real* from) {
  T a;
  for_numbers(a, [&](Real& number) { number = *from++; });
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

// Mindlin's rings where no lane comes to another one.
struct SameRings {
  Symbol end;

  constexpr Symbol last() const { return end; }
};
constexpr void reattach(SameRings&, Layers<Symbol>&, Symbol, Symbol, double) {}

// Arrays: the contact's input and history; the parameters; those of the law; and number `last` of `Reach`.
// Results: `ContactLoads`; the history.
template <class Law>
struct OneContact {
  static constexpr int kNumbers = kInputs + Law::kHistory, kResults = 9 + Law::kHistory;

  static constexpr Program record() {
    Program program;
    const auto meeting = inputs<ContactInput<Symbol>>(program, 0, Bar::set);
    Symbol history[Law::kHistory + 1] = {}, parameter[kParameters] = {};
    for (int q = 0; q < Law::kHistory; ++q) history[q] = input(program, 0, kInputs + q, Bar::set);
    for (int r = 0; r < kParameters; ++r) parameter[r] = input(program, 1, r, Bar::add);
    const auto law = inputs<LawParameters<Symbol>>(program, 2, Bar::add);
    Contact<Symbol> contact{};
    contact.history = history;
    relative_motion(meeting, dot(meeting.separation, meeting.separation), contact);
    close(&contact, 1, parameter);
    SameRings rings{};
    if constexpr (Law::kLayered) rings.end = input(program, 3, 0, Bar::none);
    rub<Law>(&contact, 1, law, static_cast<const Unequal<Symbol>*>(nullptr), [&](int) { return rings; });
    const ContactLoads<Symbol> found = push(contact);
    result(program, found.force), result(program, found.torque_one), result(program, found.torque_other);
    for (int q = 0; q < Law::kHistory; ++q) result(program, history[q]);
    return program;
  }
};

// Arrays: the grain's numbers; those of `GrainParameters`. Results: midway, and how it is turned.
struct StepBegin {
  static constexpr Program record() {
    Program program;
    const auto grain = inputs<Grain<Symbol>>(program, 0, Bar::set);
    const auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    const HalfStep<Symbol> half = begin_step(parameters, grain);
    results(program, half);
    results(program, matrix(half.orientation));
    return program;
  }
};

// Arrays: the grain's numbers midway, with force and torque; those of `GrainParameters`. Results: at the end.
template <bool isotropic>
struct StepEnd {
  static constexpr Program record() {
    Program program;
    const auto half = inputs<HalfStep<Symbol>>(program, 0, Bar::set);
    const auto force = inputs<Vec<Symbol>>(program, 0, Bar::set, kMidForce);
    const auto torque = inputs<Vec<Symbol>>(program, 0, Bar::set, kMidTorque);
    const auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    results(program, end_step(parameters, isotropic, half, force, torque));
    return program;
  }
};

// Arrays: the grain's numbers midway, and how it is turned; those of `GrainParameters`; where the sphere is in the grain;
// the walls. Results: its centre; force, torque, and the forces on lower and upper walls.
template <bool near>
struct OneSphere {
  static constexpr int kResults = 15;

  static constexpr Program record() {
    Program program;
    const auto half = inputs<HalfStep<Symbol>>(program, 0, Bar::add);
    const auto rotation = inputs<Matrix<Symbol>>(program, 0, Bar::add, kTurnedRotation);
    const auto parameters = inputs<GrainParameters<Symbol>>(program, 1, Bar::add);
    const auto body = inputs<Vec<Symbol>>(program, 2, Bar::add);
    const auto box = inputs<WallState<Symbol>>(program, 3, Bar::add);
    WallForces<Symbol> on{};
    result(program, sphere_of(parameters, half, rotation, body, near, box, on));
    if (!near) return program;
    result(program, on.force), result(program, on.torque), result(program, on.lower), result(program, on.upper);
    return program;
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
