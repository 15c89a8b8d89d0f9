// The contact laws, term by term those of gmem_jax/physics/contact, for numbers V of any kind.

#pragma once

#include "numbers/vectors.h"
#include "physics/parameters.h"

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
      : mu(rows[0]), stiffness(rows[1]), damping_time(rows[2]), spacing(rows[3]),
        inverse_spacing(splat<V>(1.0) / rows[3]),
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

  // Forces below 1e-70, whose squares would underflow, are not worth a magnitude.
  GMEM_INLINE Vec<V> restore(Vec<V> flat, V before, V square, V inverse) const {
    const V scale = select(square > splat<V>(1e-280), before * inverse, splat<V>(1.0));
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

// Where a contact stands in its rings: `x` rings reached, the outermost number `outer` filled in part.
// gmem_jax/physics/contact/mindlin.py: Mindlin.outermost
template <class V>
struct Reach {
  V x, outer;

  Reach(V root_overlap, const LawParameters<V>& law, int points) : x(root_overlap * law.inverse_spacing) {
    const V last = splat<V>(points - 2.0);
    outer = select(x < last, floor_of(select(x < last, x, V{})), last);
  }
};

// How much point `j` counts, by "exact" weights.
// gmem_jax/physics/contact/mindlin.py: Mindlin.weights
template <class V>
inline V weight(const Reach<V>& r, V j) {
  return zero_unless(j <= r.outer, select(j < r.outer, splat<V>(1.0), r.x - j));
}

// One contact. `layers` has `get(j)`, zero beyond the layers that are stored; `set(j, f)`; `stored(j)`, what `set`
// stored; and `keep(count)`, after which the others are zero.
// gmem_jax/physics/contact/mindlin.py: Mindlin.__call__
template <class V, Variant variant, class Layers>
void friction(Layered<variant>, Contact<V>& c, const LawParameters<V>& law, Layers layers) {
  const V one = splat<V>(1.0), half = splat<V>(0.5);
  const Mask<V> touching = c.touching();
  const Transport<V> transport(c);
  const Reach<V> now(c.root_overlap, law, layers.points());
  const Vec<V> half_step = law.half_step * c.sliding;
  Mask<V> attached = touching;
  V total = now.x;
  if (variant == Variant::paper) {
    attached &= now.x > half;
    total = select(now.x > half, now.x - half, one);
  }
  const Reach<V> before(variant == Variant::averaged ? root(c.history[0]) : V{}, law, layers.points());

  // Rings below `whole` are filled in every lane, before and now, and need no masks.
  const int end = static_cast<int>(largest(zero_unless(touching, now.outer))) + 1;
  const bool all = !bits_less(zero_unless(attached, one), one);
  int whole = all ? static_cast<int>(smallest(now.outer)) : 0;
  if (variant == Variant::averaged) {
    const int whole_before = static_cast<int>(smallest(before.outer));
    whole = whole < whole_before ? whole : whole_before;
  }
  constexpr int kLayers = 8;  // taken along together, for the same reason as contacts
  Vec<V> f[kLayers];
  V squared[kLayers], product[kLayers], inverse[kLayers];
  Vec<V> sum{};
  for (int first = 0; first < end; first += kLayers) {
    const int count = end - first < kLayers ? end - first : kLayers;
    for (int n = 0; n < count; ++n) {
      f[n] = layers.get(first + n);
      product[n] = transport.flatten(f[n], squared[n]);
    }
    for (int n = 0; n < count; ++n) inverse[n] = inverse_root(product[n]);
    for (int n = 0; n < count; ++n) {
      const int j = first + n;
      const V at = splat<V>(j);
      Vec<V> carried = transport.restore(f[n], squared[n], product[n], inverse[n]);
      if (j < whole) {
        carried = carried + half_step;
        sum = variant == Variant::paper && j == 0 ? half * carried : sum + carried;
      } else {
        V w = weight(now, at);
        if (variant == Variant::averaged) {  // the force in a ring that fills stays: Mindlin._diluted
          const V filled = weight(before, at);
          const Mask<V> grows = filled < w;
          carried = select(grows, filled / select(grows, w, one), one) * carried;
        }
        if (variant == Variant::paper && j == 0) w = w - half;
        const Mask<V> inside = attached & (at <= now.outer);
        carried = zero_unless(inside, carried + half_step);
        sum = fma(zero_unless(inside, w), carried, sum);
      }
      layers.set(j, carried);
    }
  }
  const Vec<V> trial = fma(law.spacing, sum, (law.dashpot * c.root_overlap) * c.sliding);
  c.force = trial;
  coulomb(&c, 1, law.mu);
  const Vec<V> correction = fma(one / (law.spacing * total), c.force - trial, half_step);
  int j = 0;
  for (; j < whole; ++j) layers.set(j, layers.stored(j) + correction);
  for (; j < end; ++j) {
    const Mask<V> inside = attached & (splat<V>(j) <= now.outer);
    layers.set(j, zero_unless(inside, layers.stored(j) + correction));
  }
  layers.keep(end);
  c.history[0] = zero_unless(touching, c.overlap);
}

}  // namespace GMEM_ISA
}  // namespace gmem
