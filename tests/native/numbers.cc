// Numbers: lanes against doubles, derivatives forwards against differences, backwards against forwards.

#include <initializer_list>
#include <limits>

#include "check.h"
#include "numbers/dual.h"
#include "numbers/rows.h"
#include "numbers/single.h"
#include "numbers/tape.h"
#include "physics/rotation.h"

namespace gmem {
namespace GMEM_ISA {

Real lanes(double first) {
  Real a;
  for (int l = 0; l < W; ++l) a[l] = first + 0.37 * l;
  return a;
}

// Something of everything that the physics asks of a number and of a vector.
template <class V>
V everything(Vec<V> a, Vec<V> b, V s) {
  const V length = root(dot(a, a)), inverse = inverse_root(dot(b, b));
  const Vec<V> turned = add_cross(fma(s, a, b), cross(a, b), inverse * b);
  const V mixed = fms(s, length, inverse) / fnma(s, inverse, length + splat<V>(3.0));
  const V chosen = select(s < length, mixed * s, mixed - s);
  const Quaternion<V> q = turn(Quaternion<V>{splat<V>(0.8), splat<V>(0.3) * a}, turned);
  const Vec<V> seen = matrix(q) * (turned - a) + transposed(matrix(q), -b);
  const Vec<V> kept = zero_unless(s > splat<V>(0.0), fnma(chosen, seen, a));
  return dot(kept, b) + chosen * zero_unless(length <= s, inverse) + q.w;
}

struct Point {
  Vec<Real> a, b;
  Real s;
};

Point point() { return {{lanes(0.3), lanes(-1.1), lanes(0.7)}, {lanes(0.9), lanes(0.2), lanes(-1.4)}, lanes(0.6)}; }

double& number(Point& p, int which, int l) {
  Real* const numbers[7] = {&p.a.x, &p.a.y, &p.a.z, &p.b.x, &p.b.y, &p.b.z, &p.s};
  return reinterpret_cast<double*>(numbers[which])[l];
}

Real value(const Point& p) { return everything(p.a, p.b, p.s); }

void lanes_are_doubles() {
  Point p = point();
  const Real together = value(p);
  for (int l = 0; l < W; ++l) {
    double n[7];
    for (int which = 0; which < 7; ++which) n[which] = number(p, which, l);
    const double alone = everything(Vec<double>{n[0], n[1], n[2]}, Vec<double>{n[3], n[4], n[5]}, n[6]);
    CHECK(close_to(together[l], alone, 1e-13));  // their inverse roots differ in the last digits
  }
}

void elementary_functions() {
  const Real a = lanes(0.05);
  for (int l = 0; l < W; ++l) {
    CHECK(root(a)[l] == std::sqrt(a[l]));
    CHECK(close_to(inverse_root(a)[l] * std::sqrt(a[l]), 1.0, 4e-16));
    CHECK(floor_of(splat<Real>(7.0) * a)[l] == std::floor(7.0 * a[l]));
    CHECK(select(a < splat<Real>(0.5), a, splat<Real>(-1.0))[l] == (a[l] < 0.5 ? a[l] : -1.0));
    CHECK(max(a, splat<Real>(0.5))[l] == std::fmax(a[l], 0.5));
    CHECK((bits_less(a, splat<Real>(0.5)) >> l & 1u) == (a[l] < 0.5 ? 1u : 0u));
  }
  CHECK(root(Real{})[0] == 0.0);
  CHECK(smallest(a) == a[0] && largest(a) == a[W - 1]);
  const double all_sizes[] = {1e-290, 3e-80, 1e-7, 0.99, 1.0, 4.0, 6e55, 1e290};
  for (const double x : all_sizes) CHECK(close_to(inverse_root(splat<Real>(x))[0] * std::sqrt(x), 1.0, 4e-16));
}

void rows_are_columns_transposed() {
  const Vec<Real> a{lanes(1.0), lanes(20.0), lanes(300.0)};
  Row rows[2 * W];
  store_rows(rows, 2, a);
  for (int l = 0; l < W; ++l) CHECK(rows[2 * l][0] == a.x[l] && rows[2 * l][1] == a.y[l] && rows[2 * l][2] == a.z[l]);
  const Vec<Real> back = columns(load_rows([&](int l) { return rows + 2 * l; }));
  for (int l = 0; l < W; ++l) CHECK(back.x[l] == a.x[l] && back.y[l] == a.y[l] && back.z[l] == a.z[l]);
}

// The derivative by one of the seven numbers, in all lanes.
Real slope(const Point& p, int which) {
  const auto dual = [&](Real a, int number) { return Dual<Real>{a, number == which ? splat<Real>(1.0) : Real{}}; };
  const Vec<Dual<Real>> a{dual(p.a.x, 0), dual(p.a.y, 1), dual(p.a.z, 2)};
  const Vec<Dual<Real>> b{dual(p.b.x, 3), dual(p.b.y, 4), dual(p.b.z, 5)};
  const Dual<Real> result = everything(a, b, dual(p.s, 6));
  for (int l = 0; l < W; ++l) CHECK(result.value[l] == value(p)[l]);
  return result.slope;
}

void slopes_are_those_of_differences() {
  const double step = 1e-6;
  for (int which = 0; which < 7; ++which) {
    Point more = point(), less = point();
    for (int l = 0; l < W; ++l) number(more, which, l) += step, number(less, which, l) -= step;
    const Real difference = (value(more) - value(less)) / splat<Real>(2.0 * step), exact = slope(point(), which);
    for (int l = 0; l < W; ++l) CHECK(close_to(exact[l], difference[l], 1e-7));
  }
  const Dual<Real> zero = root(Dual<Real>{Real{}, splat<Real>(1.0)});
  CHECK(zero.value[0] == 0.0 && zero.slope[0] == 0.0);
}

void a_tape_read_backwards_has_the_same_slopes() {
  Tape<Real> recorded;
  const Recording<Real> recording(&recorded);
  const Point p = point();
  for (int again = 0; again < 2; ++again) {  // the second time in memory that is there already
    recorded.clear();
    const auto mark = recorded.mark();
    const Vec<Taped<Real>> a = leaf(p.a), b = leaf(p.b);
    const Taped<Real> result = everything(a, b, leaf(p.s));
    recorded.bar(result.slot) += splat<Real>(1.0);
    recorded.reverse(mark);
    for (int which = 0; which < 7; ++which)
      for (int l = 0; l < W; ++l) {
        CHECK(result.value[l] == value(p)[l]);
        CHECK(close_to(recorded.bar(mark.slots + which)[l], slope(p, which)[l], 1e-12));
      }
  }
}

void a_turn_is_a_rotation() {
  const Vec<double> angle{0.0, 0.0, 0.02}, x{1.0, 0.0, 0.0};
  const Quaternion<double> q = turn(Quaternion<double>{1.0, {0.0, 0.0, 0.0}}, angle);
  CHECK(close_to(q.w * q.w + dot(q.v, q.v), 1.0, 1e-15));
  const Vec<double> turned = matrix(q) * x, back = transposed(matrix(q), turned);
  const double by = 2.0 * std::atan(0.01);
  CHECK(close_to(turned.x, std::cos(by), 1e-15) && close_to(turned.y, std::sin(by), 1e-15) && turned.z == 0.0);
  CHECK(close_to(back.x, 1.0, 1e-15) && close_to(back.y, 0.0, 1e-15));
}

void what_is_no_number_comes_through_a_bound() {
  const double nothing = std::numeric_limits<double>::quiet_NaN();
  for (const double fine : {-3.0, 7.0})
    for (const Pair& x : {Pair{splat<Real>(nothing), splat<Real>(fine)}, Pair{splat<Real>(fine), splat<Real>(nothing)}})
      CHECK(std::isnan(largest(x)) && std::isnan(smallest(x)));
  const Pair x{lanes(1.0), lanes(2.0)};
  CHECK(largest(x) == lanes(2.0)[W - 1] && smallest(x) == 1.0);
}

void test() {
  lanes_are_doubles();
  what_is_no_number_comes_through_a_bound();
  elementary_functions();
  rows_are_columns_transposed();
  slopes_are_those_of_differences();
  a_tape_read_backwards_has_the_same_slopes();
  a_turn_is_a_rotation();
}

}  // namespace GMEM_ISA
}  // namespace gmem

int main() {
  gmem::GMEM_ISA::test();
  return failures != 0;
}
