// Reverse mode without a tape. A calculation whose operations are always the same is recorded by the compiler: with
// `Symbol`s in place of numbers it leaves a `Program`, its operations in order. From these the compiler makes
// straight-line code, forwards and backwards, that keeps its numbers in registers. The calculation is written once, in
// the forward code. `pull_back` gives the same bars as a `Tape`.
//
// Comparisons are recorded as masks, and both sides of a `select` are calculated. Where the forward code leaves out a
// part that no lane needs (`bits_less`), a program always has that part.

#pragma once

#include "numbers/number.h"
#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

// The last four give masks.
enum class Step : unsigned char {
  input,
  constant,
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
  floor,
  select,
  less,
  at_most,
  both,
  either
};

// The use of the derivative ("bar") by an input: not wanted, written to its place, or added to the number there.
enum class Bar : unsigned char { none, set, add };

class Program {
 public:
  static constexpr int kCapacity = 1024, kMaxResults = 48;

  // Operands are numbers of earlier nodes; of an input `a` is the array and `b` the place in it.
  struct Node {
    Step step = Step::constant;
    Bar bar = Bar::none;
    bool active = false;  // whether it depends on an input that has a bar
    short a = -1, b = -1, c = -1;
    double constant = 0.0;
  };

  Node node[kCapacity] = {};
  int result[kMaxResults] = {};
  int nodes = 0, results = 0;

  constexpr int push(const Node& now) {
    node[nodes] = now;
    return nodes++;
  }
};

// Which bars have a value when the way back comes to a node. Bars that nothing has reached yet need neither be set to
// zero nor read.
struct Reached {
  bool node[Program::kCapacity] = {};        // at last
  bool seeded[Program::kMaxResults] = {};    // before a result's own bar is added
  bool operand[Program::kCapacity][3] = {};  // before this node adds to that of its operand

  constexpr explicit Reached(const Program& p) {
    for (int r = 0; r < p.results; ++r) seeded[r] = reach(p, p.result[r]);
    for (int n = p.nodes - 1; n >= 0; --n) {
      const Program::Node& now = p.node[n];
      if (!node[n] || now.step == Step::input) continue;
      operand[n][0] = reach(p, now.a);
      operand[n][1] = reach(p, now.b);
      operand[n][2] = now.step != Step::select && reach(p, now.c);
    }
  }

 private:
  constexpr bool reach(const Program& p, int n) {
    if (n < 0 || !p.node[n].active) return false;
    const bool before = node[n];
    node[n] = true;
    return before;
  }
};

struct SymbolMask;

// A number of a program, or a constant.
struct Symbol {
  Program* program = nullptr;
  int number = -1;
  double value = 0.0;  // of a constant

  static constexpr Symbol of(double a) { return {nullptr, -1, a}; }
};

struct SymbolMask {
  Program* program = nullptr;
  int number = -1;
};

constexpr Symbol input(Program& program, int array, int place, Bar bar) {
  Program::Node node;
  node.step = Step::input, node.bar = bar, node.active = bar != Bar::none;
  node.a = static_cast<short>(array), node.b = static_cast<short>(place);
  return {&program, program.push(node), 0.0};
}

constexpr short number_in(Program& program, const Symbol& a) {
  if (a.program) return static_cast<short>(a.number);
  Program::Node node;
  node.constant = a.value;
  return static_cast<short>(program.push(node));
}

constexpr void result(Program& program, const Symbol& a) { program.result[program.results++] = number_in(program, a); }
constexpr void result(Program& program, const Vec<Symbol>& a) {
  result(program, a.x), result(program, a.y), result(program, a.z);
}

// An operation on constants alone cannot be recorded: it is no constant expression, and the compiler says so.
constexpr int record(Step step, Program* program, int a, int b = -1, int c = -1) {
  Program::Node node;
  node.step = step;
  node.a = static_cast<short>(a), node.b = static_cast<short>(b), node.c = static_cast<short>(c);
  const bool differentiable = step != Step::floor && step < Step::less;
  node.active = differentiable &&
                (program->node[a].active || (b >= 0 && program->node[b].active) || (c >= 0 && program->node[c].active));
  return program->push(node);
}

constexpr Symbol of_one(Step step, const Symbol& a) { return {a.program, record(step, a.program, a.number), 0.0}; }
constexpr Symbol of_two(Step step, const Symbol& a, const Symbol& b) {
  Program* const p = a.program ? a.program : b.program;
  const int one = number_in(*p, a), other = number_in(*p, b);
  return {p, record(step, p, one, other), 0.0};
}
constexpr Symbol of_three(Step step, const Symbol& a, const Symbol& b, const Symbol& c) {
  Program* const p = a.program ? a.program : b.program ? b.program : c.program;
  const int one = number_in(*p, a), other = number_in(*p, b), third = number_in(*p, c);
  return {p, record(step, p, one, other, third), 0.0};
}
constexpr SymbolMask compared(Step step, const Symbol& a, const Symbol& b) {
  const Symbol found = of_two(step, a, b);
  return {found.program, found.number};
}

constexpr Symbol operator+(const Symbol& a, const Symbol& b) { return of_two(Step::add, a, b); }
constexpr Symbol operator-(const Symbol& a, const Symbol& b) { return of_two(Step::subtract, a, b); }
constexpr Symbol operator*(const Symbol& a, const Symbol& b) { return of_two(Step::multiply, a, b); }
constexpr Symbol operator/(const Symbol& a, const Symbol& b) { return of_two(Step::divide, a, b); }
constexpr Symbol operator-(const Symbol& a) { return of_one(Step::negate, a); }
constexpr Symbol root(const Symbol& a) { return of_one(Step::root, a); }
constexpr Symbol inverse_root(const Symbol& a) { return of_one(Step::inverse_root, a); }
constexpr Symbol floor_of(const Symbol& a) { return of_one(Step::floor, a); }
constexpr Symbol fma(const Symbol& a, const Symbol& b, const Symbol& c) { return of_three(Step::fma, a, b, c); }
constexpr Symbol fms(const Symbol& a, const Symbol& b, const Symbol& c) { return of_three(Step::fms, a, b, c); }
constexpr Symbol fnma(const Symbol& a, const Symbol& b, const Symbol& c) { return of_three(Step::fnma, a, b, c); }

constexpr SymbolMask operator<(const Symbol& a, const Symbol& b) { return compared(Step::less, a, b); }
constexpr SymbolMask operator>(const Symbol& a, const Symbol& b) { return compared(Step::less, b, a); }
constexpr SymbolMask operator<=(const Symbol& a, const Symbol& b) { return compared(Step::at_most, a, b); }
constexpr SymbolMask operator&(const SymbolMask& a, const SymbolMask& b) {
  return {a.program, record(Step::both, a.program, a.number, b.number)};
}
constexpr SymbolMask operator|(const SymbolMask& a, const SymbolMask& b) {
  return {a.program, record(Step::either, a.program, a.number, b.number)};
}
constexpr Symbol select(const SymbolMask& m, const Symbol& a, const Symbol& b) {
  const int one = number_in(*m.program, a), other = number_in(*m.program, b);
  return {m.program, record(Step::select, m.program, one, other, m.number), 0.0};
}
constexpr Symbol zero_unless(const SymbolMask& m, const Symbol& a) { return select(m, a, Symbol{}); }

constexpr unsigned bits_less(const Symbol&, const Symbol&) { return 1; }
constexpr Symbol max(const Symbol& a, const Symbol&) { return a; }  // its only use is whether walls are near

// A calculation is a structure with a function `record`, which returns its program.
template <class Calculation>
constexpr Program program_of = Calculation::record();
template <class Calculation>
constexpr Reached reached_in{program_of<Calculation>};

// The inverse root of a double is infinite at zero; that of a CPU's vectors is not. A `select` drops it forwards, but
// on the way back it would be multiplied by zero.
template <class V>
GMEM_INLINE V finite_inverse_root(V a) {
  return inverse_root(a);
}
GMEM_INLINE double finite_inverse_root(double a) { return zero_unless(a > 0.0, inverse_root(a)); }

// One node of a calculation's program, forwards: its number goes to `value`, or its mask to `mask`.
template <class Calculation, int n, class V>
GMEM_INLINE void evaluate(const V* const* in, V* value, Mask<V>* mask) {
  constexpr Program::Node now = program_of<Calculation>.node[n];
  constexpr Step step = now.step;
  if constexpr (step == Step::input) value[n] = in[now.a][now.b];
  if constexpr (step == Step::constant) value[n] = splat<V>(now.constant);
  if constexpr (step == Step::add) value[n] = value[now.a] + value[now.b];
  if constexpr (step == Step::subtract) value[n] = value[now.a] - value[now.b];
  if constexpr (step == Step::negate) value[n] = -value[now.a];
  if constexpr (step == Step::multiply) value[n] = value[now.a] * value[now.b];
  if constexpr (step == Step::divide) value[n] = value[now.a] / value[now.b];
  if constexpr (step == Step::fma) value[n] = fma(value[now.a], value[now.b], value[now.c]);
  if constexpr (step == Step::fms) value[n] = fms(value[now.a], value[now.b], value[now.c]);
  if constexpr (step == Step::fnma) value[n] = fnma(value[now.a], value[now.b], value[now.c]);
  if constexpr (step == Step::root) value[n] = root(value[now.a]);
  if constexpr (step == Step::inverse_root) value[n] = finite_inverse_root(value[now.a]);
  if constexpr (step == Step::floor) value[n] = floor_of(value[now.a]);
  if constexpr (step == Step::select) value[n] = select(mask[now.c], value[now.a], value[now.b]);
  if constexpr (step == Step::less) mask[n] = value[now.a] < value[now.b];
  if constexpr (step == Step::at_most) mask[n] = value[now.a] <= value[now.b];
  if constexpr (step == Step::both) mask[n] = mask[now.a] & mask[now.b];
  if constexpr (step == Step::either) mask[n] = mask[now.a] | mask[now.b];
}

// ... and backwards: from its bar to those of its operands.
template <class Calculation, int n, class V>
GMEM_INLINE void reverse(const V* value, const Mask<V>* mask, V* bar) {
  constexpr Program::Node now = program_of<Calculation>.node[n];
  constexpr Step step = now.step;
  if constexpr (now.active && step != Step::input && reached_in<Calculation>.node[n]) {
    constexpr auto wanted = [](int operand) { return operand >= 0 && program_of<Calculation>.node[operand].active; };
    constexpr bool a_wanted = wanted(now.a), b_wanted = wanted(now.b), c_wanted = wanted(now.c);
    constexpr bool a_there = reached_in<Calculation>.operand[n][0], b_there = reached_in<Calculation>.operand[n][1];
    constexpr bool c_there = reached_in<Calculation>.operand[n][2];
    const V g = bar[n];
    const auto to_a = [&](V more) {
      if constexpr (a_wanted) bar[now.a] = a_there ? bar[now.a] + more : more;
    };
    const auto to_b = [&](V more) {
      if constexpr (b_wanted) bar[now.b] = b_there ? bar[now.b] + more : more;
    };
    const auto to_c = [&](V more) {
      if constexpr (c_wanted) bar[now.c] = c_there ? bar[now.c] + more : more;
    };
    if constexpr (step == Step::add) to_a(g), to_b(g);
    if constexpr (step == Step::subtract) to_a(g), to_b(-g);
    if constexpr (step == Step::negate) to_a(-g);
    if constexpr (step == Step::multiply || step == Step::fma || step == Step::fms) {
      if constexpr (a_wanted) bar[now.a] = a_there ? fma(g, value[now.b], bar[now.a]) : g * value[now.b];
      if constexpr (b_wanted) bar[now.b] = b_there ? fma(g, value[now.a], bar[now.b]) : g * value[now.a];
    }
    if constexpr (step == Step::fma) to_c(g);
    if constexpr (step == Step::fms) to_c(-g);
    if constexpr (step == Step::fnma) {
      if constexpr (a_wanted) bar[now.a] = a_there ? fnma(g, value[now.b], bar[now.a]) : -(g * value[now.b]);
      if constexpr (b_wanted) bar[now.b] = b_there ? fnma(g, value[now.a], bar[now.b]) : -(g * value[now.a]);
      to_c(g);
    }
    if constexpr (step == Step::divide) {
      const V by_a = g / value[now.b];
      to_a(by_a);
      if constexpr (b_wanted) bar[now.b] = b_there ? fnma(by_a, value[n], bar[now.b]) : -(by_a * value[n]);
    }
    if constexpr (step == Step::root)  // at zero, where it has no derivative, zero
      to_a(zero_unless(value[n] > V{}, splat<V>(0.5) * g / value[n]));
    if constexpr (step == Step::inverse_root)  // a bar of zero stays zero, even where the slope is infinite
      to_a(zero_unless(differ(g, V{}), splat<V>(-0.5) * (((g * value[n]) * value[n]) * value[n])));
    if constexpr (step == Step::select) to_a(zero_unless(mask[now.c], g)), to_b(select(mask[now.c], V{}, g));
  }
}

template <class Calculation, int n, class V>
GMEM_INLINE void put_bar(const V* bar, V* const* in_bar) {
  constexpr Program::Node now = program_of<Calculation>.node[n];
  if constexpr (now.step == Step::input && now.active) {
    V& to = in_bar[now.a][now.b];
    if constexpr (now.bar == Bar::set) to = reached_in<Calculation>.node[n] ? bar[n] : V{};
    if constexpr (now.bar == Bar::add && reached_in<Calculation>.node[n]) to += bar[n];
  }
}

template <class Calculation, int r, class V>
GMEM_INLINE void seed_bar(V* bar, const V* result_bar) {
  constexpr int n = program_of<Calculation>.result[r];
  if constexpr (program_of<Calculation>.node[n].active)
    bar[n] = reached_in<Calculation>.seeded[r] ? bar[n] + result_bar[r] : result_bar[r];
}

// The numbers from 0 to `count` - 1, as of std::make_integer_sequence: NVRTC has no standard library.
template <int... n>
struct Sequence {
  using Twice = Sequence<n..., (static_cast<int>(sizeof...(n)) + n)...>;
  using AndOne = Sequence<n..., static_cast<int>(sizeof...(n))>;
};
template <int count>
constexpr auto up_to() {
  if constexpr (count == 0) {
    return Sequence<>{};
  } else if constexpr (count % 2 == 0) {
    return typename decltype(up_to<count / 2>())::Twice{};
  } else {
    return typename decltype(up_to<count - 1>())::AndOne{};
  }
}

template <class Calculation, class V, int... n, int... r>
GMEM_INLINE void pull_back_by(Sequence<n...>, Sequence<r...>, const V* const* in, const V* result_bar,
                              V* const* in_bar) {
  V value[sizeof...(n)], bar[sizeof...(n)];
  Mask<V> mask[sizeof...(n)];
  using InOrder = int[];
  (void)InOrder{(evaluate<Calculation, n>(in, value, mask), 0)...};
  (void)InOrder{(seed_bar<Calculation, r>(bar, result_bar), 0)...};
  (void)InOrder{(reverse<Calculation, static_cast<int>(sizeof...(n)) - 1 - n>(value, mask, bar), 0)...};
  (void)InOrder{(put_bar<Calculation, n>(bar, in_bar), 0)...};
}

// From the bars of a calculation's results to those of its inputs, array by array.
template <class Calculation, class V>
GMEM_APART void pull_back(const V* const* in, const V* result_bar, V* const* in_bar) {
  pull_back_by<Calculation>(up_to<program_of<Calculation>.nodes>(), up_to<program_of<Calculation>.results>(), in,
                            result_bar, in_bar);
}

}  // namespace GMEM_ISA
}  // namespace gmem
