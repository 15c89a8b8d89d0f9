// The runs of equal rings that a contact of the Mindlin law is stored in, against the rings themselves.

#include <cstdlib>

#include "check.h"
#include "numbers/dual.h"
#include "physics/runs.h"

namespace gmem {
namespace GMEM_ISA {

constexpr int kPoints = 12;

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
};

void check(const StoredRuns<Real>& runs, const Rings* rings) {
  Real outer;
  for (int l = 0; l < W; ++l) outer[l] = rings[l].outer;
  int seen = 0;
  runs.unload(outer, kPoints, [&](int j, Vec<Real> f) {
    CHECK(j == seen++);
    for (int l = 0; l < W; ++l) {
      CHECK(f.x[l] == rings[l].f[j]);
      CHECK(f.z[l] == -rings[l].f[j]);
    }
  });
  CHECK(seen == kPoints);
}

// Lanes on ways of their own: growth by many rings or one, shrinking, leaving and coming back, all points.
void test_ways() {
  std::srand(1);
  Run<Real> run[kPoints + 1], again[kPoints];
  int stored = 0, fresh = 0;
  StoredRuns<Real> runs{run, 1, &stored, kPoints}, loaded{again, 1, &fresh, kPoints};
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
    run[kPoints - 1] = run[kPoints] = {Vec<Real>{}, splat<Real>(7.0)};  // never used: there are as many runs as rings
    reattach(runs, before, outer);
    CHECK(stored <= static_cast<int>(largest(outer)) + 1);
    CHECK(run[kPoints - 1].start[0] == 7.0 && run[kPoints].start[0] == 7.0);
    const double push = 1.0 + std::rand() % 100;
    for (int k = 0; k < stored; ++k) {
      const Bits there = run[k].start <= outer;
      const Real filling = select(run[k].start < outer, splat<Real>(1.0), splat<Real>(0.5));
      const Vec<Real> f = filling * run[k].force, more = splat<Real>(push) * Vec<Real>{splat<Real>(1.0), Real{}, splat<Real>(-1.0)};
      run[k].force = zero_unless(there, f + more);
    }
    for (Rings& lane : rings) lane.change(0.5, push);
    check(runs, rings);
    loaded.load(outer, false, [&](int j) {
      Vec<Real> f{};
      for (int l = 0; l < W; ++l) f.x[l] = rings[l].f[j], f.z[l] = -rings[l].f[j];
      return f;
    });
    check(loaded, rings);
    CHECK(fresh <= stored);
    most |= stored == kPoints - 1;
    merged |= stored > 0 && stored < static_cast<int>(largest(outer));
  }
  CHECK(most && merged);
}

// Where values agree and slopes do not, rings are different.
void test_slopes() {
  Run<Dual<Real>> run[kPoints];
  int stored = 0;
  StoredRuns<Dual<Real>> runs{run, 1, &stored, kPoints};
  const auto load = [&](bool apart) {
    runs.load(splat<Dual<Real>>(5.0), apart, [](int j) {
      return Vec<Dual<Real>>{splat<Dual<Real>>(3.0), {splat<Real>(2.0), splat<Real>(j < 3)}, splat<Dual<Real>>(0.0)};
    });
  };
  load(false);
  CHECK(stored == 3);  // rings 0 to 2, 3 and 4, and the outermost
  CHECK(run[1].start[W - 1] == 3.0);
  load(true);
  CHECK(stored == 6);
}

}  // namespace GMEM_ISA
}  // namespace gmem

int main() {
  gmem::GMEM_ISA::test_ways();
  gmem::GMEM_ISA::test_slopes();
  return failures != 0;
}
