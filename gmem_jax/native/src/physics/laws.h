// The contact laws, term by term those of gmem_jax/physics/contact, for numbers V of any kind.

#pragma once

#include "numbers/vectors.h"
#include "physics/parameters.h"
#include "physics/runs.h"

namespace gmem {
namespace GMEM_ISA {

// A contact under way. Its computation is cut into passes over a batch of contacts that fits into the nearest cache:
// taken alone, a contact is a long chain of operations that wait for each other, more than the processor can look
// ahead; in a pass it meets many short ones.
template <class V>
struct Contact {
  Vec<V> normal;                  // from i to j; the separation of the centres at first
  Vec<V> sliding;                 // relative velocity of the surfaces in the tangent plane; all of it at first
  Vec<V> lever_one, lever_other;  // from the grains' centres to the contact point
  Vec<V> spin_sum;
  Vec<V> force;                   // tangential, on i
  V overlap;                      // negative where apart
  V root_overlap;                 // of 1 where apart
  V normal_force;
  V turned;                       // half the angle by which the contact turns about its normal in this step
  V square;                       // of the length to be inverted next
  V inverse;
  V before;                       // square of the force before it was flattened
  V* history;

  Mask<V> touching() const { return overlap > V{}; }
  V safe_overlap() const { return select(touching(), overlap, splat<V>(1.0)); }
};

// 1 / sqrt(square) of a batch.
template <class V>
inline void invert_roots(Contact<V>* c, int count) {
  for (int n = 0; n < count; ++n) c[n].inverse = inverse_root(c[n].square);
}

// A law's parameters, and products of them that every contact needs.
template <class V>
struct LawParameters {
  V mu, stiffness, damping_time, spacing, inverse_spacing;
  V half_step;  // stiffness dt / 2: what half a step of sliding adds to an elastic force
  V dashpot;    // stiffness times damping time
  V half_dt;

  LawParameters(const V* rows, V dt)
      : mu(rows[0]), stiffness(rows[1]), damping_time(rows[2]), spacing(rows[4]),
        inverse_spacing(splat<V>(1.0) / rows[4]),
        half_step(splat<V>(0.5) * rows[1] * dt), dashpot(rows[1] * rows[2]), half_dt(splat<V>(0.5) * dt) {}
};

// f = k p^1.5 + gamma p^0.5 dp/dt, never attractive.
// gmem_jax/physics/contact/normal.py: hertz
template <class V>
GMEM_INLINE V hertz(Mask<V> touching, V overlap, V root_overlap, V closing, V stiffness, V damping_time) {
  const V force = stiffness * root_overlap * fma(damping_time, closing, overlap);
  return zero_unless(touching & (force > V{}), force);
}

// How a tangential force is carried along in this step: projected on the tangent plane with its magnitude restored,
// and turned about the normal by the Cayley map, whose denominator is restored with the magnitude.
// gmem_jax/physics/contact/kinematics.py: transport
template <class V>
struct Transport {
  Vec<V> normal;
  V cosine, sine, denominator2;

  GMEM_INLINE explicit Transport(const Contact<V>& c) : normal(c.normal) {
    const V one = splat<V>(1.0), denominator = fma(c.turned, c.turned, one);
    cosine = fnma(c.turned, c.turned, one);
    sine = c.turned + c.turned;
    denominator2 = denominator * denominator;
  }

  // First part: flattens `force`; returns the square whose inverse root the second part wants.
  GMEM_INLINE V flatten(Vec<V>& force, V& before) const {
    const V along_normal = dot(force, normal);
    before = dot(force, force);
    force = fnma(along_normal, normal, force);
    return (before * denominator2) * fnma(along_normal, along_normal, before);
  }

  GMEM_INLINE Vec<V> restore(Vec<V> flat, V before, V square, V inverse) const {
    const V scale = select(square > splat<V>(kTiny<V>), before * inverse, splat<V>(1.0));
    return fma(scale * sine, cross(normal, flat), (scale * cosine) * flat);
  }
};

// Carry the force in the histories of a batch along, times `factor(contact)`, and add `push(contact)` times sliding.
template <class V, class Factor, class Pushed>
inline void carry(Contact<V>* c, int count, const Factor& factor, const Pushed& push) {
  for (int n = 0; n < count; ++n) {
    c[n].force = load_vec(c[n].history);
    c[n].square = Transport<V>(c[n]).flatten(c[n].force, c[n].before);
  }
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    const Vec<V> carried = Transport<V>(c[n]).restore(c[n].force, c[n].before, c[n].square, c[n].inverse);
    c[n].force = fma(push(c[n]), c[n].sliding, factor(c[n], carried));
  }
}

// Take the trial forces of a batch back to the friction limit.
// gmem_jax/physics/contact/friction.py: coulomb
template <class V>
inline void coulomb(Contact<V>* c, int count, V mu) {
  for (int n = 0; n < count; ++n) c[n].square = dot(c[n].force, c[n].force);
  invert_roots(c, count);
  for (int n = 0; n < count; ++n) {
    const V limit = mu * c[n].normal_force;
    const V scale = select(c[n].square > limit * limit, limit * c[n].inverse, splat<V>(1.0));
    c[n].force = zero_unless(c[n].touching(), scale * c[n].force);
  }
}

// gmem_jax/physics/contact/frictionless.py: Frictionless.__call__
template <class V>
GMEM_INLINE void friction(Frictionless, Contact<V>* c, int count, const LawParameters<V>&) {
  for (int n = 0; n < count; ++n) c[n].force = Vec<V>{};
}

// gmem_jax/physics/contact/hooke.py: Hooke.__call__
template <class V>
GMEM_INLINE void friction(Hooke, Contact<V>* c, int count, const LawParameters<V>& law) {
  const V push = law.half_step + law.dashpot, rest = law.half_step - law.dashpot;
  carry(c, count, [](const Contact<V>&, Vec<V> carried) { return carried; }, [&](const Contact<V>&) { return push; });
  coulomb(c, count, law.mu);
  for (int n = 0; n < count; ++n)
    store_vec(c[n].history, zero_unless(c[n].touching(), fma(rest, c[n].sliding, c[n].force)));
}

// gmem_jax/physics/contact/mindlin_rescaled.py: MindlinRescaled.__call__
template <class V>
GMEM_INLINE void friction(Rescaled, Contact<V>* c, int count, const LawParameters<V>& law) {
  const V one = splat<V>(1.0);
  const V push = law.stiffness * (law.half_dt + law.damping_time), rest = law.stiffness * (law.half_dt - law.damping_time);
  // sqrt(p / p_old) on unloading; sqrt(p) has been left in `root_overlap`.
  const auto rescaled = [&](const Contact<V>& now, Vec<V> carried) {
    const Mask<V> unloads = now.touching() & (now.overlap < now.history[3]);
    const V ratio = root(select(unloads, now.safe_overlap(), one) / select(unloads, now.history[3], one));
    return ratio * carried;
  };
  carry(c, count, rescaled, [&](const Contact<V>& now) { return push * now.root_overlap; });
  coulomb(c, count, law.mu);
  for (int n = 0; n < count; ++n) {
    store_vec(c[n].history, zero_unless(c[n].touching(), fma(rest * c[n].root_overlap, c[n].sliding, c[n].force)));
    c[n].history[3] = zero_unless(c[n].touching(), c[n].overlap);
  }
}

// Where a contact stands in its rings: `x` of them reached, the outermost, number `outer`, in part; -1 where none is
// attached.
// gmem_jax/physics/contact/mindlin.py: Mindlin.outermost
template <class V, Variant variant>
struct Reach {
  V x, outer;

  Reach(V overlap, const LawParameters<V>& law, int points)
      : x(root(zero_unless(overlap > V{}, overlap)) * law.inverse_spacing) {
    const V last = splat<V>(points - 2.0), begin = splat<V>(variant == Variant::paper ? 0.5 : 0.0);
    const V ring = select(x < last, floor_of(select(x < last, x, V{})), last);
    outer = select(x > begin, ring, splat<V>(-1.0));
  }
};

// `Transport` of many forces of one contact: a matrix.
// gmem_jax/physics/contact/mindlin.py: transport_layers
template <class V>
struct TransportOfMany {
  Vec<V> normal, column[3];
  V denominator2;

  GMEM_INLINE explicit TransportOfMany(const Contact<V>& c) : normal(c.normal) {
    const Transport<V> single(c);
    const Vec<V> turned = single.sine * normal, scaled = single.cosine * normal;
    column[0] = fnma(normal.x, scaled, Vec<V>{single.cosine, turned.z, -turned.y});
    column[1] = fnma(normal.y, scaled, Vec<V>{-turned.z, single.cosine, turned.x});
    column[2] = fnma(normal.z, scaled, Vec<V>{turned.y, -turned.x, single.cosine});
    denominator2 = single.denominator2;
  }

  // First part: moves `force`; returns the square whose inverse root the second part wants.
  GMEM_INLINE V move(Vec<V>& force, V& before) const {
    const V along_normal = dot(force, normal);
    before = dot(force, force);
    force = fma(force.x, column[0], fma(force.y, column[1], force.z * column[2]));
    return (before * denominator2) * fnma(along_normal, along_normal, before);
  }

  // By what it is to be multiplied then; see `Transport.restore`.
  GMEM_INLINE V restoring(V square, V before, V inverse) const {
    return select(square > splat<V>(1e-280), before * inverse, splat<V>(1.0));
  }
};

// One contact. `runs` has `points()`; `count()`, of the lane that has most; `get(k)` and `set(k, run)`; and
// `keep(counts)`, of each lane.
// gmem_jax/physics/contact/mindlin.py: Mindlin.__call__
template <class V, Variant variant, class Runs>
void friction(Layered<variant>, Contact<V>& c, const LawParameters<V>& law, Runs runs) {
  const V one = splat<V>(1.0), half = splat<V>(0.5);
  const Reach<V, variant> before(c.history[0], law, runs.points()), now(c.overlap, law, runs.points());
  if (bits_less(before.outer, now.outer) | bits_less(now.outer, before.outer)) reattach(runs, before.outer, now.outer);

  // The force in a ring that fills stays: Mindlin._diluted.
  const V filled = before.x - before.outer;
  const V fills = select(before.outer < now.outer, one, now.x - before.outer);
  const Mask<V> grows = filled < fills;
  const V dilution = select(grows, filled / select(grows, fills, one), one);

  const TransportOfMany<V> transport(c);
  const Vec<V> half_step = law.half_step * c.sliding;
  constexpr int kRuns = kTogether;
  Run<V> run[kRuns];
  V squared[kRuns], product[kRuns], inverse[kRuns];
  Vec<V> sum{};
  const int stored = runs.count();
  for (int first = 0; first < stored; first += kRuns) {
    const int count = stored - first < kRuns ? stored - first : kRuns;
    for (int n = 0; n < count; ++n) {
      run[n] = runs.get(first + n);
      product[n] = transport.move(run[n].force, squared[n]);
    }
    for (int n = 0; n < count; ++n) inverse[n] = inverse_root(product[n]);
    const V next = first + count < stored ? runs.get(first + count).start : splat<V>(kNowhere);
    for (int n = 0; n < count; ++n) {
      const V start = run[n].start, end = n + 1 < count ? run[n + 1].start : next;
      V scale = transport.restoring(product[n], squared[n], inverse[n]);
      if (variant == Variant::averaged) scale = select(start < before.outer, one, dilution) * scale;
      V weight = select(end < now.x, end, now.x) - start;
      if (variant == Variant::paper && first + n == 0) weight = weight - half;
      run[n].force = fma(scale, run[n].force, half_step);
      sum = fma(zero_unless(start <= now.x, weight), run[n].force, sum);
      runs.set(first + n, run[n]);
    }
  }
  const Mask<V> attached = now.outer > V{} - half;
  const V total = select(attached, variant == Variant::paper ? now.x - half : now.x, one);
  const Vec<V> trial = fma(law.spacing, sum, (law.dashpot * c.root_overlap) * c.sliding);
  c.force = trial;
  coulomb(&c, 1, law.mu);
  const Vec<V> correction = fma(one / (law.spacing * total), c.force - trial, half_step);
  for (int k = 0; k < stored; ++k) {
    Run<V> last = runs.get(k);
    last.force = zero_unless(last.start <= now.x, last.force + correction);
    runs.set(k, last);
  }
  c.history[0] = zero_unless(c.touching(), c.overlap);
}

}  // namespace GMEM_ISA
}  // namespace gmem
