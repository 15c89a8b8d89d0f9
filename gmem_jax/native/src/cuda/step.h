// The time step on a GPU: a thread is one grain of one lane.
//
// `advance` is one step and one launch: the contacts of the grain, the end of this step, the beginning of the next.
// Both grains of a contact compute it, each with its own copy of the history and in the listed order, so that they get
// the same bits, nothing races, and forces are summed in an order of their own. `enter` and `leave` copy from and to
// the arrays of the call. For V = double, or numbers that carry a derivative, whose results are the derivatives alone.

#pragma once

#include "cuda/arguments.h"
#include "numbers/dual.h"
#include "physics/contact.h"
#include "physics/motion.h"

namespace gmem {
namespace GMEM_ISA {

using cuda::Arguments;
using cuda::kChunk;
using cuda::Side;
using cuda::Table;

// The numbers of one lane in a table.
template <class V>
struct Column {
  double* value;
  double* slope;
  long long stride;

  V operator[](long long row) const {
    if constexpr (__is_class(V)) {
      return {value[row * stride], slope[row * stride]};
    } else {
      return value[row * stride];
    }
  }
  void put(long long row, V a) const {
    if constexpr (__is_class(V)) {
      value[row * stride] = a.value, slope[row * stride] = a.slope;
    } else {
      value[row * stride] = a;
    }
  }
  Vec<V> vec(long long row) const { return {(*this)[row], (*this)[row + 1], (*this)[row + 2]}; }
  void put(long long row, Vec<V> a) const { put(row, a.x), put(row + 1, a.y), put(row + 2, a.z); }
};

inline double result(double a) { return a; }
inline double result(Dual<double> a) { return a.slope; }
inline bool is_zero(double a) { return a == 0.0; }
inline bool is_zero(Dual<double> a) { return a.value == 0.0 && a.slope == 0.0; }

// One replica - a lane of the kernels - as its threads see it.
template <class V>
struct ReplicaView {
  const Arguments& a;
  int lane, entry, replica;

  ReplicaView(const Arguments& a, int lane) : a(a), lane(lane), entry(lane / a.replicas), replica(lane % a.replicas) {}

  Column<V> in(const Table& t) const {
    return {t.value.of(entry) + replica, __is_class(V) ? t.slope.of(entry) + replica : nullptr, t.stride};
  }
  Column<double> out(const Table& t) const { return {t.value.of(entry) + replica, nullptr, t.stride}; }

  WallState<V> walls(int step) const {
    const Column<V> w = in(a.walls);
    const long long row = static_cast<long long>(step) * kWalls;
    return {w.vec(row), w.vec(row + 3), w.vec(row + 6), w.vec(row + 9)};
  }
};

// The segments of one side, in one lane; see physics/segments.h.
template <class V>
struct Segments {
  Column<V> at;
  int* stored;
  int rings;

  V last() const { return splat<V>(rings - 2.0); }
  int count() const { return *stored; }
  Segment<V> get(int k) const { return {{at[3 * k], at[3 * k + 1]}, at[3 * k + 2]}; }
  void set(int k, const Segment<V>& segment) const {
    at.put(3 * k, segment.force.along), at.put(3 * k + 1, segment.force.across), at.put(3 * k + 2, segment.start);
  }
  void keep(V counts) const { *stored = static_cast<int>(largest(counts)); }
  void remember() const {}

  // From rings up to `outer`, of which `ring(j)` reads one.
  template <class Ring>
  Layers<V> load(int outer, double lacking, const Ring& ring) const {
    Flat<V> previous{};
    Layers<V> layers{};
    int found = 0;
    for (int j = 0; j < outer; ++j) {
      const Flat<V> force = ring(j);
      layers.inside = fma(splat<V>(j == 0 ? 1.0 - lacking : 1.0), force, layers.inside);
      if (j == 0 || differ(force, previous)) set(found++, {force, splat<V>(j)});
      previous = force;
    }
    if (outer >= 0) layers.rim = ring(outer);
    *stored = found;
    return layers;
  }

  // All rings of a contact that reaches to `outer`, to `put(j, f)`.
  template <class Put>
  void unload(const Layers<V>& layers, int outer, const Put& put) const {
    int next = 0;
    Flat<V> force{};
    for (int j = 0; j < rings; ++j) {
      if (next < *stored && !bits_less(splat<V>(j), get(next).start)) force = get(next++).force + layers.common;
      put(j, j < outer ? force : j == outer ? layers.rim : Flat<V>{});
    }
  }
};

// The outermost ring that a side has reached.
template <class V, class Law>
int outermost(const ReplicaView<V>& on, long long side, const LawParameters<V>& law) {
  const V overlap = on.in(on.a.history)[side * Law::kHistory + kLastOverlap];
  return static_cast<int>(largest(Reach<V, Law::variant>(overlap, law, splat<V>(on.a.points - 2.0)).outer));
}

template <class V>
Segments<V> segments_of(const ReplicaView<V>& on, long long side) {
  const Arguments& a = on.a;
  Column<V> at = on.in(a.segments);
  at.value += side * a.points * 3 * at.stride;
  if (__is_class(V)) at.slope += side * a.points * 3 * at.stride;
  return {at, a.stored + side * a.lanes + on.lane, a.points};
}

// Begins a step whose numbers go to side `next` of the double tables.
template <class V>
GMEM_INLINE void begin(const ReplicaView<V>& on, int grain, const GrainParameters<V>& constants, const Grain<V>& from,
                       int next) {
  const Arguments& a = on.a;
  const HalfStep<V> m = begin_step(constants, from);
  const Column<V> hot = on.in(a.hot[next]), cold = on.in(a.cold), sphere = on.in(a.sphere[next]);
  const long long h = grain * 9ll, c = grain * 4ll;
  hot.put(h, m.position), hot.put(h + 3, m.velocity), hot.put(h + 6, m.spin);
  cold.put(c, m.orientation.w), cold.put(c + 1, m.orientation.v);
  const Matrix<V> rotation = matrix(m.orientation);
  for (int k = 0; k < a.spheres; ++k) {
    const double* body = a.offsets.of(on.entry) + 3 * k;
    const Vec<V> lever = rotation * Vec<V>{splat<V>(body[0]), splat<V>(body[1]), splat<V>(body[2])};
    sphere.put(3 * (static_cast<long long>(grain) * a.spheres + k), m.position + lever);
  }
}

template <class V>
inline void deliver(const ReplicaView<V>& on, int grain, const Grain<V>& g) {
  const V number[kFields][4] = {{g.position.x, g.position.y, g.position.z},
                                {g.orientation.w, g.orientation.v.x, g.orientation.v.y, g.orientation.v.z},
                                {g.velocity.x, g.velocity.y, g.velocity.z},
                                {g.spin.x, g.spin.y, g.spin.z},
                                {g.acceleration.x, g.acceleration.y, g.acceleration.z},
                                {g.spin_rate.x, g.spin_rate.y, g.spin_rate.z}};
  for (int f = 0; f < kFields; ++f) {
    const int size = f == 1 ? 4 : 3;
    const Column<double> out = on.out(on.a.grains_out[f]);
    for (int q = 0; q < size; ++q) out.put(static_cast<long long>(grain) * size + q, result(number[f][q]));
  }
}

template <class V>
GrainParameters<V> read_parameters(const ReplicaView<V>& on, V* parameter) {
  for (int row = 0; row < kParameters; ++row) parameter[row] = on.in(on.a.parameters)[row];
  return GrainParameters<V>(parameter);
}

// From the arrays of the call. Thread of grain and lane.
template <class V, class Law>
void enter(const Arguments& a, int thread) {
  if (thread >= a.grains * a.lanes) return;
  const ReplicaView<V> on(a, thread % a.lanes);
  const int grain = thread / a.lanes;
  V parameter[kParameters];
  const GrainParameters<V> constants = read_parameters(on, parameter);
  const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
  const auto field = [&](int f) { return on.in(a.grains_in[f]).vec(grain * 3ll); };
  const Column<V> q = on.in(a.grains_in[1]);
  const Grain<V> from{field(0), {q[grain * 4ll], q.vec(grain * 4ll + 1)}, field(2), field(3), field(4), field(5)};
  for (int side = a.start.of(on.entry)[grain]; side < a.start.of(on.entry)[grain + 1]; ++side) {
    const int row = a.side.of(on.entry)[side].row;
    const Column<V> history = on.in(a.history);
    for (int n = 0; n < Law::kGiven; ++n) {
      const Place place = place_of<Law>(row, n);
      history.put(side * static_cast<long long>(Law::kHistory) + n, on.in(a.history_in[place.leaf])[place.row]);
    }
    if constexpr (Law::kLayered) {
      const Column<V> rings = on.in(a.history_in[0]);
      const long long first = 2ll * row * a.points;
      V layers[Law::kHistory - kLayers];
      store_layers(layers, segments_of(on, side).load(outermost<V, Law>(on, side, law), kLacking<Law::variant>, [&](int j) {
        return Flat<V>{rings[first + 2 * j], rings[first + 2 * j + 1]};
      }));
      for (int n = kLayers; n < Law::kHistory; ++n)
        history.put(side * static_cast<long long>(Law::kHistory) + n, layers[n - kLayers]);
    }
  }
  on.in(a.pressure).put(grain * 3ll, Vec<V>{});
  if (a.steps == 0) return deliver(on, grain, from);
  begin(on, grain, constants, from, 0);
}

// What a side does to its grain.
template <class V>
struct Load {
  Vec<V> force, torque;
};

// The contact of one side, which touches.
template <class V, class Law>
GMEM_INLINE void touch(const ReplicaView<V>& on, int now, long long number, const Side& side, const HalfStep<V>& own,
                       Vec<V> here, Vec<V> there, const V* parameter, const LawParameters<V>& law, Load<V>& load) {
  const Arguments& a = on.a;
  const bool first = side.other >= 0;
  const int other = (first ? side.other : ~side.other) / a.spheres;
  const Column<V> theirs = on.in(a.hot[now]), stored = on.in(a.history);
  const long long h = other * 9ll;
  const Vec<V> position = theirs.vec(h), velocity = theirs.vec(h + 3), spin = theirs.vec(h + 6);
  const Vec<V> gap = there - here, point = splat<V>(0.5) * (here + there);
  // As listed: from the first sphere to the second.
  const auto pick = [first](Vec<V> one, Vec<V> two) {
    return Vec<V>{select(first, one.x, two.x), select(first, one.y, two.y), select(first, one.z, two.z)};
  };
  const ContactInput<V> input{pick(gap, -gap),
                              pick(point - own.position, point - position),
                              pick(point - position, point - own.position),
                              pick(velocity - own.velocity, own.velocity - velocity),
                              pick(own.spin, spin),
                              pick(spin, own.spin)};
  V history[Law::kHistory + 1];
  for (int n = 0; n < Law::kHistory; ++n) history[n] = stored[number * Law::kHistory + n];
  Contact<V> contact;
  relative_motion(input, dot(gap, gap), contact);
  contact.history = history;
  close(&contact, 1, parameter);
  if constexpr (Law::kLayered) {
    friction(Law{}, &contact, 1, law, [&](int) { return segments_of(on, number); });
  } else {
    friction(Law{}, &contact, 1, law);
  }
  for (int n = 0; n < Law::kHistory; ++n) stored.put(number * Law::kHistory + n, history[n]);
  const ContactLoads<V> p = push(contact);
  load.force = load.force + pick(p.force, -p.force);
  load.torque = load.torque + pick(p.torque_one, p.torque_other);
}

// A side whose spheres are apart has nothing to remember.
template <class V, class Law>
inline void forget(const ReplicaView<V>& on, long long number) {
  const Column<V> stored = on.in(on.a.history);
  if (Law::kHistory > kLastOverlap && is_zero(stored[number * Law::kHistory + kLastOverlap])) return;
  for (int n = 0; n < Law::kHistory; ++n)
    if (!is_zero(stored[number * Law::kHistory + n])) stored.put(number * Law::kHistory + n, V{});
  if constexpr (Law::kLayered) segments_of(on, number).keep(V{});
}

// One step. Thread of grain and lane.
template <class V, class Law>
void advance(const Arguments& a, int step, int thread) {
  if (thread >= a.grains * a.lanes) return;
  const ReplicaView<V> on(a, thread % a.lanes);
  const int grain = thread / a.lanes, now = step & 1;
  V parameter[kParameters];
  const GrainParameters<V> constants = read_parameters(on, parameter);
  const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
  const Column<V> hot = on.in(a.hot[now]), cold = on.in(a.cold), sphere = on.in(a.sphere[now]);
  const long long h = grain * 9ll, c = grain * 4ll;
  HalfStep<V> own{hot.vec(h), {}, hot.vec(h + 3), hot.vec(h + 6)};
  Load<V> load{};
  const int end = a.start.of(on.entry)[grain + 1];
  for (int number = a.start.of(on.entry)[grain]; number < end; ++number) {
    const Side side = a.side.of(on.entry)[number];
    const Vec<V> here = sphere.vec(side.mine * 3ll);
    const Vec<V> there = sphere.vec((side.other >= 0 ? side.other : ~side.other) * 3ll);
    const Vec<V> gap = there - here;
    if (bits_less(dot(gap, gap), splat<V>(4.0))) {
      touch<V, Law>(on, now, number, side, own, here, there, parameter, law, load);
    } else {
      forget<V, Law>(on, number);
    }
  }
  own.orientation = {cold[c], cold.vec(c + 1)};
  const WallState<V> box = on.walls(step);
  WallForces<V> walls{};
  const double arm = *a.arm.of(on.entry);
  if (spheres_of(constants, own, a.offsets.of(on.entry), a.spheres, arm, box, walls, [](int, Vec<V>) {})) {
    const Column<V> sum = on.in(a.pressure);
    sum.put(grain * 3ll, sum.vec(grain * 3ll) + pressure(box, walls.lower + walls.upper));
  }
  const Grain<V> after = end_step(constants, a.isotropic, own, load.force + walls.force, load.torque + walls.torque);
  if (step + 1 == a.steps) return deliver(on, grain, after);
  begin(on, grain, constants, after, 1 - now);
}

// Sums of pressures over a chunk of grains, in the place of its first. Thread of chunk, axis and lane.
template <class V>
void collect(const Arguments& a, int thread) {
  const int axis = thread / a.lanes % 3, first = thread / (3 * a.lanes) * kChunk;
  if (first >= a.grains) return;
  const Column<V> sum = ReplicaView<V>(a, thread % a.lanes).in(a.pressure);
  const int end = first + kChunk < a.grains ? first + kChunk : a.grains;
  V total{};
  for (int grain = first; grain < end; ++grain) total = total + sum[grain * 3ll + axis];
  sum.put(first * 3ll + axis, total);
}

// Histories and pressures to the arrays of the call. Thread of row and lane; the first also of axis and lane.
template <class V, class Law>
void leave(const Arguments& a, int thread) {
  const ReplicaView<V> on(a, thread % a.lanes);
  const int row = thread / a.lanes;
  if (row < 3) {
    V total{};
    for (int grain = 0; grain < a.grains; grain += kChunk) total = total + on.in(a.pressure)[grain * 3ll + row];
    on.out(a.pressure_out).put(row, result(total));
  }
  if (row >= a.rows) return;
  const long long side = a.place.of(on.entry)[row];
  for (int n = 0; n < Law::kGiven; ++n) {
    const Place place = place_of<Law>(row, n);
    const V number = side < 0 ? V{} : on.in(a.history)[side * Law::kHistory + n];
    on.out(a.history_out[place.leaf]).put(place.row, result(number));
  }
  if constexpr (Law::kLayered) {
    const Column<double> out = on.out(a.history_out[0]);
    const auto put = [&](int j, Flat<V> f) {
      const long long to = 2 * (static_cast<long long>(row) * a.points + j);
      out.put(to, result(f.along)), out.put(to + 1, result(f.across));
    };
    if (side < 0) {
      for (int j = 0; j < a.points; ++j) put(j, Flat<V>{});
    } else {
      V parameter[kParameters];
      read_parameters(on, parameter);
      const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
      const Column<V> history = on.in(a.history);
      V layers[Law::kHistory - kLayers];
      for (int n = kLayers; n < Law::kHistory; ++n) layers[n - kLayers] = history[side * Law::kHistory + n];
      segments_of(on, side).unload(load_layers(layers), outermost<V, Law>(on, side, law), put);
    }
  }
}

}  // namespace GMEM_ISA
}  // namespace gmem
