// Numbers that carry their derivative along one direction: with them in place of plain ones, the time step is its own
// forward mode.

#pragma once

#include "numbers/number.h"

namespace gmem {
namespace GMEM_ISA {

template <class R>
struct Dual {
  using Bits = Mask<R>;
  R value, slope;

  static Dual of(double a) { return {splat<R>(a), R{}}; }
  double operator[](int l) const { return value[l]; }

  friend Dual select(Bits m, Dual a, Dual b) { return {select(m, a.value, b.value), select(m, a.slope, b.slope)}; }
  friend Dual zero_unless(Bits m, Dual a) { return select(m, a, Dual{}); }

  friend Dual operator+(Dual a, Dual b) { return {a.value + b.value, a.slope + b.slope}; }
  friend Dual operator-(Dual a, Dual b) { return {a.value - b.value, a.slope - b.slope}; }
  friend Dual operator-(Dual a) { return {-a.value, -a.slope}; }
  Dual& operator+=(Dual a) { return *this = *this + a; }
  Dual& operator-=(Dual a) { return *this = *this - a; }
  friend Dual operator*(Dual a, Dual b) { return {a.value * b.value, fma(a.slope, b.value, a.value * b.slope)}; }
  friend Dual operator/(Dual a, Dual b) {
    const R quotient = a.value / b.value;
    return {quotient, fnma(quotient, b.slope, a.slope) / b.value};
  }
  friend Dual fma(Dual a, Dual b, Dual c) {
    return {fma(a.value, b.value, c.value), fma(a.slope, b.value, fma(a.value, b.slope, c.slope))};
  }
  friend Dual fms(Dual a, Dual b, Dual c) { return fma(a, b, -c); }
  friend Dual fnma(Dual a, Dual b, Dual c) { return fma(-a, b, c); }

  friend Bits operator<(Dual a, Dual b) { return a.value < b.value; }
  friend Bits operator>(Dual a, Dual b) { return a.value > b.value; }
  friend Bits operator<=(Dual a, Dual b) { return a.value <= b.value; }
  friend unsigned bits_less(Dual a, Dual b) { return bits_less(a.value, b.value); }
  friend Dual max(Dual a, Dual b) { return select(a > b, a, b); }
  friend double largest(Dual a) { return largest(a.value); }
  friend double smallest(Dual a) { return smallest(a.value); }
  friend Dual floor_of(Dual a) { return {floor_of(a.value), R{}}; }

  friend Bits differ(Dual a, Dual b) { return differ(a.value, b.value) | differ(a.slope, b.slope); }
  friend void copy_lane(Dual& to, int l, Dual from) {
    copy_lane(to.value, l, from.value);
    copy_lane(to.slope, l, from.slope);
  }

  // At zero, where it has none, the root's derivative is taken as zero.
  friend Dual root(Dual a) {
    const R value = root(a.value);
    return {value, zero_unless(value > R{}, splat<R>(0.5) * a.slope / value)};
  }
  friend Dual inverse_root(Dual a) {
    const R value = inverse_root(a.value);
    return {value, splat<R>(-0.5) * (((a.slope * value) * value) * value)};
  }
};

template <class R>
constexpr int kLanes<Dual<R>> = kLanes<R>;

}  // namespace GMEM_ISA
}  // namespace gmem
