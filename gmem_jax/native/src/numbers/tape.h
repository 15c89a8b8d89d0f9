// Numbers and vectors whose operations are recorded on a tape: a calculation can be gone through backwards, from
// derivatives by its results to derivatives by its arguments ("bars").

#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>
#include <type_traits>

#include "numbers/dual.h"
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

// A mask in the bits of a number, so that a slot can hold it.
template <class R>
inline R of_mask(Bits m) {
  if constexpr (std::is_same<R, Real>::value) return (Real)m;
  else return {(Real)m, Real{}};
}
inline Bits mask_in(Real a) { return (Bits)a; }
inline Bits mask_in(Dual<Real> a) { return (Bits)a.value; }

// The operations of a calculation, in order. A slot holds one number.
template <class R>
class Tape {
 public:
  struct Mark {
    int nodes, slots;
  };

  Tape() { slot(R{}); }  // for all constants; its bar is of no interest
  ~Tape() { std::free(node_), std::free(value_), std::free(bar_); }
  Tape(const Tape&) = delete;
  Tape& operator=(const Tape&) = delete;

  Mark mark() const { return {nodes_, slots_}; }
  void rewind(Mark mark) { nodes_ = mark.nodes, slots_ = mark.slots; }
  void clear() { rewind({0, 1}); }
  R& bar(int slot) { return bar_[slot]; }

  GMEM_INLINE int slot(R value) {
    if (__builtin_expect(slots_ == slot_capacity_, 0)) grow_slots();
    value_[slots_] = value;
    bar_[slots_] = R{};
    return slots_++;
  }

  GMEM_INLINE int push(Operation operation, R value, int a, int b = 0, int c = 0) {
    if (__builtin_expect(nodes_ == node_capacity_, 0)) grow_nodes();
    const int result = slot(value);
    node_[nodes_++] = {operation, result, a, b, c};
    return result;
  }

  // Goes back from the bars of the last results to those of their operands, until `first`.
  void reverse(Mark first) {
    for (int n = nodes_ - 1; n >= first.nodes; --n) {
      const Node node = node_[n];
      const R g = bar_[node.result];
      R* const a = bar_ + node.a;
      R* const b = bar_ + node.b;
      R* const c = bar_ + node.c;
      const R* const result = value_ + node.result;
      switch (node.operation) {
        case Operation::add: *a += g, *b += g; break;
        case Operation::subtract: *a += g, *b -= g; break;
        case Operation::negate: *a -= g; break;
        case Operation::multiply: product(node, g); break;
        case Operation::fma: product(node, g), *c += g; break;
        case Operation::fms: product(node, g), *c -= g; break;
        case Operation::fnma: product(node, -g), *c += g; break;
        case Operation::divide: {
          const R by_a = g / value_[node.b];
          *a += by_a;
          *b = fnma(by_a, *result, *b);
          break;
        }
        case Operation::root:  // at zero, where it has no derivative, zero
          *a += zero_unless(*result > R{}, splat<R>(0.5) * g / *result);
          break;
        case Operation::inverse_root: {  // a bar of zero stays zero, even where the slope is infinite
          const R y = *result;
          *a += zero_unless(differ(g, R{}), splat<R>(-0.5) * (((g * y) * y) * y));
          break;
        }
        case Operation::select: {
          const Bits m = mask_in(value_[node.c]);
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

  void product(const Node& node, R g) {
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
  R* value_ = nullptr;
  R* bar_ = nullptr;
};

// The tape on which this thread records.
template <class R>
static thread_local Tape<R>* tape __attribute__((tls_model("initial-exec"))) = nullptr;

// Makes a tape the one of this thread, as long as the object lives.
template <class R>
struct Recording {
  explicit Recording(Tape<R>* on) { tape<R> = on; }
  ~Recording() { tape<R> = nullptr; }
  Recording(const Recording&) = delete;
  Recording& operator=(const Recording&) = delete;
};

// --- numbers

// A number in a slot, or a constant (slot 0).
template <class R>
struct Taped {
  R value;
  int slot;

  static Taped of(double a) { return {splat<R>(a), 0}; }
  double operator[](int l) const { return value[l]; }

  friend GMEM_INLINE Taped select(Bits m, Taped a, Taped b) {
    const R value = select(m, a.value, b.value);
    if (!a.slot && !b.slot) return {value, 0};
    return {value, tape<R>->push(Operation::select, value, a.slot, b.slot, tape<R>->slot(of_mask<R>(m)))};
  }
  friend GMEM_INLINE Taped zero_unless(Bits m, Taped a) { return select(m, a, Taped{}); }

  friend GMEM_INLINE Taped operator+(Taped a, Taped b) { return of_sum(Operation::add, a.value + b.value, a, b); }
  friend GMEM_INLINE Taped operator-(Taped a, Taped b) { return of_sum(Operation::subtract, a.value - b.value, a, b); }
  friend GMEM_INLINE Taped operator-(Taped a) { return of_sum(Operation::negate, -a.value, a, Taped{}); }
  friend GMEM_INLINE Taped operator*(Taped a, Taped b) {
    return of_product(Operation::multiply, a.value * b.value, a, b, Taped{});
  }
  friend GMEM_INLINE Taped operator/(Taped a, Taped b) {
    return of_product(Operation::divide, a.value / b.value, a, b, Taped{});
  }
  friend GMEM_INLINE Taped fma(Taped a, Taped b, Taped c) {
    return of_product(Operation::fma, fma(a.value, b.value, c.value), a, b, c);
  }
  friend GMEM_INLINE Taped fms(Taped a, Taped b, Taped c) {
    return of_product(Operation::fms, fms(a.value, b.value, c.value), a, b, c);
  }
  friend GMEM_INLINE Taped fnma(Taped a, Taped b, Taped c) {
    return of_product(Operation::fnma, fnma(a.value, b.value, c.value), a, b, c);
  }
  friend GMEM_INLINE Taped root(Taped a) { return of_root(Operation::root, root(a.value), a); }
  friend GMEM_INLINE Taped inverse_root(Taped a) { return of_root(Operation::inverse_root, inverse_root(a.value), a); }

  friend Bits operator<(Taped a, Taped b) { return a.value < b.value; }
  friend Bits operator>(Taped a, Taped b) { return a.value > b.value; }
  friend Bits operator<=(Taped a, Taped b) { return a.value <= b.value; }
  friend unsigned bits_less(Taped a, Taped b) { return bits_less(a.value, b.value); }
  friend Taped max(Taped a, Taped b) { return {max(a.value, b.value), 0}; }  // its only use is whether walls are near
  friend double largest(Taped a) { return largest(a.value); }
  friend double smallest(Taped a) { return smallest(a.value); }
  friend Taped floor_of(Taped a) { return {floor_of(a.value), 0}; }

 private:
  // Operations on constants alone are not recorded.
  static GMEM_INLINE Taped of_sum(Operation operation, R value, Taped a, Taped b) {
    return {value, a.slot || b.slot ? tape<R>->push(operation, value, a.slot, b.slot) : 0};
  }
  static GMEM_INLINE Taped of_product(Operation operation, R value, Taped a, Taped b, Taped c) {
    if (!a.slot && !b.slot && !c.slot) return {value, 0};
    const int one = a.kept(), other = b.kept();
    return {value, tape<R>->push(operation, value, one, other, c.slot)};
  }
  static GMEM_INLINE Taped of_root(Operation operation, R value, Taped a) {
    return {value, a.slot ? tape<R>->push(operation, value, a.slot) : 0};
  }
  // The slot of an operand whose value the way back needs.
  GMEM_INLINE int kept() const { return slot ? slot : tape<R>->slot(value); }
};

template <class R>
inline Taped<R> constant(R a) {
  return {a, 0};
}
template <class R>
inline Taped<R> leaf(R value) {
  return {value, tape<R>->slot(value)};
}
template <class R>
inline Vec<Taped<R>> leaf(Vec<R> a) {
  return {leaf(a.x), leaf(a.y), leaf(a.z)};
}

}  // namespace GMEM_ISA
}  // namespace gmem
