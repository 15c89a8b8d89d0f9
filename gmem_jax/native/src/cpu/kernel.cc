// The time step for one instruction set. This file is compiled once for each set, with the compiler's flags for it, and
// with GMEM_ISA as the name of its namespace. It is compiled again with GMEM_DERIVATIVES for derivatives of the steps,
// and with GMEM_SECOND_DERIVATIVES for second derivatives.

#include <cstdint>
#include <cstdlib>

#if defined(GMEM_DERIVATIVES) || defined(GMEM_SECOND_DERIVATIVES)
#include "cpu/adjoint.h"
#else
#include "cpu/census.h"
#include "cpu/packed.h"
#endif
#include "cpu/replicas.h"

namespace gmem {
namespace GMEM_ISA {

// A type as an argument: `with_worker` calls `function` with an `As` of the `Engine` or `Adjoint` that does the work.
template <class T>
struct As {
  using type = T;
};

template <class Function>
auto with_worker(const Problem& problem, [[maybe_unused]] const Block& block, const Function& function) {
  return with_law(problem.law, problem.variant, [&](auto law) {
    using L = decltype(law);
#ifdef GMEM_DERIVATIVES
    return problem.task == Task::tangent ? function(As<Engine<Replicas<L, Dual<Real>>>>{})
                                         : function(As<Adjoint<L, Real>>{});
#elif defined(GMEM_SECOND_DERIVATIVES)
    return function(As<Adjoint<L, Dual<Real>>>{});
#else
#ifndef GMEM_DOUBLE_ONLY  // for sanitizers, under which these take many minutes to compile
    if constexpr (!L::kLayered) {
      if (problem.mixed && block.wide) return function(As<Engine<Replicas<L, Pair, Single<2 * W>>>>{});
      if (problem.mixed) return function(As<Engine<Replicas<L, Real, Single<W>>>>{});
    }
#endif
    return block.packed ? function(As<Engine<Packed<L>>>{}) : function(As<Engine<Replicas<L, Real>>>{});
#endif
  });
}

std::size_t scratch_bytes(const Problem& problem, const Block& block) {
  return with_worker(problem, block, [&](auto as) {
    Arena arena{nullptr};
    typename decltype(as)::type::Layout().place(problem, block, arena);
    return arena.used;
  });
}

// Treats numbers too small for a full mantissa as zero, as XLA's own threads do: every thread must do the same.
class FlushDenormals {
 public:
#if defined(__SSE2__)
  FlushDenormals() : saved_(_mm_getcsr()) { _mm_setcsr(saved_ | 0x8040); }
  ~FlushDenormals() { _mm_setcsr(saved_); }

 private:
  unsigned saved_;
#elif defined(__aarch64__)
  FlushDenormals() {
    asm volatile("mrs %0, fpcr" : "=r"(saved_));
    asm volatile("msr fpcr, %0" : : "r"(saved_ | (std::uint64_t{1} << 24)));
  }
  ~FlushDenormals() { asm volatile("msr fpcr, %0" : : "r"(saved_)); }

 private:
  std::uint64_t saved_;
#endif
};

void run(const Problem& problem, const Block& block, Team& team, int rank, void* scratch) {
  const FlushDenormals flush;
  with_worker(problem, block, [&](auto as) { typename decltype(as)::type(problem, block, team, rank, scratch).run(); });
}

#define GMEM_STRING2(name) #name
#define GMEM_STRING(name) GMEM_STRING2(name)
extern const InstructionSet kernel;
#if defined(GMEM_DERIVATIVES) || defined(GMEM_SECOND_DERIVATIVES)
const InstructionSet kernel = {GMEM_STRING(GMEM_ISA), W, scratch_bytes, run, nullptr};
#else
const InstructionSet kernel = {GMEM_STRING(GMEM_ISA), W, scratch_bytes, run, census};
#endif

}  // namespace GMEM_ISA
}  // namespace gmem
