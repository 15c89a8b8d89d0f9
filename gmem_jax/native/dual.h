// Numbers that carry their derivative along one direction: with them in place of plain ones, the time step is its own
// forward mode. Included inside a namespace of its own, ahead of everything that calculates.

struct V {
  Real value, slope;
  double operator[](int l) const { return value[l]; }
};

inline V splat(double a) { return {GMEM_ISA::splat(a), Real{}}; }
inline V select(Mask m, V a, V b) { return {m ? a.value : b.value, m ? a.slope : b.slope}; }
inline V zero_unless(Mask m, V a) { return select(m, a, V{}); }

inline V operator+(V a, V b) { return {a.value + b.value, a.slope + b.slope}; }
inline V operator-(V a, V b) { return {a.value - b.value, a.slope - b.slope}; }
inline V operator-(V a) { return {-a.value, -a.slope}; }
inline V operator*(V a, V b) { return {a.value * b.value, GMEM_ISA::fma(a.slope, b.value, a.value * b.slope)}; }
inline V operator/(V a, V b) {
  const Real quotient = a.value / b.value;
  return {quotient, GMEM_ISA::fnma(quotient, b.slope, a.slope) / b.value};
}
inline V fma(V a, V b, V c) {
  return {GMEM_ISA::fma(a.value, b.value, c.value), GMEM_ISA::fma(a.slope, b.value, GMEM_ISA::fma(a.value, b.slope, c.slope))};
}
inline V fms(V a, V b, V c) { return fma(a, b, -c); }
inline V fnma(V a, V b, V c) { return fma(-a, b, c); }

inline Mask operator<(V a, V b) { return a.value < b.value; }
inline Mask operator>(V a, V b) { return a.value > b.value; }
inline Mask operator<=(V a, V b) { return a.value <= b.value; }
inline unsigned bits_less(V a, V b) { return GMEM_ISA::bits_less(a.value, b.value); }
inline V max(V a, V b) { return select(a > b, a, b); }
inline double largest(V a) { return GMEM_ISA::largest(a.value); }
inline double smallest(V a) { return GMEM_ISA::smallest(a.value); }
inline V floor_of(V a) { return {GMEM_ISA::floor_of(a.value), Real{}}; }

// At zero, where it has none, the root's derivative is taken as zero.
inline V root(V a) {
  const Real value = GMEM_ISA::root(a.value);
  return {value, GMEM_ISA::zero_unless(value > Real{}, GMEM_ISA::splat(0.5) * a.slope / value)};
}
inline V inverse_root(V a) {
  const Real value = GMEM_ISA::inverse_root(a.value);
  return {value, GMEM_ISA::splat(-0.5) * (((a.slope * value) * value) * value)};
}

template <class Gather>
inline V of_lanes(const Block& block, const Gather& gather) {
  return {gather(block.lanes), gather(block.slopes)};
}
inline Real result(V a) { return a.slope; }
inline const Lane* results(const Block& block) { return block.slopes; }
