// Rotations whose components are numbers of any kind.

#pragma once

#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

template <class V>
struct Quaternion {
  V w;
  Vec<V> v;
};

// Rotate by the small lab-frame angle (Cayley map) and normalise.
// gmem_jax/physics/rotation.py: turn
template <class V>
constexpr Quaternion<V> turn(Quaternion<V> q, Vec<V> angle) {
  const Vec<V> half = splat<V>(0.5) * angle;
  const V w = q.w - dot(half, q.v);
  const Vec<V> v = add_cross(fma(q.w, half, q.v), half, q.v);
  const V norm = root(fma(w, w, dot(v, v)));
  const V scale = splat<V>(1.0) / norm;
  return {w * scale, scale * v};
}

template <class V>
struct Matrix {
  Vec<V> row[3];
};

template <class V>
constexpr Vec<V> operator*(const Matrix<V>& m, Vec<V> a) {
  return {dot(m.row[0], a), dot(m.row[1], a), dot(m.row[2], a)};
}

template <class V>
constexpr Vec<V> transposed(const Matrix<V>& m, Vec<V> a) {
  return fma(a.z, m.row[2], fma(a.y, m.row[1], a.x * m.row[0]));
}

// Lab components of body vectors.
// gmem_jax/physics/rotation.py: matrix
template <class V>
constexpr Matrix<V> matrix(Quaternion<V> q) {
  const V one = splat<V>(1.0), two = splat<V>(2.0);
  const V x = two * q.v.x, y = two * q.v.y, z = two * q.v.z;
  const V xx = x * q.v.x, yy = y * q.v.y, zz = z * q.v.z;
  const V xy = x * q.v.y, xz = x * q.v.z, yz = y * q.v.z;
  const V wx = q.w * x, wy = q.w * y, wz = q.w * z;
  return {
      {{one - (yy + zz), xy - wz, xz + wy}, {xy + wz, one - (xx + zz), yz - wx}, {xz - wy, yz + wx, one - (xx + yy)}}};
}

}  // namespace GMEM_ISA
}  // namespace gmem
