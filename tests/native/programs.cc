// Derivatives by programs that the compiler recorded are those of the tape, on which the same physics is recorded when it
// runs: of a contact of each law, of the two halves of a step, and of a sphere at the walls.

#include <initializer_list>

#include "check.h"
#include "numbers/tape.h"
#include "physics/calculations.h"

namespace gmem {
namespace GMEM_ISA {

constexpr int kRings = 6;

// Numbers between -1 and 1, the same in every run.
struct Random {
  unsigned state = 1;

  double operator()() { return (state = state * 1664525u + 1013904223u) / 2147483648.0 - 1.0; }
  Real lanes() {
    Real a;
    for (int l = 0; l < W; ++l) a[l] = (*this)();
    return a;
  }
};

// Leaves of the tape in the place of the numbers of a structure; their slots follow each other.
template <class T>
T leaves(const Real* from) {
  T a{};
  for_numbers(a, [&](Taped<Real>& number) { number = leaf(*from++); });
  return a;
}

template <class T>
void seed(T a, const Real*& bar) {
  for_numbers(a, [&](Taped<Real> number) {
    if (number.slot) tape<Real>->bar(number.slot) += *bar;
    ++bar;
  });
}

// Those that some leaves got, from slot `first` on, against those that a program gave; whether any is not zero.
bool same(int first, const Real* found, int count) {
  bool any = false;
  for (int n = 0; n < count; ++n)
    for (int l = 0; l < W; ++l) {
      CHECK(close_to(found[n][l], tape<Real>->bar(first + n)[l], 1e-11));
      any |= found[n][l] != 0.0;
    }
  return any;
}

// Lanes that stick, slide, load, unload and are apart.
template <class Law>
void contact() {
  using Calculation = OneContact<Law>;
  Random random;
  const double meeting[kInputs] = {1.17, 1.56,  0.1,  0.5,  0.7,  0.1, -0.4, -0.6,  0.1,
                                   2e-3, -1e-3, 3e-3, 1e-3, 4e-3, 0.0, 0.0,  -2e-3, 1e-3};
  const double numbers[kParameters] = {0.3, 0.01, 1.5, 0.8, 1.0, 1.3, 0.47, 0.069, 0.66, 0.4, 0.145, 0.069, 0.9, 0.06};
  Real own[Calculation::kNumbers], result_bar[Calculation::kResults], parameter[kParameters], of_law[kLawNumbers];
  for (int n = 0; n < kInputs; ++n)
    own[n] = splat<Real>(meeting[n]) * (splat<Real>(1.0) + splat<Real>(0.3) * random.lanes());
  for (int q = kInputs; q < Calculation::kNumbers; ++q) own[q] = splat<Real>(2e-3) * random.lanes();
  // Not too far into each other, and Mindlin's contacts in the same ring as before.
  for (int axis = 0; axis < 3; ++axis) {
    const Real spread = Law::kLayered ? splat<Real>(0.002) * random.lanes() : splat<Real>(0.04) * random.lanes();
    own[axis] = splat<Real>(meeting[axis]) * (splat<Real>(1.0) + spread);
  }
  if (Law::kHistory > kLastOverlap) {
    const Vec<Real> apart = load_vec(own);
    own[kInputs + kLastOverlap] = splat<Real>(2.0) - root(dot(apart, apart)) + splat<Real>(0.003) * random.lanes();
  }
  for (int r = 0; r < kParameters; ++r) parameter[r] = splat<Real>(numbers[r]);
  store_numbers(of_law, LawParameters<Real>(parameter + kLaw, parameter[kDt]));
  for (Real& bar : result_bar) bar = random.lanes();

  Real own_bar[Calculation::kNumbers], parameter_bar[kParameters] = {}, law_bar[kLawNumbers] = {};
  const Real last = splat<Real>(kRings - 2.0);
  const Real* in[] = {own, parameter, of_law, &last};
  Real* bar[] = {own_bar, parameter_bar, law_bar};
  pull_back<Calculation>(in, result_bar, bar);

  Tape<Real> recorded;
  const Recording<Real> recording(&recorded);
  const int first = recorded.mark().slots;
  const auto input = leaves<ContactInput<Taped<Real>>>(own);
  Taped<Real> memory[Law::kHistory + 1], row[kParameters];
  for (int q = 0; q < Law::kHistory; ++q) memory[q] = leaf(own[kInputs + q]);
  for (int r = 0; r < kParameters; ++r) row[r] = leaf(parameter[r]);
  const auto law = leaves<LawParameters<Taped<Real>>>(of_law);
  Contact<Taped<Real>> now;
  now.history = memory;
  relative_motion(input, dot(input.separation, input.separation), now);
  close(&now, 1, row);
  Segment<Taped<Real>> segment[kRings] = {};
  int stored = 1;
  bool looked = false;  // whether the rings were looked at, for which there is no program
  struct Watched : StoredSegments<Taped<Real>> {
    bool* looked;
    void remember() const { *looked = true; }
  };
  if constexpr (Law::kLayered) {
    friction(Law{}, &now, 1, law, [&](int) { return Watched{{segment, 1, &stored, kRings}, &looked}; });
  } else {
    friction(Law{}, &now, 1, law);
  }
  CHECK(!looked);
  const ContactLoads<Taped<Real>> found = push(now);
  const Real* seeds = result_bar;
  seed(found.force, seeds), seed(found.torque_one, seeds), seed(found.torque_other, seeds);
  for (int q = 0; q < Law::kHistory; ++q, ++seeds)
    if (memory[q].slot) recorded.bar(memory[q].slot) += *seeds;
  recorded.reverse({});
  CHECK(same(first, own_bar, Calculation::kNumbers));
  CHECK(same(first + Calculation::kNumbers, parameter_bar, kParameters));
  CHECK(same(first + Calculation::kNumbers + kParameters, law_bar, kLawNumbers) == (Law::kHistory > 0));
}

// A grain and constants, and what a program and the tape make of them.
struct Motion {
  Random random;
  Real numbers[kGrainNumbers], bar_of_numbers[kGrainNumbers] = {}, own[kTurned], own_bar[kTurned] = {},
                               result_bar[kTurned];
  Tape<Real> recorded;
  const Recording<Real> recording{&recorded};
  int first = recorded.mark().slots;

  Motion() {
    for (Real& a : numbers) a = splat<Real>(1.0) + splat<Real>(0.5) * random.lanes();
    for (Real& a : own) a = random.lanes();
    for (Real& a : result_bar) a = random.lanes();
  }

  void compare(int count) {
    recorded.reverse({});
    CHECK(same(first, own_bar, count));
    CHECK(same(first + count, bar_of_numbers, kGrainNumbers));
  }
};

void begin() {
  Motion m;
  const Real* in[] = {m.own, m.numbers};
  Real* bar[] = {m.own_bar, m.bar_of_numbers};
  pull_back<StepBegin<>>(in, m.result_bar, bar);
  const auto grain = leaves<Grain<Taped<Real>>>(m.own);
  const HalfStep<Taped<Real>> half = begin_step(leaves<GrainParameters<Taped<Real>>>(m.numbers), grain);
  const Real* seeds = m.result_bar;
  seed(half, seeds), seed(matrix(half.orientation), seeds);
  m.compare(kState);
}

template <bool isotropic>
void end() {
  Motion m;
  const Real* in[] = {m.own, m.numbers};
  Real* bar[] = {m.own_bar, m.bar_of_numbers};
  pull_back<StepEnd<isotropic>>(in, m.result_bar, bar);
  const auto half = leaves<HalfStep<Taped<Real>>>(m.own);
  const auto force = leaves<Vec<Taped<Real>>>(m.own + kMidForce), torque = leaves<Vec<Taped<Real>>>(m.own + kMidTorque);
  const Real* seeds = m.result_bar;
  seed(end_step(leaves<GrainParameters<Taped<Real>>>(m.numbers), isotropic, half, force, torque), seeds);
  m.compare(kMid);
}

template <bool near>
void sphere() {
  Motion m;
  Real walls[kWalls], wall_bar[kWalls] = {};
  for (int n = 0; n < kWalls; ++n)
    walls[n] = splat<Real>(n < 3 ? -1.5 : n < 6 ? 1.5 : 0.0) + splat<Real>(0.1) * m.random.lanes();
  const Real body[] = {splat<Real>(0.3), splat<Real>(-0.4), splat<Real>(0.2)};
  const Real* in[] = {m.own, m.numbers, body, walls};
  Real body_bar[3] = {};
  Real* bar[] = {m.own_bar, m.bar_of_numbers, body_bar, wall_bar};
  pull_back<OneSphere<near>>(in, m.result_bar, bar);
  const auto half = leaves<HalfStep<Taped<Real>>>(m.own);
  const auto rotation = leaves<Matrix<Taped<Real>>>(m.own + kTurnedRotation);
  const auto parameters = leaves<GrainParameters<Taped<Real>>>(m.numbers);
  const int first_body = m.recorded.mark().slots;
  const auto offset = leaves<Vec<Taped<Real>>>(body);
  const int first_wall = m.recorded.mark().slots;
  const auto box = leaves<WallState<Taped<Real>>>(walls);
  WallForces<Taped<Real>> on{};
  const Vec<Taped<Real>> centre = sphere_of(parameters, half, rotation, offset, near, box, on);
  const Real* seeds = m.result_bar;
  for (const Vec<Taped<Real>>& part : {centre, on.force, on.torque, on.lower, on.upper}) seed(part, seeds);
  m.recorded.reverse({});
  CHECK(same(m.first, m.own_bar, kTurned));
  CHECK(same(m.first + kTurned, m.bar_of_numbers, kGrainNumbers) == near);
  CHECK(same(first_body, body_bar, 3));
  CHECK(same(first_wall, wall_bar, kWalls) == near);
}

void test() {
  contact<Frictionless>();
  contact<Hooke>();
  contact<Rescaled>();
  contact<Layered<Variant::exact>>();
  contact<Layered<Variant::averaged>>();
  contact<Layered<Variant::paper>>();
  begin();
  end<true>();
  end<false>();
  sphere<true>();
  sphere<false>();
}

}  // namespace GMEM_ISA
}  // namespace gmem

int main() {
  gmem::GMEM_ISA::test();
  return failures != 0;
}
