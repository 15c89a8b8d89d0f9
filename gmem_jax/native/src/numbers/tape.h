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
  // of numbers
  add, subtract, negate, multiply, divide, fma, fms, fnma, root, inverse_root, select,
  // of vectors; `copy` puts three numbers together
  vec_add, vec_subtract, vec_negate, scale, vec_fma, vec_fnma, dot, cross, add_cross, vec_select, copy
};

// What was calculated, in order. A slot holds one number; the slots of a vector follow each other.
class Tape {
 public:
  struct Mark {
    int nodes, slots;
  };

  Tape() { slot(Real{}), slot(Real{}), slot(Real{}); }  // for all constants; their bars are of no interest
  ~Tape() { std::free(node_), std::free(value_), std::free(bar_); }
  Tape(const Tape&) = delete;
  Tape& operator=(const Tape&) = delete;

  Mark mark() const { return {nodes_, slots_}; }
  void rewind(Mark mark) { nodes_ = mark.nodes, slots_ = mark.slots; }
  void clear() { rewind({0, 3}); }
  Real& bar(int slot) { return bar_[slot]; }

  GMEM_INLINE int slot(Real value) {
    if (__builtin_expect(slots_ + 3 > slot_capacity_, 0)) grow_slots();
    value_[slots_] = value;
    bar_[slots_] = Real{};
    return slots_++;
  }

  GMEM_INLINE int slot(const Vec<Real>& value) {
    if (__builtin_expect(slots_ + 3 > slot_capacity_, 0)) grow_slots();
    Real* v = value_ + slots_;
    Real* b = bar_ + slots_;
    v[0] = value.x, v[1] = value.y, v[2] = value.z;
    b[0] = b[1] = b[2] = Real{};
    slots_ += 3;
    return slots_ - 3;
  }

  template <class Value>
  GMEM_INLINE int push(Operation operation, const Value& value, int a, int b = 0, int c = 0) {
    if (__builtin_expect(nodes_ == node_capacity_, 0)) grow_nodes();
    const int result = slot(value);
    node_[nodes_++] = {operation, result, a, b, c};
    return result;
  }

  // Remember that the vector in `slot` is made of three numbers.
  void copy(int slot, int x, int y, int z) {
    if (nodes_ == node_capacity_) grow_nodes();
    node_[nodes_++] = {Operation::copy, slot, x, y, z};
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
        case Operation::vec_add: add(a, vec_bar(node)), add(b, vec_bar(node)); break;
        case Operation::vec_subtract: add(a, vec_bar(node)), add(b, -vec_bar(node)); break;
        case Operation::vec_negate: add(a, -vec_bar(node)); break;
        case Operation::scale: scaled(node, vec_bar(node)); break;
        case Operation::vec_fma: scaled(node, vec_bar(node)), add(c, vec_bar(node)); break;
        case Operation::vec_fnma: scaled(node, -vec_bar(node)), add(c, vec_bar(node)); break;
        case Operation::dot: {
          const Vec<Real> one = at(value_ + node.a), other = at(value_ + node.b);
          put(a, fma(g, other, at(a)));
          put(b, fma(g, one, at(b)));
          break;
        }
        case Operation::cross: crossed(node, vec_bar(node)); break;
        case Operation::add_cross: crossed(node, vec_bar(node)), add(c, vec_bar(node)); break;
        case Operation::copy: *a += g, *b += bar_[node.result + 1], *c += bar_[node.result + 2]; break;
        case Operation::vec_select: add(a, zero_unless((Bits)value_[node.c], vec_bar(node))); break;
      }
    }
  }

 private:
  struct Node {
    Operation operation;
    int result, a, b, c;
  };

  static Vec<Real> at(const Real* p) { return load_vec(p); }
  static void put(Real* p, Vec<Real> a) { store_vec(p, a); }
  static void add(Real* to, Vec<Real> a) { put(to, at(to) + a); }
  Vec<Real> vec_bar(const Node& node) const { return at(bar_ + node.result); }

  void product(const Node& node, Real g) {
    bar_[node.a] = fma(g, value_[node.b], bar_[node.a]);
    bar_[node.b] = fma(g, value_[node.a], bar_[node.b]);
  }

  void scaled(const Node& node, Vec<Real> g) {
    bar_[node.a] += dot(g, at(value_ + node.b));
    put(bar_ + node.b, fma(value_[node.a], g, at(bar_ + node.b)));
  }

  void crossed(const Node& node, Vec<Real> g) {
    const Vec<Real> one = at(value_ + node.a), other = at(value_ + node.b);
    put(bar_ + node.a, add_cross(at(bar_ + node.a), other, g));
    put(bar_ + node.b, add_cross(at(bar_ + node.b), g, one));
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
GMEM_INLINE Taped operator/(Taped a, Taped b) { return of_product(Operation::divide, a.value / b.value, a, b, Taped{}); }
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

// --- vectors

template <>
struct Vec<Taped> {
  Taped x, y, z;

  Vec<Real> value() const { return {x.value, y.value, z.value}; }
  bool constant() const { return !x.slot && !y.slot && !z.slot; }
};

GMEM_INLINE Vec<Taped> in_slots(const Vec<Real>& a, int slot) { return {{a.x, slot}, {a.y, slot + 1}, {a.z, slot + 2}}; }
inline Vec<Taped> leaf(Vec<Real> a) { return in_slots(a, tape->slot(a)); }
inline Vec<Taped> constant(Vec<Real> a) { return {constant(a.x), constant(a.y), constant(a.z)}; }

// The first slot of a vector; one that was put together from numbers is copied.
GMEM_INLINE int first_slot(const Vec<Taped>& a) {
  if (a.x.slot && a.y.slot == a.x.slot + 1 && a.z.slot == a.x.slot + 2) return a.x.slot;
  const int slot = tape->slot(a.value());
  if (!a.constant()) tape->copy(slot, a.x.slot, a.y.slot, a.z.slot);
  return slot;
}

GMEM_INLINE Vec<Taped> vec_of(Operation operation, Vec<Real> value, int a, int b = 0, int c = 0) {
  return in_slots(value, tape->push(operation, value, a, b, c));
}

GMEM_INLINE Vec<Taped> operator+(const Vec<Taped>& a, const Vec<Taped>& b) {
  return vec_of(Operation::vec_add, a.value() + b.value(), first_slot(a), first_slot(b));
}
GMEM_INLINE Vec<Taped> operator-(const Vec<Taped>& a, const Vec<Taped>& b) {
  return vec_of(Operation::vec_subtract, a.value() - b.value(), first_slot(a), first_slot(b));
}
GMEM_INLINE Vec<Taped> operator-(const Vec<Taped>& a) { return vec_of(Operation::vec_negate, -a.value(), first_slot(a)); }
GMEM_INLINE Vec<Taped> operator*(Taped s, const Vec<Taped>& a) {
  return vec_of(Operation::scale, s.value * a.value(), kept(s), first_slot(a));
}
GMEM_INLINE Vec<Taped> zero_unless(Bits m, const Vec<Taped>& a) {
  return vec_of(Operation::vec_select, zero_unless(m, a.value()), first_slot(a), 0, tape->slot((Real)m));
}
GMEM_INLINE Vec<Taped> fma(Taped s, const Vec<Taped>& a, const Vec<Taped>& b) {
  return vec_of(Operation::vec_fma, fma(s.value, a.value(), b.value()), kept(s), first_slot(a), first_slot(b));
}
GMEM_INLINE Vec<Taped> fnma(Taped s, const Vec<Taped>& a, const Vec<Taped>& b) {
  return vec_of(Operation::vec_fnma, fnma(s.value, a.value(), b.value()), kept(s), first_slot(a), first_slot(b));
}
GMEM_INLINE Taped dot(const Vec<Taped>& a, const Vec<Taped>& b) {
  const Real value = dot(a.value(), b.value());
  return {value, tape->push(Operation::dot, value, first_slot(a), first_slot(b))};
}
GMEM_INLINE Vec<Taped> cross(const Vec<Taped>& a, const Vec<Taped>& b) {
  return vec_of(Operation::cross, cross(a.value(), b.value()), first_slot(a), first_slot(b));
}
GMEM_INLINE Vec<Taped> add_cross(const Vec<Taped>& c, const Vec<Taped>& a, const Vec<Taped>& b) {
  return vec_of(Operation::add_cross, add_cross(c.value(), a.value(), b.value()), first_slot(a), first_slot(b),
                first_slot(c));
}

}  // namespace GMEM_ISA
}  // namespace gmem
