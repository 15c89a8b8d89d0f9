// The layers and segments of equal rings that a contact of the Mindlin law is stored in, against the rings themselves.

#include <cstdlib>

#include "check.h"
#include "numbers/dual.h"
#include "physics/segments.h"

namespace gmem {
namespace GMEM_ISA {

constexpr int kPoints = 12;
constexpr double kLacking = 0.5;

// Rings of one lane, one by one.
struct Rings {
  int outer = -1;
  double f[kPoints] = {};

  void reach(int now) {
    for (int j = now + 1; j < kPoints; ++j) f[j] = 0.0;
    outer = now;
  }
  void change(double filling, double push) {
    if (outer >= 0) f[outer] *= filling;
    for (int j = 0; j <= outer; ++j) f[j] += push;
  }
  double inside() const {
    double sum = outer > 0 ? -kLacking * f[0] : 0.0;
    for (int j = 0; j < outer; ++j) sum += f[j];
    return sum;
  }
};

struct Stored {
  StoredSegments<Real> segments;
  Layers<Real> layers;
};

void check(const Stored& stored, const Rings* rings) {
  Real outer;
  for (int l = 0; l < W; ++l) outer[l] = rings[l].outer;
  int seen = 0;
  stored.segments.unload(stored.layers, outer, kPoints, [&](int j, Flat<Real> f) {
    CHECK(j == seen++);
    for (int l = 0; l < W; ++l) {
      CHECK(f.along[l] == rings[l].f[j]);
      CHECK(f.across[l] == -rings[l].f[j]);
    }
  });
  for (int l = 0; l < W; ++l) {
    CHECK(stored.layers.inside.along[l] == rings[l].inside());
    CHECK(stored.layers.inside.across[l] == -rings[l].inside());
  }
  CHECK(seen == kPoints);
}

// Lanes on ways of their own: growth by many rings or one, shrinking, leaving and coming back, all points.
void test_ways() {
  std::srand(1);
  Segment<Real> segment[kPoints + 1], again[kPoints], copy[kPoints];
  int stored = 0, fresh = 0, copied = -1;
  Stored kept{{segment, 1, &stored, kPoints, copy, &copied}, {}}, loaded{{again, 1, &fresh, kPoints}, {}};
  Rings rings[W];
  Real outer = splat<Real>(-1.0);
  bool most = false, merged = false;
  for (int step = 0; step < 3000; ++step) {
    const Real before = outer;
    for (int l = 0; l < W; ++l) {
      const int way = std::rand() % 8, now = rings[l].outer;
      const int next = way == 0 ? std::rand() % kPoints - 1 : way < 3 ? now - 1 : way < 6 ? now + 1 : now;
      rings[l].reach(next < -1 ? -1 : next > kPoints - 2 ? kPoints - 2 : next);
      outer[l] = rings[l].outer;
    }
    segment[kPoints - 1] =
        segment[kPoints] = {Flat<Real>{}, splat<Real>(7.0)};  // never used: there are as many segments as rings
    const Layers<Real> former = kept.layers;
    const int were = stored;
    reattach(kept.segments, kept.layers, before, outer, kLacking);
    CHECK(copied == were);
    CHECK(stored <= static_cast<int>(largest(outer)) + 1);
    CHECK(segment[kPoints - 1].start[0] == 7.0 && segment[kPoints].start[0] == 7.0);
    for (int l = 0; l < W; ++l)  // a lane knows nothing of what the others do
      CHECK(before[l] != outer[l] || kept.layers.common.along[l] == former.common.along[l]);
    const double push = 1.0 + std::rand() % 100;
    const Flat<Real> more{splat<Real>(push), splat<Real>(-push)};
    const Real weight = zero_unless(outer > Real{}, outer - splat<Real>(kLacking));
    kept.layers.common = kept.layers.common + more;
    kept.layers.inside = fma(weight, more, kept.layers.inside);
    kept.layers.rim = zero_unless(Real{} <= outer, splat<Real>(0.5) * kept.layers.rim + more);
    for (Rings& lane : rings) lane.change(0.5, push);
    check(kept, rings);
    loaded.layers = loaded.segments.load(outer, kLacking, false, [&](int j) {
      Flat<Real> f{};
      for (int l = 0; l < W; ++l) f.along[l] = rings[l].f[j], f.across[l] = -rings[l].f[j];
      return f;
    });
    check(loaded, rings);
    CHECK(fresh <= stored);
    most |= stored == kPoints - 2;
    merged |= stored > 0 && stored < static_cast<int>(largest(outer)) - 1;
  }
  CHECK(most && merged);
}

// Where values agree and slopes do not, rings are different.
void test_slopes() {
  Segment<Dual<Real>> segment[kPoints];
  int stored = 0;
  StoredSegments<Dual<Real>> segments{segment, 1, &stored, kPoints};
  const auto load = [&](bool apart) {
    segments.load(splat<Dual<Real>>(5.0), 0.0, apart, [](int j) {
      return Flat<Dual<Real>>{splat<Dual<Real>>(3.0), {splat<Real>(2.0), splat<Real>(j < 3)}};
    });
  };
  load(false);
  CHECK(stored == 2);  // rings 0 to 2, 3 and 4; the outermost is none of them
  CHECK(segment[1].start[W - 1] == 3.0);
  load(true);
  CHECK(stored == 5);
}

}  // namespace GMEM_ISA
}  // namespace gmem

int main() {
  gmem::GMEM_ISA::test_ways();
  gmem::GMEM_ISA::test_slopes();
  return failures != 0;
}
