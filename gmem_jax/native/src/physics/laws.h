// The contact laws, term by term those of gmem_jax/physics/contact, for numbers V of any kind.

#pragma once

#include "numbers/vectors.h"
#include "physics/parameters.h"
#include "physics/segments.h"

namespace gmem {
namespace GMEM_ISA {

// A contact while it is computed. The computation is cut into passes over a batch of contacts that fits into the
// nearest cache. One contact alone is a chain of operations that wait for each other, longer than the processor can
// look ahead. A pass has many short chains, which the processor overlaps.
template <class V>
struct Contact {
  Vec<V> normal;                  // from i to j; before `close`, the separation of the centres
  Vec<V> sliding;                 // relative velocity of the surfaces in the tangent plane; before `close`, all of it
  Vec<V> lever_one, lever_other;  // from the grains' centres to the contact point
  Vec<V> spin_sum;
  Vec<V> force;    // tangential, on i
  V overlap;       // negative where the spheres are apart
  V root_overlap;  // its square root; 1 where the spheres are apart
  V normal_force;
  V turned;  // half the angle by which the contact turns about its normal in this step
  V square;  // of the length to be inverted next
  V inverse;
  V before;  // square of the force before its projection on the tangent plane
  V* history;

  constexpr Mask<V> touching() const { return overlap > V{}; }
  constexpr V safe_overlap() const { return select(touching(), overlap, splat<V>(1.0)); }
};

// 1 / sqrt(square) of a batch.
template <class V>
constexpr void invert_roots(Contact<V>* c, int count) {
  for (int n = 0; n < count; ++n) c[n].inverse = inverse_root(c[n].square);
}

// Where number `q` of the history in row `row` lies in the arrays of a call. Leaf 0 is the vector of the history, leaf
// 1 the overlap. In Mindlin's law leaf 0 is the layers, and the numbers of the others are one higher.
struct Place {
  int leaf;
  long long row;
};

template <class Law>
inline Place place_of(long long row, int q) {
  return q < Law::kVectors ? Place{Law::kLayered, row * Law::kVectors + q} : Place{Law::kLayered + 1, row};
}

// A law's parameters, and products of them that every contact needs.
template <class V>
struct LawParameters {
  V mu, spacing, inverse_spacing;
  V growth;   // stiffness times dt: sliding at velocity v adds v times this to an elastic force in a step
  V dashpot;  // stiffness times damping time

  LawParameters() = default;

  constexpr LawParameters(const V* rows, V dt)
      : mu(rows[0]), spacing(rows[4]), inverse_spacing(splat<V>(1.0) / rows[4]), growth(rows[1] * dt),
        dashpot(rows[1] * rows[2]) {}
};

// f = k p^1.5 + gamma p^0.5 dp/dt, never attractive.
// gmem_jax/physics/contact/normal.py: hertz
template <class V>
constexpr GMEM_INLINE V hertz(Mask<V> touching, V overlap, V root_overlap, V closing, V stiffness, V damping_time) {
  const V force = stiffness * root_overlap * fma(damping_time, closing, overlap);
  return zero_unless(touching & (force > V{}), force);
}

// How a tangential force is carried along with its contact in a step. It is projected on the tangent plane, and turned
// about the normal by the Cayley map. One factor restores the magnitude and divides by the denominator of that map.
// gmem_jax/physics/contact/kinematics.py: transport
template <class V>
struct Transport {
  Vec<V> normal;
  V cosine, sine, denominator2;

  constexpr GMEM_INLINE explicit Transport(const Contact<V>& c) : normal(c.normal) {
    const V one = splat<V>(1.0), denominator = fma(c.turned, c.turned, one);
    cosine = fnma(c.turned, c.turned, one);
    sine = c.turned + c.turned;
    denominator2 = denominator * denominator;
  }

  // First part: projects `force` on the tangent plane. Returns the square whose inverse root `restore` needs.
  constexpr GMEM_INLINE V flatten(Vec<V>& force, V& before) const {
    const V along_normal = dot(force, normal);
    before = dot(force, force);
    force = fnma(along_normal, normal, force);
    return (before * denominator2) * fnma(along_normal, along_normal, before);
  }

  constexpr GMEM_INLINE Vec<V> restore(Vec<V> flat, V before, V square, V inverse) const {
    const V scale = select(square > splat<V>(kTiny<V>), before * inverse, splat<V>(1.0));
    return fma(scale * sine, cross(normal, flat), (scale * cosine) * flat);
  }
};

// Carries the vector `from(contact)` along with each contact of a batch; its force becomes `then(contact, carried)`.
template <class V, class From, class Then>
constexpr void carry(Contact<V>* c, int count, const From& from, const Then& then) {
  for (int n = 0; n < count; ++n) {
    c[n].force = from(c[n]);
    c[n].square = Transport<V>(c[n]).flatten(c[n].force, c[n].before);
  }
  invert_roots(c, count);
  for (int n = 0; n < count; ++n)
    c[n].force = then(c[n], Transport<V>(c[n]).restore(c[n].force, c[n].before, c[n].square, c[n].inverse));
}

// The vector that a history begins with.
struct Remembered {
  template <class V>
  constexpr GMEM_INLINE Vec<V> operator()(const Contact<V>& c) const {
    return load_vec(c.history);
  }
};

// The factor that takes a trial force, whose square is `c.square`, back to the friction limit. Most contacts stick, and
// need no root. A GPU, which computes one contact at a time, always takes the root: it lacks registers for the branch.
// gmem_jax/physics/contact/friction.py: coulomb
template <class V>
constexpr GMEM_INLINE V limited(Contact<V>& c, V mu) {
  const V limit = mu * c.normal_force, one = splat<V>(1.0);
  if (kTogether > 1 && !bits_less(limit * limit, c.square)) return one;
  invert_roots(&c, 1);
  return select(c.square > limit * limit, limit * c.inverse, one);
}

// Take the trial forces of a batch back to the friction limit.
template <class V>
constexpr void coulomb(Contact<V>* c, int count, V mu) {
  for (int n = 0; n < count; ++n) {
    c[n].square = dot(c[n].force, c[n].force);
    c[n].force = zero_unless(c[n].touching(), limited(c[n], mu) * c[n].force);
  }
}

// gmem_jax/physics/contact/frictionless.py: Frictionless.__call__
template <class V>
constexpr GMEM_INLINE void friction(Frictionless, Contact<V>* c, int count, const LawParameters<V>&) {
  for (int n = 0; n < count; ++n) c[n].force = Vec<V>{};
}

// gmem_jax/physics/contact/hooke.py: Hooke.__call__
template <class V>
constexpr GMEM_INLINE void friction(Hooke, Contact<V>* c, int count, const LawParameters<V>& law) {
  const V push = law.growth + law.dashpot;
  carry(c, count, Remembered{}, [&](const Contact<V>& now, Vec<V> carried) { return fma(push, now.sliding, carried); });
  coulomb(c, count, law.mu);
  for (int n = 0; n < count; ++n)
    store_vec(c[n].history, zero_unless(c[n].touching(), fnma(law.dashpot, c[n].sliding, c[n].force)));
}

// gmem_jax/physics/contact/mindlin_rescaled.py: MindlinRescaled.__call__
template <class V>
constexpr GMEM_INLINE void friction(Rescaled, Contact<V>* c, int count, const LawParameters<V>& law) {
  const V one = splat<V>(1.0), push = law.growth + law.dashpot;
  // Unloading multiplies the force by sqrt(p / p_old). `close` left sqrt(p) in `root_overlap`.
  carry(c, count, Remembered{}, [&](const Contact<V>& now, Vec<V> carried) {
    const V last = now.history[kLastOverlap];
    const Mask<V> unloads = now.touching() & (now.overlap < last);
    const V ratio = root(select(unloads, now.safe_overlap(), one) / select(unloads, last, one));
    return fma(push * now.root_overlap, now.sliding, ratio * carried);
  });
  coulomb(c, count, law.mu);
  for (int n = 0; n < count; ++n) {
    store_vec(c[n].history,
              zero_unless(c[n].touching(), fnma(law.dashpot * c[n].root_overlap, c[n].sliding, c[n].force)));
    c[n].history[kLastOverlap] = zero_unless(c[n].touching(), c[n].overlap);
  }
}

// How far a contact has come in Mindlin's rings: its radius `x` = sqrt(overlap) / spacing, in rings, and the number
// `outer` of the outermost ring that it has reached, which is attached in part; -1 where no ring is attached.
// gmem_jax/physics/contact/mindlin.py: Mindlin.outermost
template <class V, Variant variant>
struct Reach {
  V x, outer;

  // All rings from number `last` on are one ring.
  constexpr Reach(V overlap, const LawParameters<V>& law, V last)
      : x(root(zero_unless(overlap > V{}, overlap)) * law.inverse_spacing) {
    const V begin = splat<V>(variant == Variant::paper ? 0.5 : 0.0);
    const V ring = select(x < last, floor_of(select(x < last, x, V{})), last);
    outer = select(x > begin, ring, splat<V>(-1.0));
  }
};

// How much less than 1 ring 0 weighs.
template <Variant variant>
constexpr double kLacking = variant == Variant::paper ? 0.5 : 0.0;

// A vector that is not along the unit vector `normal`.
// gmem_jax/physics/contact/mindlin.py: any_tangent
template <class V>
constexpr GMEM_INLINE Vec<V> any_tangent(Vec<V> normal) {
  const V one = splat<V>(1.0), near = splat<V>(0.6);
  const Mask<V> near_x = (near < normal.x) | (near < -normal.x);
  return {select(near_x, V{}, one), zero_unless(near_x, one), V{}};
}

// `segments_of(n)` are the segments of contact n (segments.h). They have `last()`, see `Reach`; `count()`, the number
// in the lane that has most; `get(k)` and `set(k, segment)`; `keep(counts)`, which sets the number in each lane; and
// `remember()`, which is called before segments change.
// gmem_jax/physics/contact/mindlin.py: Mindlin.__call__
template <class V, Variant variant, class SegmentsOf>
constexpr GMEM_INLINE void friction(Layered<variant>, Contact<V>* c, int count, const LawParameters<V>& law,
                                    const SegmentsOf& segments_of) {
  const V one = splat<V>(1.0), lacking = splat<V>(kLacking<variant>);
  const auto frame = [](const Contact<V>& now) {
    return select(now.history[kLastOverlap] > V{}, load_vec(now.history), any_tangent(now.normal));
  };
  carry(c, count, frame, [](const Contact<V>&, Vec<V> carried) { return carried; });

  Flat<V> sliding[kTogether], trial[kTogether];
  V weight[kTogether], total[kTogether];  // of the rings inside the outermost; of all rings
  Mask<V> attached[kTogether];
  for (int n = 0; n < count; ++n) {
    auto segments = segments_of(n);
    const V last = segments.last();
    const Reach<V, variant> before(c[n].history[kLastOverlap], law, last), now(c[n].overlap, law, last);
    Layers<V> layers = load_layers(c[n].history + kLayers);
    if (variant == Variant::averaged) {  // a ring that fills keeps its force, so its f shrinks: Mindlin._diluted
      const V filled = before.x - before.outer, fills = select(before.outer < now.outer, one, now.x - before.outer);
      const Mask<V> grows = filled < fills;
      layers.rim = select(grows, filled / select(grows, fills, one), one) * layers.rim;
    }
    if (bits_less(before.outer, now.outer) | bits_less(now.outer, before.outer))
      reattach(segments, layers, before.outer, now.outer, kLacking<variant>);
    store_layers(c[n].history + kLayers, layers);

    const Mask<V> beyond = V{} < now.outer;
    attached[n] = V{} <= now.outer;
    weight[n] = zero_unless(beyond, now.outer - lacking);
    const V rim = zero_unless(attached[n], now.x - now.outer - select(beyond, V{}, lacking));
    const V whole = weight[n] + rim;
    total[n] = select(attached[n], whole, one);
    sliding[n] = {dot(c[n].sliding, c[n].force), dot(c[n].sliding, cross(c[n].normal, c[n].force))};
    const V pushed = fma(law.spacing, whole * law.growth, law.dashpot * c[n].root_overlap);
    trial[n] = fma(pushed, sliding[n], law.spacing * fma(rim, layers.rim, layers.inside));
    c[n].square = dot(trial[n], trial[n]);
  }
  for (int n = 0; n < count; ++n) {
    const V scale = limited(c[n], law.mu);
    const Mask<V> touching = c[n].touching();
    const Flat<V> push = fma((scale - one) / (law.spacing * total[n]), trial[n], law.growth * sliding[n]);
    Layers<V> layers = load_layers(c[n].history + kLayers);
    layers.common = zero_unless(attached[n], layers.common + push);
    layers.inside = fma(weight[n], push, layers.inside);
    layers.rim = zero_unless(attached[n], layers.rim + push);
    store_layers(c[n].history + kLayers, layers);
    const Vec<V> along = zero_unless(touching, c[n].force);
    store_vec(c[n].history, along);
    c[n].history[kLastOverlap] = zero_unless(touching, c[n].overlap);
    const Flat<V> force = scale * trial[n];
    c[n].force = fma(force.along, along, force.across * cross(c[n].normal, along));
  }
}

}  // namespace GMEM_ISA
}  // namespace gmem
