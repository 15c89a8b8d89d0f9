// Reverse mode on a GPU. The steps go forwards and keep the numbers that the way back needs (`keeps` in step.h). Then
// each step is gone back through in three launches. In `touch_back` a thread has one candidate of one lane. In
// `gather_back` it has one sphere, and sums up the bars from its contacts. In `move_back` it has one grain, and goes
// back through the first half of the step and the second half of the step before. A fourth launch, `collect_walls`,
// sums up bars of the walls. The calculations are those of the CPU, as programs (physics/calculations.h). This file
// only passes derivatives on. "Bar" x is the derivative of the final results by x.
//
// Bars of grains and histories lie where the results of the call are. Bars of numbers that all grains share
// (parameters, places of spheres, walls) are added up for each grain and candidate, and these sums are added in a fixed
// order at the end.

#pragma once

#include "cuda/step.h"
#include "physics/calculations.h"

namespace gmem {
namespace GMEM_ISA {

using cuda::kOfConstants;
using cuda::kOfContact;

static_assert(cuda::kOfGrain == kState && cuda::kOfGrain == kMid, "a grain has other numbers");
static_assert(cuda::kOfInput == kInputs && kOfConstants == kGrainNumbers, "contacts or grains have other numbers");

// The parameters that contacts have derivatives by, and those of `LawParameters`, in the order of their sums.
constexpr int kRowOfContact[] = {kDt, kSpinning, kNormalStiffness, kNormalDamping};
constexpr int kLawRowOfContact[] = {0, 3, 4};  // mu, growth, dashpot

template <class Calculation>
constexpr bool gives_no_others() {
  const Program& p = program_of<Calculation>;
  for (int n = 0; n < p.nodes; ++n) {
    const Program::Node& now = p.node[n];
    if (now.step != Step::input || now.bar != Bar::add || !reached_in<Calculation>.node[n]) continue;
    bool known = false;
    for (const int row : kRowOfContact) known |= now.a == 1 && now.b == row;
    for (const int row : kLawRowOfContact) known |= now.a == 2 && now.b == row;
    if (!known) return false;
  }
  return true;
}

inline void add(const Column<double>& to, int row, double more) { to.put(row, to[row] + more); }

// How many rows a grain has in the sums over steps.
inline int of_grain(const Arguments& a) { return kOfConstants + 3 * a.spheres; }

// Copies the bars of the results, with which the way back begins, and sets the sums to zero. One thread for each lane
// of a candidate or grain.
template <class Law>
void take(const Arguments& a, int thread) {
  const ReplicaView<double> on(a, thread);
  const int item = on.item;
  if (item < a.rows) {
    const bool listed = a.valid.of(on.entry)[item];
    for (int n = 0; n < Law::kGiven; ++n) {
      const Place place = place_of<Law>(item, n);
      const int at = static_cast<int>(place.row);
      on.out(a.contacts.history_out[place.leaf]).put(at, listed ? on.in(a.back.history_in[place.leaf])[at] : 0.0);
    }
    const Column<double> sums = on.lane_of(a.back.of_contacts);
    for (int row = 0; row < kOfContact; ++row) sums.put(kOfContact * item + row, 0.0);
  }
  if (item >= a.grains) return;
  for (int f = 0; f < kFields; ++f) {
    const int size = f == 1 ? 4 : 3;
    for (int q = 0; q < size; ++q)
      on.out(a.grains_out[f]).put(item * size + q, on.in(a.back.fields_in[f])[item * size + q]);
  }
  const Column<double> sums = on.lane_of(a.back.of_grains);
  for (int row = 0; row < of_grain(a); ++row) sums.put(of_grain(a) * item + row, 0.0);
}

// Back through a contact of a step, if it touched in that step. One thread for each lane of a candidate.
template <class Law>
void touch_back(const Arguments& a, int step, int thread) {
  using Calculation = OneContact<Law>;
  static_assert(gives_no_others<Calculation>(), "a contact has a derivative by a parameter that has no sum");
  const ReplicaView<double> on(a, thread);
  const int row = on.item;
  if (row >= a.rows || !a.valid.of(on.entry)[row]) return;
  const int one = a.first.of(on.entry)[row], other = a.second.of(on.entry)[row];
  const unsigned all = static_cast<unsigned>(a.grains * a.spheres);
  if (static_cast<unsigned>(one) >= all || static_cast<unsigned>(other) >= all) return;
  unsigned char& touching = a.touching[on.of_lane(row)];
  const auto history_bar = [&](int n, const auto& what) {
    const Place place = place_of<Law>(row, n);
    const Column<double> bars = on.out(a.contacts.history_out[place.leaf]);
    return what(bars, static_cast<int>(place.row));
  };
  const Column<double> sphere = on.in(a.sphere), hot = on.in(a.hot);
  const Vec<double> here = sphere.vec(3 * one), there = sphere.vec(3 * other), gap = there - here;
  if (!bits_less(dot(gap, gap), 4.0)) {
    // A contact apart has a blank history, whatever it was before. The bars of the results may be other than zero for
    // all.
    if (!touching && step + 1 < a.steps) return;
    for (int n = 0; n < Law::kHistory; ++n)
      history_bar(n, [](const Column<double>& bars, int at) { return bars.put(at, 0.0); });
    touching = 0;
    return;
  }
  touching = 1;
  const int i = a.by_spheres.of(one), j = a.by_spheres.of(other);
  double own[Calculation::kNumbers], own_bar[Calculation::kNumbers], result_bar[Calculation::kResults];
  store_numbers(own, meeting(hot, 9 * i, 9 * j, gap, 0.5 * (here + there)));
  const Column<double> middle = on.lane_of(a.back.middle), kept = on.lane_of(a.back.history);
  const auto on_grain = [&](int grain, int number) { return middle.vec(kMid * grain + number); };
  store_vec(result_bar, on_grain(i, kMidForce) - on_grain(j, kMidForce));
  store_vec(result_bar + 3, on_grain(i, kMidTorque)), store_vec(result_bar + 6, on_grain(j, kMidTorque));
  for (int n = 0; n < Law::kHistory; ++n) {
    own[kInputs + n] = kept[Law::kHistory * (step * a.rows + row) + n];
    result_bar[9 + n] = history_bar(n, [](const Column<double>& bars, int at) { return bars[at]; });
  }
  double parameter[kParameters], law_numbers[kLawNumbers], parameter_bar[kParameters] = {}, law_bar[kLawNumbers] = {};
  read_parameters(on, parameter);
  store_numbers(law_numbers, LawParameters<double>(parameter + kLaw, parameter[kDt]));
  const double* in[] = {own, parameter, law_numbers, nullptr};
  double* bar[] = {own_bar, parameter_bar, law_bar, nullptr};
  pull_back<Calculation>(in, result_bar, bar);
  const Column<double> input = on.lane_of(a.back.input), sums = on.lane_of(a.back.of_contacts);
  for (int q = 0; q < kInputs; ++q) input.put(kInputs * row + q, own_bar[q]);
  for (int n = 0; n < Law::kHistory; ++n)
    history_bar(n, [&](const Column<double>& bars, int at) { return bars.put(at, own_bar[kInputs + n]); });
  int sum = kOfContact * row;
  for (const int of : kRowOfContact) add(sums, sum++, parameter_bar[of]);
  for (const int of : kLawRowOfContact) add(sums, sum++, law_bar[of]);
}

// The bars that the contacts of a sphere give to it and to its grain, summed in the order of its list.
enum Given { kGivenCentre = 0, kGivenPosition = 3, kGivenVelocity = 6, kGivenSpin = 9 };
static_assert(cuda::kOfSphere == kGivenSpin + 3, "spheres are given other numbers");

// One thread for each lane of a sphere.
inline void gather_back(const Arguments& a, int thread) {
  const ReplicaView<double> on(a, thread);
  if (on.item >= a.grains * a.spheres) return;
  const Column<double> input = on.lane_of(a.back.input);
  Vec<double> centre{}, position{}, velocity{}, spin{};
  for_touching(on, on.item, [&](int row, bool second) {
    const auto part = [&](int number) { return input.vec(kInputs * row + number); };  // see `ContactInput`
    const Vec<double> separation = part(0), lever_one = part(3), lever_other = part(6), closing = part(9);
    const Vec<double> point = 0.5 * (lever_one + lever_other);
    centre = centre + (second ? point + separation : point - separation);
    position = position - (second ? lever_other : lever_one);
    velocity = second ? velocity + closing : velocity - closing;
    spin = spin + part(second ? 15 : 12);
  });
  const Column<double> given = on.in(a.wall);
  const int at = a.of_wall * on.item;
  given.put(at + kGivenCentre, centre), given.put(at + kGivenPosition, position);
  given.put(at + kGivenVelocity, velocity), given.put(at + kGivenSpin, spin);
}

inline Grain<double> kept_grain(const ReplicaView<double>& on, int step) {
  double number[kState];
  const Column<double> state = on.lane_of(on.a.back.state);
  for (int q = 0; q < kState; ++q) number[q] = state[kState * (step * on.a.grains + on.item) + q];
  return load_numbers<Grain<double>>(number);
}

// A grain's constants, and the bars that one launch adds to theirs.
struct Constants {
  GrainParameters<double> are;
  double number[kGrainNumbers], bar[kGrainNumbers];
};

// Back through the centre of a sphere, and through the walls if it touches them. Adds to the bars of the grain midway
// with its rotation matrix (`turned`), of the sphere's place `body` in the grain, and of walls. Returns if it touches.
GMEM_INLINE bool sphere_back(const ReplicaView<double>& on, int sphere, const HalfStep<double>& half,
                             const WallState<double>& box, const double* turned, const double* body,
                             Vec<double> centre_bar, Constants& constants, double* turned_bar, double* body_bar,
                             double* walls_bar) {
  const Vec<double> centre = on.in(on.a.sphere).vec(3 * sphere);
  double walls[kWalls], result_bar[OneSphere<true>::kResults];
  store_numbers(walls, box);
  const double* in[] = {turned, constants.number, body, walls};
  double* bar[] = {turned_bar, constants.bar, body_bar, walls_bar};
  store_vec(result_bar, centre_bar);
  if (!bits_less(0.0, deepest(1.0, centre, box))) {
    pull_back<OneSphere<false>>(in, result_bar, bar);
    return false;
  }
  // The pressures are sums, over spheres, of the pressure by each sphere's forces on the walls.
  const Vec<double> lever = centre - half.position;
  WallForces<double> found{};
  touch_walls(constants.are, centre, lever, add_cross(half.velocity, half.spin, lever), box, found);
  double force[3], force_bar[3], pressure_bar[3];
  store_vec(force, found.lower + found.upper);
  store_vec(pressure_bar, on.in(on.a.back.pressure_in).vec(0));
  const double* of_pressure[] = {walls, force};
  double* pressure_gives[] = {walls_bar, force_bar};
  pull_back<WallPressure>(of_pressure, pressure_bar, pressure_gives);
  const Column<double> middle = on.lane_of(on.a.back.middle);
  store_vec(result_bar + 3, middle.vec(kMid * on.item + kMidForce));
  store_vec(result_bar + 6, middle.vec(kMid * on.item + kMidTorque));
  store_vec(result_bar + 9, load_vec(force_bar)), store_vec(result_bar + 12, load_vec(force_bar));
  pull_back<OneSphere<true>>(in, result_bar, bar);
  return true;
}

// Back through the first half of a step of a grain, with its spheres and their contacts with the walls.
GMEM_INLINE void begin_back(const ReplicaView<double>& on, int step, Constants& constants, double* state_bar) {
  const Arguments& a = on.a;
  const Grain<double> from = kept_grain(on, step);
  const HalfStep<double> half = begin_step(constants.are, from);
  double turned[kTurned], turned_bar[kTurned] = {}, walls_bar[kWalls] = {};
  store_numbers(turned, half);
  store_numbers(turned + kTurnedRotation, matrix(half.orientation));
  const Column<double> middle = on.lane_of(a.back.middle), sums = on.lane_of(a.back.of_grains);
  for (int q = 0; q < kMidForce; ++q) turned_bar[q] = middle[kMid * on.item + q];
  const WallState<double> box = on.walls(step);
  bool touches = false;
  for (int k = 0; k < a.spheres; ++k) {
    const int sphere = on.item * a.spheres + k;
    const auto given = [&](int number) { return on.in(a.wall).vec(a.of_wall * sphere + number); };
    const auto take_in = [&](int number, Vec<double> more) {
      store_vec(turned_bar + number, load_vec(turned_bar + number) + more);
    };
    take_in(kMidPosition, given(kGivenPosition)), take_in(kMidVelocity, given(kGivenVelocity));
    take_in(kMidSpin, given(kGivenSpin));
    const double body[] = {on.offset(3 * k), on.offset(3 * k + 1), on.offset(3 * k + 2)};
    double body_bar[3] = {};
    touches |= sphere_back(on, sphere, half, box, turned, body, given(kGivenCentre), constants, turned_bar, body_bar,
                           walls_bar);
    for (int q = 0; q < 3; ++q) add(sums, of_grain(a) * on.item + kOfConstants + 3 * k + q, body_bar[q]);
  }
  // The byte of its first sphere, which nothing else asks for on the way back, says whether there are bars of the
  // walls.
  a.touching[on.of_lane(a.rows + on.item * a.spheres)] = touches;
  for (int q = 0; touches && q < kWalls; ++q) on.lane_of(a.back.at_wall).put(kWalls * on.item + q, walls_bar[q]);
  double own[kState];
  store_numbers(own, from);
  const double* in[] = {own, constants.number};
  double* bar[] = {state_bar, constants.bar};
  pull_back<StepBegin<>>(in, turned_bar, bar);
}

// Back through the second half of a step of a grain, after the grain is brought to the middle of the step again.
GMEM_INLINE void end_back(const ReplicaView<double>& on, int step, Constants& constants, const double* state_bar) {
  const Arguments& a = on.a;
  const Grain<double> from = kept_grain(on, step);
  begin<double, false, false>(on, step, constants.are, from);
  double mid[kMid], mid_bar[kMid];
  store_numbers(mid, begin_step(constants.are, from));
  const Column<double> total = on.lane_of(a.back.total), middle = on.lane_of(a.back.middle);
  for (int q = 0; q < 6; ++q) mid[kMidForce + q] = total[6 * (step * a.grains + on.item) + q];
  const double* in[] = {mid, constants.number};
  double* bar[] = {mid_bar, constants.bar};
  if (a.isotropic) pull_back<StepEnd<true>>(in, state_bar, bar);
  else pull_back<StepEnd<false>>(in, state_bar, bar);
  for (int q = 0; q < kMid; ++q) middle.put(kMid * on.item + q, mid_bar[q]);
}

// Back through the beginning of a step, if there is one of that number, and through the end of the step before. Thread
// of grain and lane.
inline void move_back(const Arguments& a, int step, int thread) {
  const ReplicaView<double> on(a, thread);
  if (on.item >= a.grains) return;
  double parameter[kParameters], state_bar[kState];
  Constants constants{read_parameters(on, parameter), {}, {}};
  store_numbers(constants.number, constants.are);
  const auto for_fields = [&](const auto& each) {
    for (int f = 0, number = 0; f < kFields; ++f) {
      const int size = f == 1 ? 4 : 3;
      for (int q = 0; q < size; ++q) each(on.out(a.grains_out[f]), size * on.item + q, state_bar[number++]);
    }
  };
  if (step < a.steps) begin_back(on, step, constants, state_bar);
  else for_fields([](const Column<double>& bars, int at, double& bar) { bar = bars[at]; });
  if (step > 0) end_back(on, step - 1, constants, state_bar);
  else for_fields([](const Column<double>& bars, int at, double bar) { bars.put(at, bar); });
  const Column<double> sums = on.lane_of(a.back.of_grains);
  for (int q = 0; q < kOfConstants; ++q) add(sums, of_grain(a) * on.item + q, constants.bar[q]);
}

// Sums the bars of the walls of a step over a chunk of grains. One thread for each lane of a chunk and number of the
// walls.
inline void collect_walls(const Arguments& a, int step, int thread) {
  const ReplicaView<double> on(a, thread);
  const int chunk = on.item / kWalls, row = on.item % kWalls, chunks = Arguments::chunks(a.grains);
  if (chunk >= chunks) return;
  const Column<double> at_wall = on.lane_of(a.back.at_wall);
  double total = 0.0;
  for (int grain = chunk * kChunk; grain < (chunk + 1) * kChunk && grain < a.grains; ++grain)
    if (a.touching[on.of_lane(a.rows + grain * a.spheres)]) total += at_wall[kWalls * grain + row];
  on.lane_of(a.back.of_walls).put(kWalls * (step * chunks + chunk) + row, total);
}

// Sums over a chunk of those that are `stride` apart, in the place of its first: of grains, and of candidates. Thread
// of chunk and row, and lane.
inline void sum_up(const Arguments& a, int stride, int thread) {
  const ReplicaView<double> on(a, thread);
  const auto sum = [&](double* array, int rows, int many, int item) {
    const int first = item / rows * kChunk * stride, row = item % rows;
    if (first >= many) return;
    const Column<double> sums = on.lane_of(array);
    double total = sums[rows * first + row];
    for (int n = 1; n < kChunk && first + n * stride < many; ++n) total += sums[rows * (first + n * stride) + row];
    sums.put(rows * first + row, total);
  };
  const int of_grains = of_grain(a) * Arguments::chunks((a.grains + stride - 1) / stride);
  if (on.item < of_grains) return sum(a.back.of_grains, of_grain(a), a.grains, on.item);
  sum(a.back.of_contacts, kOfContact, a.rows, on.item - of_grains);
}

// The bars of the parameters, from those of the numbers that were made of them.
inline void parameters_back(const ReplicaView<double>& on) {
  const Arguments& a = on.a;
  const Column<double> of_grains = on.lane_of(a.back.of_grains), of_contacts = on.lane_of(a.back.of_contacts);
  double parameter[kParameters], parameter_bar[kParameters], result_bar[kLawNumbers + kGrainNumbers] = {};
  read_parameters(on, parameter);
  int sum = 0;
  double direct[kParameters] = {};
  for (const int row : kRowOfContact) direct[row] = a.rows ? of_contacts[sum++] : 0.0;
  for (const int row : kLawRowOfContact) result_bar[row] = a.rows ? of_contacts[sum++] : 0.0;
  for (int q = 0; q < kGrainNumbers; ++q) result_bar[kLawNumbers + q] = of_grains[q];
  const double* in[] = {parameter};
  double* bar[] = {parameter_bar};
  pull_back<ParameterNumbers>(in, result_bar, bar);
  const Column<double> out = on.out(a.back.parameters_out);
  for (int row = 0; row < kRows; ++row) out.put(row, row < kParameters ? parameter_bar[row] + direct[row] : 0.0);
}

// Sums, to the results of the call. Thread of what has them - all parameters, a number of a sphere's place, or one of
// the walls of a step - and lane.
inline void leave_back(const Arguments& a, int thread) {
  const ReplicaView<double> on(a, thread);
  if (on.item == 0) return parameters_back(on);
  const int place = on.item - 1, wall = place - 3 * a.spheres, chunks = Arguments::chunks(a.grains);
  if (wall < 0) return on.out(a.back.offsets_out).put(place, on.lane_of(a.back.of_grains)[kOfConstants + place]);
  if (wall >= kWalls * a.steps) return;
  const Column<double> of_walls = on.lane_of(a.back.of_walls);
  double total = 0.0;
  for (int chunk = 0; chunk < chunks; ++chunk)
    total += of_walls[kWalls * (wall / kWalls * chunks + chunk) + wall % kWalls];
  on.out(a.back.walls_out).put(wall, total);
}

}  // namespace GMEM_ISA
}  // namespace gmem
