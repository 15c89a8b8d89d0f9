// A contact, its laws, a step of a grain and the walls, in lanes and in doubles: the same physics on any number. A
// number of a GPU is a double.

#include <initializer_list>

#include "check.h"
#include "numbers/dual.h"
#include "physics/contact.h"
#include "physics/motion.h"

namespace gmem {
namespace GMEM_ISA {

constexpr int kPoints = 6, kResults = 64;

// A contact of two spheres `apart` from each other that slides, with a history; appends to `to` what came out.
template <class V, class Law>
V* touch(Law law, V apart, V* to) {
  V row[kParameters];
  const double numbers[kParameters] = {0.3, 0.01, 1.5, 0.8, 1.0, 1.3, 0.47, 0.069, 0.66, 0.4, 0.145, 0.069, 0.9, 0.06};
  for (int r = 0; r < kParameters; ++r) row[r] = splat<V>(numbers[r]);
  const auto vec = [](double x, double y, double z) { return Vec<V>{splat<V>(x), splat<V>(y), splat<V>(z)}; };
  const ContactInput<V> meeting{apart * vec(0.6, 0.8, 0.0), vec(0.5, 0.7, 0.1),   vec(-0.4, -0.6, 0.1),
                                vec(2e-3, -1e-3, 3e-3),     vec(1e-3, 4e-3, 0.0), vec(0.0, -2e-3, 1e-3)};
  V history[10] = {splat<V>(2e-4), splat<V>(-1e-4), splat<V>(5e-4), splat<V>(0.03)};
  if (Law::kLayered) store_vec(history, vec(0.8, -0.6, 0.0)), history[kLastOverlap] = splat<V>(0.01);
  Contact<V> contact;
  relative_motion(meeting, dot(meeting.separation, meeting.separation), contact);
  contact.history = history;
  close(&contact, 1, row);
  const LawParameters<V> parameters(row + kLaw, row[kDt]);
  Segment<V> segment[kPoints];
  int stored;
  StoredSegments<V> segments{segment, 1, &stored, kPoints};
  if constexpr (Law::kLayered) {
    const auto ring = [&](int j) { return splat<V>(1e-4) * Flat<V>{splat<V>(j / 2), splat<V>(1 - j / 3)}; };
    const V outer = Reach<V, Law::variant>(history[kLastOverlap], parameters, splat<V>(kPoints - 2.0)).outer;
    store_layers(history + kLayers, segments.load(outer, kLacking<Law::variant>, false, ring));
    friction(law, &contact, 1, parameters, [&](int) { return segments; });
  } else {
    friction(law, &contact, 1, parameters);
  }
  const ContactLoads<V> found = push(contact);
  for (const Vec<V>& part : {found.force, found.torque_one, found.torque_other}) store_vec(to, part), to += 3;
  for (int q = 0; q < Law::kHistory; ++q) *to++ = history[q];
  if constexpr (Law::kLayered) {
    const V outer = Reach<V, Law::variant>(history[kLastOverlap], parameters, splat<V>(kPoints - 2.0)).outer;
    segments.unload(load_layers(history + kLayers), outer, kPoints,
                    [&](int, Flat<V> f) { *to++ = f.along, *to++ = f.across; });
  }
  return to;
}

template <class V>
V* move(V shift, V* to) {
  V row[kParameters];
  for (int r = 0; r < kParameters; ++r) row[r] = splat<V>(0.3 + 0.1 * r);
  const GrainParameters<V> p(row);
  const auto vec = [](double x, double y, double z) { return Vec<V>{splat<V>(x), splat<V>(y), splat<V>(z)}; };
  const Quaternion<V> q{splat<V>(0.8), vec(0.6, 0.0, 0.0)};
  const Grain<V> grain{shift * vec(1.0, 2.0, 2.0), q, vec(0.01, 0.02, 0.0), vec(0.0, 0.01, 0.03), vec(1e-3, 0.0, 0.0),
                       vec(0.0, 0.0, 1e-3)};
  const HalfStep<V> m = begin_step(p, grain);
  const WallState<V> box{vec(0.0, 0.0, 0.0), vec(9.0, 9.0, 9.0), vec(1e-3, 0.0, 0.0), vec(0.0, 0.0, -1e-3)};
  const double offsets[6] = {0.5, 0.1, 0.0, -0.4, 0.0, 0.3};
  WallForces<V> on{};
  spheres_of(p, m, offsets, 2, 0.6, box, on, [&](int, Vec<V> centre) { store_vec(to, centre), to += 3; });
  const Grain<V> g = end_step(p, false, m, on.force, on.torque);
  const Vec<V> walls = pressure(box, on.lower + on.upper);
  for (const Vec<V>& part : {g.position, g.orientation.v, g.velocity, g.spin, g.acceleration, g.spin_rate, walls})
    store_vec(to, part), to += 3;
  return to;
}

template <class Function>
void same(const Function& calculate) {
  Real a;
  for (int l = 0; l < W; ++l) a[l] = 1.9 + 0.15 * l / W + (l == W - 1 ? 0.2 : 0.0);  // the last ones are apart
  Real together[kResults];
  Dual<Real> dual[kResults];
  const auto count = calculate(a, together) - together;
  calculate(Dual<Real>{a, splat<Real>(1.0)}, dual);
  CHECK(count > 0 && count <= kResults);
  bool moves = false;
  for (int l = 0; l < W; ++l) {
    double alone[kResults], step = 1e-7, more[kResults];
    calculate(double{a[l]}, alone);
    calculate(double{a[l]} + step, more);
    for (int n = 0; n < count; ++n) {
      CHECK(close_to(together[n][l], alone[n], 1e-13));
      CHECK(dual[n].value[l] == together[n][l]);
      CHECK(close_to(dual[n].slope[l], (more[n] - alone[n]) / step, 1e-5));
      moves |= dual[n].slope[l] != 0.0;
    }
  }
  CHECK(moves);
}

void test() {
  same([](auto a, auto* to) { return touch(Frictionless{}, a, to); });
  same([](auto a, auto* to) { return touch(Hooke{}, a, to); });
  same([](auto a, auto* to) { return touch(Rescaled{}, a, to); });
  same([](auto a, auto* to) { return touch(Layered<Variant::exact>{}, a, to); });
  same([](auto a, auto* to) { return touch(Layered<Variant::averaged>{}, a, to); });
  same([](auto a, auto* to) { return touch(Layered<Variant::paper>{}, a, to); });
  same([](auto a, auto* to) { return move(a - splat<decltype(a)>(1.4), to); });
}

}  // namespace GMEM_ISA
}  // namespace gmem

int main() {
  gmem::GMEM_ISA::test();
  return failures != 0;
}
