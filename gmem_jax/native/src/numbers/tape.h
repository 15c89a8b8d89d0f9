// Numbers and vectors that remember how they came about: a calculation with them can be gone through backwards, from
// derivatives by its results to derivatives by its arguments ("bars").

#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>

#include "numbers/simd.h"
#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

enum class Operation : std::int32_t {
  add,
  subtract,
  negate,
  multiply,
  divide,
  fma,
  fms,
  fnma,
  root,
  inverse_root,
  select
};

// What was calculated, in order. A slot holds one number.
class Tape {
 public:
  struct Mark {
    int nodes, slots;
  };

  Tape() { slot(Real{}); }  // for all constants; its bar is of no interest
  ~Tape() { std::free(node_), std::free(value_), std::free(bar_); }
  Tape(const Tape&) = delete;
  Tape& operator=(const Tape&) = delete;

  Mark mark() const { return {nodes_, slots_}; }
  void rewind(Mark mark) { nodes_ = mark.nodes, slots_ = mark.slots; }
  void clear() { rewind({0, 1}); }
  Real& bar(int slot) { return bar_[slot]; }

  GMEM_INLINE int slot(Real value) {
    if (__builtin_expect(slots_ == slot_capacity_, 0)) grow_slots();
    value_[slots_] = value;
    bar_[slots_] = Real{};
    return slots_++;
  }

  GMEM_INLINE int push(Operation operation, Real value, int a, int b = 0, int c = 0) {
    if (__builtin_expect(nodes_ == node_capacity_, 0)) grow_nodes();
    const int result = slot(value);
    node_[nodes_++] = {operation, result, a, b, c};
    return result;
  }

  // From the bars of the last results to those of what they came from, back to `first`.
  void reverse(Mark first) {
    for (int n = nodes_ - 1; n >= first.nodes; --n) {
      const Node node = node_[n];
      const Real g = bar_[node.result];
      Real* const a = bar_ + node.a;
      Real* const b = bar_ + node.b;
      Real* const c = bar_ + node.c;
      const Real* const result = value_ + node.result;
      switch (node.operation) {
        case Operation::add: *a += g, *b += g; break;
        case Operation::subtract: *a += g, *b -= g; break;
        case Operation::negate: *a -= g; break;
        case Operation::multiply: product(node, g); break;
        case Operation::fma: product(node, g), *c += g; break;
        case Operation::fms: product(node, g), *c -= g; break;
        case Operation::fnma: product(node, -g), *c += g; break;
        case Operation::divide: {
          const Real by_a = g / value_[node.b];
          *a += by_a;
          *b = fnma(by_a, *result, *b);
          break;
        }
        case Operation::root:  // at zero, where it has no derivative, zero
          *a += zero_unless(*result > Real{}, splat<Real>(0.5) * g / *result);
          break;
        case Operation::inverse_root: {  // what is not wanted stays zero, even where its slope is infinite
          const Real y = *result;
          *a += zero_unless(g != Real{}, splat<Real>(-0.5) * (((g * y) * y) * y));
          break;
        }
        case Operation::select: {
          const Bits m = (Bits)value_[node.c];
          *a += zero_unless(m, g);
          *b += zero_unless(~m, g);
          break;
        }
      }
    }
  }

 private:
  struct Node {
    Operation operation;
    int result, a, b, c;
  };

  void product(const Node& node, Real g) {
    bar_[node.a] = fma(g, value_[node.b], bar_[node.a]);
    bar_[node.b] = fma(g, value_[node.a], bar_[node.b]);
  }

  __attribute__((noinline)) void grow_nodes() {
    node_capacity_ = node_capacity_ ? 2 * node_capacity_ : 1024;
    grow(node_, nodes_, node_capacity_);
  }

  __attribute__((noinline)) void grow_slots() {
    slot_capacity_ = slot_capacity_ ? 2 * slot_capacity_ : 4096;
    grow(value_, slots_, slot_capacity_);
    grow(bar_, slots_, slot_capacity_);
  }

  template <class T>
  static void grow(T*& piece, int used, int capacity) {
    void* larger = std::aligned_alloc(64, (sizeof(T) * capacity + 63) / 64 * 64);
    if (!larger) throw std::bad_alloc();
    if (used) std::memcpy(larger, piece, sizeof(T) * used);
    std::free(piece);
    piece = static_cast<T*>(larger);
  }

  int nodes_ = 0, slots_ = 0, node_capacity_ = 0, slot_capacity_ = 0;
  Node* node_ = nullptr;
  Real* value_ = nullptr;
  Real* bar_ = nullptr;
};

// The tape on which this thread records.
static thread_local Tape* tape __attribute__((tls_model("initial-exec"))) = nullptr;

// Makes it that tape for as long as this lives.
struct Recording {
  explicit Recording(Tape* on) { tape = on; }
  ~Recording() { tape = nullptr; }
  Recording(const Recording&) = delete;
  Recording& operator=(const Recording&) = delete;
};

// --- numbers

// A number in a slot, or a constant (slot 0).
struct Taped {
  Real value;
  int slot;

  static Taped of(double a) { return {splat<Real>(a), 0}; }
  double operator[](int l) const { return value[l]; }
};

inline Taped leaf(Real value) { return {value, tape->slot(value)}; }
// The slot of an operand whose value will be wanted.
GMEM_INLINE int kept(Taped a) { return a.slot ? a.slot : tape->slot(a.value); }

inline Taped constant(Real a) { return {a, 0}; }

GMEM_INLINE Taped select(Bits m, Taped a, Taped b) {
  const Real value = m ? a.value : b.value;
  if (!a.slot && !b.slot) return constant(value);
  return {value, tape->push(Operation::select, value, a.slot, b.slot, tape->slot((Real)m))};
}
GMEM_INLINE Taped zero_unless(Bits m, Taped a) { return select(m, a, Taped{}); }

GMEM_INLINE Taped of_sum(Operation operation, Real value, Taped a, Taped b) {
  return a.slot || b.slot ? Taped{value, tape->push(operation, value, a.slot, b.slot)} : constant(value);
}
GMEM_INLINE Taped operator+(Taped a, Taped b) { return of_sum(Operation::add, a.value + b.value, a, b); }
GMEM_INLINE Taped operator-(Taped a, Taped b) { return of_sum(Operation::subtract, a.value - b.value, a, b); }
GMEM_INLINE Taped operator-(Taped a) { return of_sum(Operation::negate, -a.value, a, Taped{}); }

GMEM_INLINE Taped of_product(Operation operation, Real value, Taped a, Taped b, Taped c) {
  if (!a.slot && !b.slot && !c.slot) return constant(value);
  const int one = kept(a), other = kept(b);
  return {value, tape->push(operation, value, one, other, c.slot)};
}
GMEM_INLINE Taped operator*(Taped a, Taped b) {
  return of_product(Operation::multiply, a.value * b.value, a, b, Taped{});
}
GMEM_INLINE Taped operator/(Taped a, Taped b) {
  return of_product(Operation::divide, a.value / b.value, a, b, Taped{});
}
GMEM_INLINE Taped fma(Taped a, Taped b, Taped c) {
  return of_product(Operation::fma, fma(a.value, b.value, c.value), a, b, c);
}
GMEM_INLINE Taped fms(Taped a, Taped b, Taped c) {
  return of_product(Operation::fms, fms(a.value, b.value, c.value), a, b, c);
}
GMEM_INLINE Taped fnma(Taped a, Taped b, Taped c) {
  return of_product(Operation::fnma, fnma(a.value, b.value, c.value), a, b, c);
}

GMEM_INLINE Taped of_root(Operation operation, Real value, Taped a) {
  return a.slot ? Taped{value, tape->push(operation, value, a.slot)} : constant(value);
}
GMEM_INLINE Taped root(Taped a) { return of_root(Operation::root, root(a.value), a); }
GMEM_INLINE Taped inverse_root(Taped a) { return of_root(Operation::inverse_root, inverse_root(a.value), a); }

inline Bits operator<(Taped a, Taped b) { return a.value < b.value; }
inline Bits operator>(Taped a, Taped b) { return a.value > b.value; }
inline Bits operator<=(Taped a, Taped b) { return a.value <= b.value; }
inline unsigned bits_less(Taped a, Taped b) { return bits_less(a.value, b.value); }
inline Taped max(Taped a, Taped b) { return constant(max(a.value, b.value)); }  // only ever asked who is near
inline double largest(Taped a) { return largest(a.value); }
inline double smallest(Taped a) { return smallest(a.value); }
inline Taped floor_of(Taped a) { return constant(floor_of(a.value)); }

inline Vec<Taped> leaf(Vec<Real> a) { return {leaf(a.x), leaf(a.y), leaf(a.z)}; }

}  // namespace GMEM_ISA
}  // namespace gmem
