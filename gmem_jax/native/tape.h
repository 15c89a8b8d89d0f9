// Numbers that remember how they came about: a calculation with them can be gone through backwards, from derivatives
// by its results to derivatives by its arguments ("bars"). Included inside a namespace of its own, ahead of what
// calculates.

class Tape {
 public:
  enum Operation : std::int32_t { kLeaf, kAdd, kSubtract, kNegate, kMultiply, kDivide, kFma, kFms, kFnma, kRoot,
                                  kInverseRoot, kSelect };

  Tape() { push(kLeaf, Real{}); }  // node 0 stands for all constants; its bar is of no interest
  ~Tape() { std::free(node_), std::free(value_), std::free(bar_); }
  Tape(const Tape&) = delete;
  Tape& operator=(const Tape&) = delete;

  int size() const { return size_; }
  void rewind(int size) { size_ = size; }
  Real& bar(int index) { return bar_[index]; }

  int push(Operation operation, Real value, int a = 0, int b = 0, int c = 0) {
    if (size_ == capacity_) grow();
    node_[size_] = {operation, a, b, c};
    value_[size_] = value;
    bar_[size_] = Real{};
    return size_++;
  }

  // From the bars of the last nodes to those of what they came from, down to node `first`.
  void reverse(int first) {
    for (int n = size_ - 1; n >= first; --n) {
      const Node& node = node_[n];
      const Real g = bar_[n];
      Real &a = bar_[node.a], &b = bar_[node.b];
      switch (node.operation) {
        case kLeaf: break;
        case kAdd: a += g, b += g; break;
        case kSubtract: a += g, b -= g; break;
        case kNegate: a -= g; break;
        case kMultiply: product(node, g); break;
        case kFma: product(node, g), bar_[node.c] += g; break;
        case kFms: product(node, g), bar_[node.c] -= g; break;
        case kFnma: product(node, -g), bar_[node.c] += g; break;
        case kDivide: {
          const Real by_a = g / value_[node.b];
          a += by_a;
          b = GMEM_ISA::fnma(by_a, value_[n], b);
          break;
        }
        case kRoot:  // at zero, where it has no derivative, zero
          a += GMEM_ISA::zero_unless(value_[n] > Real{}, GMEM_ISA::splat(0.5) * g / value_[n]);
          break;
        case kInverseRoot: {
          const Real y = value_[n];
          a += guarded(g, GMEM_ISA::splat(-0.5) * (((g * y) * y) * y));
          break;
        }
        case kSelect: {
          const Mask m = (Mask)value_[node.c];
          a += GMEM_ISA::zero_unless(m, g);
          b += GMEM_ISA::zero_unless(~m, g);
          break;
        }
      }
    }
  }

 private:
  struct Node {
    Operation operation;
    int a, b, c;
  };

  void product(const Node& node, Real g) {
    bar_[node.a] = GMEM_ISA::fma(g, value_[node.b], bar_[node.a]);
    bar_[node.b] = GMEM_ISA::fma(g, value_[node.a], bar_[node.b]);
  }

  // A slope that is not wanted is zero, even where its factor is infinite.
  static Real guarded(Real g, Real slope) { return GMEM_ISA::zero_unless(g != Real{}, slope); }

  void grow() {
    const int capacity = capacity_ ? 2 * capacity_ : 4096;
    grow(node_, capacity), grow(value_, capacity), grow(bar_, capacity);
    capacity_ = capacity;
  }

  template <class T>
  void grow(T*& piece, int capacity) {
    void* larger = std::aligned_alloc(64, sizeof(T) * capacity);
    if (!larger) throw std::bad_alloc();
    if (size_) std::memcpy(larger, piece, sizeof(T) * size_);
    std::free(piece);
    piece = static_cast<T*>(larger);
  }

  int size_ = 0, capacity_ = 0;
  Node* node_ = nullptr;
  Real* value_ = nullptr;
  Real* bar_ = nullptr;
};

// The tape on which this thread records.
static thread_local Tape* tape __attribute__((tls_model("initial-exec"))) = nullptr;

// A number on the tape, or a constant (index 0).
struct V {
  Real value;
  int index;
  double operator[](int l) const { return value[l]; }
};

inline V leaf(Real value) { return {value, tape->push(Tape::kLeaf, value)}; }
// The index of an operand whose value will be wanted.
inline int kept(V a) { return a.index ? a.index : tape->push(Tape::kLeaf, a.value); }

inline V splat(double a) { return {GMEM_ISA::splat(a), 0}; }
inline V constant(Real a) { return {a, 0}; }

inline V select(Mask m, V a, V b) {
  const Real value = m ? a.value : b.value;
  if (!a.index && !b.index) return constant(value);
  const int mask = tape->push(Tape::kLeaf, (Real)m);
  return {value, tape->push(Tape::kSelect, value, a.index, b.index, mask)};
}
inline V zero_unless(Mask m, V a) { return select(m, a, V{}); }

inline V operator+(V a, V b) {
  const Real value = a.value + b.value;
  return a.index || b.index ? V{value, tape->push(Tape::kAdd, value, a.index, b.index)} : constant(value);
}
inline V operator-(V a, V b) {
  const Real value = a.value - b.value;
  return a.index || b.index ? V{value, tape->push(Tape::kSubtract, value, a.index, b.index)} : constant(value);
}
inline V operator-(V a) { return a.index ? V{-a.value, tape->push(Tape::kNegate, -a.value, a.index)} : constant(-a.value); }

inline V of_product(Tape::Operation operation, Real value, V a, V b, V c) {
  if (!a.index && !b.index && !c.index) return constant(value);
  const int one = kept(a), other = kept(b);
  return {value, tape->push(operation, value, one, other, c.index)};
}
inline V operator*(V a, V b) { return of_product(Tape::kMultiply, a.value * b.value, a, b, V{}); }
inline V operator/(V a, V b) { return of_product(Tape::kDivide, a.value / b.value, a, b, V{}); }
inline V fma(V a, V b, V c) { return of_product(Tape::kFma, GMEM_ISA::fma(a.value, b.value, c.value), a, b, c); }
inline V fms(V a, V b, V c) { return of_product(Tape::kFms, GMEM_ISA::fms(a.value, b.value, c.value), a, b, c); }
inline V fnma(V a, V b, V c) { return of_product(Tape::kFnma, GMEM_ISA::fnma(a.value, b.value, c.value), a, b, c); }

inline V root(V a) {
  const Real value = GMEM_ISA::root(a.value);
  return a.index ? V{value, tape->push(Tape::kRoot, value, a.index)} : constant(value);
}
inline V inverse_root(V a) {
  const Real value = GMEM_ISA::inverse_root(a.value);
  return a.index ? V{value, tape->push(Tape::kInverseRoot, value, a.index)} : constant(value);
}

inline Mask operator<(V a, V b) { return a.value < b.value; }
inline Mask operator>(V a, V b) { return a.value > b.value; }
inline Mask operator<=(V a, V b) { return a.value <= b.value; }
inline unsigned bits_less(V a, V b) { return GMEM_ISA::bits_less(a.value, b.value); }
inline V max(V a, V b) { return constant(GMEM_ISA::max(a.value, b.value)); }  // only ever asked who is near
inline double largest(V a) { return GMEM_ISA::largest(a.value); }
inline double smallest(V a) { return GMEM_ISA::smallest(a.value); }
inline V floor_of(V a) { return constant(GMEM_ISA::floor_of(a.value)); }
