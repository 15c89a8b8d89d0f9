// Rotations whose components are vectors of lanes. Included inside the instruction set's namespace.

struct Quaternion {
  V w;
  Vec v;
};

// Rotate by the small lab-frame angle (Cayley map) and normalise.
inline Quaternion turn(Quaternion q, Vec angle) {
  const Vec half = splat(0.5) * angle;
  const V w = q.w - dot(half, q.v);
  const Vec v = add_cross(fma(q.w, half, q.v), half, q.v);
  const V norm = root(fma(w, w, dot(v, v)));
  const V scale = splat(1.0) / norm;
  return {w * scale, scale * v};
}

struct Matrix {
  Vec row[3];
};

inline Vec operator*(const Matrix& m, Vec a) { return {dot(m.row[0], a), dot(m.row[1], a), dot(m.row[2], a)}; }

inline Vec transposed(const Matrix& m, Vec a) { return fma(a.z, m.row[2], fma(a.y, m.row[1], a.x * m.row[0])); }

// Lab components of body vectors.
inline Matrix matrix(Quaternion q) {
  const V one = splat(1.0), two = splat(2.0);
  const V x = two * q.v.x, y = two * q.v.y, z = two * q.v.z;
  const V xx = x * q.v.x, yy = y * q.v.y, zz = z * q.v.z;
  const V xy = x * q.v.y, xz = x * q.v.z, yz = y * q.v.z;
  const V wx = q.w * x, wy = q.w * y, wz = q.w * z;
  return {{{one - (yy + zz), xy - wz, xz + wy}, {xy + wz, one - (xx + zz), yz - wx}, {xz - wy, yz + wx, one - (xx + yy)}}};
}
