// Three-vectors whose components are vectors of lanes. Included inside the instruction set's namespace.

struct Vec {
  V x, y, z;
};

inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator-(Vec a) { return {-a.x, -a.y, -a.z}; }
inline Vec operator*(V s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec zero_unless(Mask m, Vec a) { return {zero_unless(m, a.x), zero_unless(m, a.y), zero_unless(m, a.z)}; }

// s a + b
inline Vec fma(V s, Vec a, Vec b) { return {fma(s, a.x, b.x), fma(s, a.y, b.y), fma(s, a.z, b.z)}; }
// b - s a
inline Vec fnma(V s, Vec a, Vec b) { return {fnma(s, a.x, b.x), fnma(s, a.y, b.y), fnma(s, a.z, b.z)}; }

inline V dot(Vec a, Vec b) { return fma(a.z, b.z, fma(a.y, b.y, a.x * b.x)); }

inline Vec cross(Vec a, Vec b) {
  return {fms(a.y, b.z, a.z * b.y), fms(a.z, b.x, a.x * b.z), fms(a.x, b.y, a.y * b.x)};
}

// c + a x b
inline Vec add_cross(Vec c, Vec a, Vec b) {
  return {fma(a.y, b.z, fnma(a.z, b.y, c.x)), fma(a.z, b.x, fnma(a.x, b.z, c.y)), fma(a.x, b.y, fnma(a.y, b.x, c.z))};
}

inline Vec load_vec(const V* p) { return {p[0], p[1], p[2]}; }
inline void store_vec(V* p, Vec a) { p[0] = a.x, p[1] = a.y, p[2] = a.z; }
