// Vectors whose components are numbers of any kind: of space, and of a plane.

#pragma once

#include "numbers/number.h"

namespace gmem {
namespace GMEM_ISA {

template <class V>
struct Vec {
  V x, y, z;
};

template <class V>
constexpr Vec<V> operator+(Vec<V> a, Vec<V> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class V>
constexpr Vec<V> operator-(Vec<V> a, Vec<V> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class V>
constexpr Vec<V> operator-(Vec<V> a) {
  return {-a.x, -a.y, -a.z};
}
template <class V>
constexpr Vec<V> operator*(V s, Vec<V> a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class V>
constexpr Vec<V> zero_unless(Mask<V> m, Vec<V> a) {
  return {zero_unless(m, a.x), zero_unless(m, a.y), zero_unless(m, a.z)};
}
template <class V>
constexpr Vec<V> select(Mask<V> m, Vec<V> a, Vec<V> b) {
  return {select(m, a.x, b.x), select(m, a.y, b.y), select(m, a.z, b.z)};
}
template <class V>
inline Mask<V> differ(Vec<V> a, Vec<V> b) {
  return differ(a.x, b.x) | differ(a.y, b.y) | differ(a.z, b.z);
}

// s a + b
template <class V>
constexpr Vec<V> fma(V s, Vec<V> a, Vec<V> b) {
  return {fma(s, a.x, b.x), fma(s, a.y, b.y), fma(s, a.z, b.z)};
}
// b - s a
template <class V>
constexpr Vec<V> fnma(V s, Vec<V> a, Vec<V> b) {
  return {fnma(s, a.x, b.x), fnma(s, a.y, b.y), fnma(s, a.z, b.z)};
}

template <class V>
constexpr V dot(Vec<V> a, Vec<V> b) {
  return fma(a.z, b.z, fma(a.y, b.y, a.x * b.x));
}

template <class V>
constexpr Vec<V> cross(Vec<V> a, Vec<V> b) {
  return {fms(a.y, b.z, a.z * b.y), fms(a.z, b.x, a.x * b.z), fms(a.x, b.y, a.y * b.x)};
}

// c + a x b
template <class V>
constexpr Vec<V> add_cross(Vec<V> c, Vec<V> a, Vec<V> b) {
  return {fma(a.y, b.z, fnma(a.z, b.y, c.x)), fma(a.z, b.x, fnma(a.x, b.z, c.y)), fma(a.x, b.y, fnma(a.y, b.x, c.z))};
}

// A vector of a plane in which some direction is marked.
template <class V>
struct Flat {
  V along, across;
};

template <class V>
constexpr Flat<V> operator+(Flat<V> a, Flat<V> b) {
  return {a.along + b.along, a.across + b.across};
}
template <class V>
constexpr Flat<V> operator*(V s, Flat<V> a) {
  return {s * a.along, s * a.across};
}
template <class V>
constexpr Flat<V> zero_unless(Mask<V> m, Flat<V> a) {
  return {zero_unless(m, a.along), zero_unless(m, a.across)};
}
template <class V>
constexpr Flat<V> select(Mask<V> m, Flat<V> a, Flat<V> b) {
  return {select(m, a.along, b.along), select(m, a.across, b.across)};
}
template <class V>
inline Mask<V> differ(Flat<V> a, Flat<V> b) {
  return differ(a.along, b.along) | differ(a.across, b.across);
}
template <class V>
constexpr Flat<V> fma(V s, Flat<V> a, Flat<V> b) {
  return {fma(s, a.along, b.along), fma(s, a.across, b.across)};
}
template <class V>
constexpr V dot(Flat<V> a, Flat<V> b) {
  return fma(a.across, b.across, a.along * b.along);
}

template <class V>
constexpr Vec<V> load_vec(const V* p) {
  return {p[0], p[1], p[2]};
}
template <class V>
constexpr void store_vec(V* p, Vec<V> a) {
  p[0] = a.x, p[1] = a.y, p[2] = a.z;
}

}  // namespace GMEM_ISA
}  // namespace gmem
