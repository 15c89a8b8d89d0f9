// The time step on a GPU: two launches, `touch` and `move`.
//
// In `touch` a thread has one candidate, or one sphere and the walls, of one lane: it finds the forces where they
// touch. In `move` a thread has one grain of one lane: it sums up the forces on the grain, sphere after sphere, ends
// this step and begins the next. Where there are few grains and lanes, kWorkers threads share these sums. Nothing
// races, and a lane's numbers depend neither on other lanes nor on how threads share the work. `enter` and `remember`
// copy from the arrays of the call, `leave` copies to them. V is double, or numbers that carry a derivative; then only
// derivatives are results.

#pragma once

#include "cuda/arguments.h"
#include "numbers/dual.h"
#include "physics/contact.h"
#include "physics/motion.h"

namespace gmem {
namespace GMEM_ISA {

using cuda::Arguments;
using cuda::Four;
using cuda::kChunk;
using cuda::kLoad;
using cuda::kOfLayers;
using cuda::Memories;
using cuda::Table;

// The numbers of one lane in a table.
template <class V>
struct Column {
  double* value;
  double* slope;
  int bytes;  // from one row to the next

  // One instruction of a GPU: 32 bits times 32 bits, added to 64.
  double& at(double* from, int row) const {
    return *reinterpret_cast<double*>(reinterpret_cast<char*>(from) + static_cast<long long>(row) * bytes);
  }

  V operator[](int row) const {
    if constexpr (__is_class(V)) {
      return {at(value, row), at(slope, row)};
    } else {
      return at(value, row);
    }
  }
  void put(int row, V a) const {
    if constexpr (__is_class(V)) {
      at(value, row) = a.value, at(slope, row) = a.slope;
    } else {
      at(value, row) = a;
    }
  }
  Vec<V> vec(int row) const { return {(*this)[row], (*this)[row + 1], (*this)[row + 2]}; }
  void put(int row, Vec<V> a) const { put(row, a.x), put(row + 1, a.y), put(row + 2, a.z); }
};

inline double result(double a) { return a; }
inline double result(Dual<double> a) { return a.slope; }
inline bool is_zero(double a) { return a == 0.0; }
inline bool is_zero(Dual<double> a) { return a.value == 0.0 && a.slope == 0.0; }

// The work of one thread: its item (a candidate, a sphere, a grain) and its lane, one replica.
template <class V>
struct ReplicaView {
  const Arguments& a;
  int item, lane, entry, replica;

  ReplicaView(const Arguments& a, int thread)
      : a(a), item(a.by_lanes.of(thread)), lane(thread - item * a.lanes), entry(a.by_replicas.of(lane)),
        replica(lane - entry * a.replicas) {}

  Column<V> in(const Table& t) const {
    return {t.value.of(entry) + replica, __is_class(V) ? t.slope.of(entry) + replica : nullptr, 8 * t.stride};
  }
  Column<double> out(const Table& t) const { return {t.value.of(entry) + replica, nullptr, 8 * t.stride}; }
  // This lane of an array of doubles, [..., L].
  Column<double> lane_of(double* array) const { return {array + lane, nullptr, 8 * a.lanes}; }
  // Number of this lane in an array [..., L].
  long long of_lane(int row) const { return static_cast<long long>(row) * a.lanes + lane; }

  // Number `row` of the sphere centres of a grain, [K, 3].
  V offset(int row) const {
    const double value = a.offsets.of(entry)[row];
    if constexpr (__is_class(V)) {
      return {value, a.along_offsets.of(entry)[row * a.replicas + replica]};
    } else {
      return value;
    }
  }

  // The periodic box at the end of a step, or, if `step` is negative, before the first step.
  Cell<V> cell(int step) const {
    if (step >= 0) return Cell<V>::of(a.periodic, walls(step));
    const Column<V> edges = in(a.parameters);
    WallState<V> box{};
    box.lower = edges.vec(kCell), box.upper = edges.vec(kCell + 3);
    return Cell<V>::of(a.periodic, box);
  }

  WallState<V> walls(int step) const {
    const Column<V> w = in(a.walls);
    const int row = step * kWalls;
    return {w.vec(row), w.vec(row + 3), w.vec(row + 6), w.vec(row + 9)};
  }
};

// The segments of one contact, in one lane; see physics/segments.h.
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
  void forget() const { *stored = 0; }
  void remember() const {}

  // Makes the segments from the rings up to `outer`; `ring(j)` reads ring j.
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

  // Calls `put(j, f)` for all rings of a contact whose outermost ring is `outer`.
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

// The overlap that a contact had in the last step, for laws that remember it.
template <class V, class Law>
V last_overlap(const ReplicaView<V>& on, const Memories& kept, int row) {
  const Place place = place_of<Law>(row, kLastOverlap);
  return on.in(kept.history[place.leaf])[static_cast<int>(place.row)];
}

// The outermost ring that a contact has reached.
template <class V, class Law>
int outermost(const ReplicaView<V>& on, const Memories& kept, int row, const LawParameters<V>& law) {
  const Reach<V, Law::variant> reach(last_overlap<V, Law>(on, kept, row), law, splat<V>(on.a.points - 2.0));
  return static_cast<int>(largest(reach.outer));
}

template <class V>
Segments<V> segments_of(const ReplicaView<V>& on, const Memories& kept, int row) {
  Column<V> at = on.in(kept.segments);
  const long long before = static_cast<long long>(row) * on.a.points * 3 * kept.segments.stride;
  at.value += before;
  if (__is_class(V)) at.slope += before;
  return {at, kept.stored + on.of_lane(row), on.a.points};
}

// The size of a grain and the radius of a sphere, in a pack whose spheres differ in radius.
template <class V>
double size_of(const ReplicaView<V>& on, int grain) {
  return on.a.sizes.of(on.entry)[grain];
}
template <class V>
double radius_of(const ReplicaView<V>& on, int sphere) {
  const int grain = on.a.by_spheres.of(sphere);
  return size_of(on, grain) * on.a.radii.of(on.entry)[sphere - grain * on.a.spheres];
}

// Begins a step.
template <class V, bool periodic, bool unequal>
GMEM_INLINE void begin(const ReplicaView<V>& on, int step, const GrainParameters<V>& constants, const Grain<V>& from) {
  const Arguments& a = on.a;
  HalfStep<V> m{};
  if constexpr (periodic) {
    m = begin_step(constants, from, on.cell(step - 1), on.cell(step));
  } else {
    m = begin_step(constants, from);
  }
  const Column<V> hot = on.in(a.hot), cold = on.in(a.cold), sphere = on.in(a.sphere);
  const int h = on.item * 9, c = on.item * 4;
  hot.put(h, m.position), hot.put(h + 3, m.velocity), hot.put(h + 6, m.spin);
  cold.put(c, m.orientation.w), cold.put(c + 1, m.orientation.v);
  const Matrix<V> rotation = matrix(m.orientation);
  for (int k = 0; k < a.spheres; ++k) {
    Vec<V> lever = rotation * Vec<V>{on.offset(3 * k), on.offset(3 * k + 1), on.offset(3 * k + 2)};
    if constexpr (unequal) lever = splat<V>(size_of(on, on.item)) * lever;
    sphere.put(3 * (on.item * a.spheres + k), m.position + lever);
  }
}

// Keeps a grain at the beginning of a step, for the way back.
inline void keep(const ReplicaView<double>& on, int step, const Grain<double>& g) {
  const Column<double> state = on.lane_of(on.a.back.state);
  const int at = cuda::kOfGrain * (step * on.a.grains + on.item);
  state.put(at, g.position), state.put(at + 3, g.orientation.w), state.put(at + 4, g.orientation.v);
  state.put(at + 7, g.velocity), state.put(at + 10, g.spin);
  state.put(at + 13, g.acceleration), state.put(at + 16, g.spin_rate);
}

template <class V>
inline void deliver(const ReplicaView<V>& on, const Grain<V>& g) {
  const V number[kFields][4] = {{g.position.x, g.position.y, g.position.z},
                                {g.orientation.w, g.orientation.v.x, g.orientation.v.y, g.orientation.v.z},
                                {g.velocity.x, g.velocity.y, g.velocity.z},
                                {g.spin.x, g.spin.y, g.spin.z},
                                {g.acceleration.x, g.acceleration.y, g.acceleration.z},
                                {g.spin_rate.x, g.spin_rate.y, g.spin_rate.z}};
  for (int f = 0; f < kFields; ++f) {
    const int size = f == 1 ? 4 : 3;
    const Column<double> out = on.out(on.a.grains_out[f]);
    for (int q = 0; q < size; ++q) out.put(on.item * size + q, result(number[f][q]));
  }
}

template <class V>
GrainParameters<V> read_parameters(const ReplicaView<V>& on, V* parameter) {
  for (int row = 0; row < kParameters; ++row) parameter[row] = on.in(on.a.parameters)[row];
  return GrainParameters<V>(parameter);
}

// Copies history `row` of `kept` from the call's arrays, or zeros unless it is `listed`. Returns if it differs from 0.
template <class V, class Law>
bool remember(const ReplicaView<V>& on, const Memories& kept, int row, bool listed) {
  const Arguments& a = on.a;
  bool remembers = false;
  for (int n = 0; n < Law::kGiven; ++n) {
    const Place place = place_of<Law>(row, n);
    const int at = static_cast<int>(place.row);
    const Column<V> from = on.in(kept.history_in[place.leaf]), to = on.in(kept.history[place.leaf]);
    const V number = listed ? from[at] : V{};
    if (from.value != to.value || !listed) to.put(at, number);
    remembers = remembers || !is_zero(number);
  }
  if constexpr (Law::kLayered) {
    V parameter[kParameters];
    read_parameters(on, parameter);
    const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
    const Column<V> rings = on.in(kept.history_in[0]);
    const int first = 2 * row * a.points, outer = listed ? outermost<V, Law>(on, kept, row, law) : -1;
    V layers[kOfLayers];
    store_layers(layers, segments_of(on, kept, row).load(outer, kLacking<Law::variant>, [&](int j) {
      return Flat<V>{rings[first + 2 * j], rings[first + 2 * j + 1]};
    }));
    for (int n = 0; n < kOfLayers; ++n) on.in(kept.layers).put(kOfLayers * row + n, layers[n]);
  }
  return remembers;
}

// One thread for each lane of a candidate, or of a sphere at walls that have friction.
template <class V, class Law, bool rubs>
void remember(const Arguments& a, int thread) {
  const ReplicaView<V> on(a, thread);
  const int row = on.item, sphere = row - a.rows;
  if (row < a.rows) {
    a.touching[on.of_lane(row)] = remember<V, Law>(on, a.contacts, row, a.valid.of(on.entry)[row]);
  } else if (rubs && sphere < a.grains * a.spheres) {
    unsigned planes = 0;
    for (int w = 0; w < kPlanes; ++w) planes |= remember<V, Law>(on, a.at_walls, kPlanes * sphere + w, true) << w;
    a.touching[on.of_lane(row)] = static_cast<unsigned char>(planes);
  }
}

// Copies grains from the arrays of the call and begins the first step. One thread for each lane of a grain.
template <class V, bool periodic, bool unequal, bool keeps = false>
void enter(const Arguments& a, int thread) {
  const ReplicaView<V> on(a, thread);
  const int grain = on.item;
  if (grain >= a.grains) return;
  V parameter[kParameters];
  const GrainParameters<V> constants = read_parameters(on, parameter);
  const auto field = [&](int f) { return on.in(a.grains_in[f]).vec(grain * 3); };
  const Column<V> q = on.in(a.grains_in[1]);
  const Grain<V> from{field(0), {q[grain * 4], q.vec(grain * 4 + 1)}, field(2), field(3), field(4), field(5)};
  for (int k = 0; k < a.spheres; ++k) {
    on.in(a.wall).put(a.of_wall * (grain * a.spheres + k) + 3, Vec<V>{});
    a.touching[on.of_lane(a.rows + grain * a.spheres + k)] = 0;
  }
  if constexpr (keeps) {
    if (a.steps == 0) return;
    keep(on, 0, from);
  } else {
    if (a.steps == 0) return deliver(on, from);
  }
  begin<V, periodic, unequal>(on, 0, constants, from);
}

// The history of a contact while the contact is computed.
template <class V, class Law>
struct Memory {
  const ReplicaView<V>& on;
  const Memories& kept;
  int row;
  V number[Law::kHistory + 1];

  template <class Each>
  void each(const Each& each) {
    for (int n = 0; n < Law::kGiven; ++n) {
      const Place place = place_of<Law>(row, n);
      each(on.in(kept.history[place.leaf]), static_cast<int>(place.row), number[n]);
    }
    for (int n = Law::kGiven; n < Law::kHistory; ++n)
      each(on.in(kept.layers), kOfLayers * row + n - Law::kGiven, number[n]);
  }
  void read() {
    each([](const Column<V>& from, int at, V& number) { number = from[at]; });
  }
  void write() {
    each([](const Column<V>& to, int at, V& number) { to.put(at, number); });
  }
  // Spheres that are apart have nothing to remember.
  void forget() {
    each([](const Column<V>& to, int at, V&) { to.put(at, V{}); });
    if constexpr (Law::kLayered) segments_of(on, kept, row).forget();
  }
};

// Friction of the walls on a sphere; returns bits of the planes it touches. `known` are those where it has a history.
template <class V, class Law>
unsigned rub_planes(const ReplicaView<V>& on, const GrainParameters<V>& constants, const V* parameter, int number,
                    Vec<V> centre, Vec<V> lever, Vec<V> velocity, Vec<V> spin, const WallState<V>& box, V radius,
                    unsigned known) {
  const Arguments& a = on.a;
  const int first = kPlanes * number, at = a.of_wall * number;
  V history[kPlanes * Law::kHistory + 1];
  for (int w = 0; w < kPlanes; ++w) {
    Memory<V, Law> memory{on, a.at_walls, first + w, {}};
    if (known >> w & 1) memory.read();
    for (int n = 0; n < Law::kHistory; ++n) history[w * Law::kHistory + n] = memory.number[n];
  }
  const WallLaw<V> walls(parameter, on.in(a.parameters)[kWallMu]);
  WallFriction<V> found{};
  const unsigned now = rub_walls<Law>(
      constants, walls, centre, lever, velocity, spin, box, radius, history, known,
      [&](int w) { return segments_of(on, a.at_walls, first + w); }, found);
  for (int w = 0; w < kPlanes; ++w) {
    if (!((known | now) >> w & 1)) continue;
    Memory<V, Law> memory{on, a.at_walls, first + w, {}};
    for (int n = 0; n < Law::kHistory; ++n) memory.number[n] = history[w * Law::kHistory + n];
    memory.write();
  }
  const Column<V> wall = on.in(a.wall);
  wall.put(at, wall.vec(at) + found.force);
  wall.put(at + 6, found.torque - cross(lever, found.force)), wall.put(at + 9, found.force);
  return now;
}

// The forces of the walls on a sphere.
template <class V, class Law, bool periodic, bool unequal, bool rubs>
void touch_walls(const ReplicaView<V>& on, int step, int number) {
  const Arguments& a = on.a;
  if (number >= a.grains * a.spheres) return;
  const WallState<V> edges = on.walls(step), box = periodic ? without(a.periodic, edges) : edges;
  const Vec<V> centre = on.in(a.sphere).vec(3 * number);
  unsigned char& touching = a.touching[on.of_lane(a.rows + number)];
  V radius = splat<V>(1.0);
  if constexpr (unequal) radius = splat<V>(radius_of(on, number));
  const bool touches = bits_less(V{}, deepest(radius, centre, box));
  if (!rubs && touches != static_cast<bool>(touching)) touching = touches;
  if (!touches && !(rubs && touching)) return;
  V parameter[kParameters];
  GrainParameters<V> constants = read_parameters(on, parameter);
  if constexpr (unequal) constants.wall_stiffness = root(radius) * constants.wall_stiffness;
  const Column<V> hot = on.in(a.hot), wall = on.in(a.wall);
  const int h = 9 * a.by_spheres.of(number), at = a.of_wall * number;
  const Vec<V> lever = centre - hot.vec(h), spin = hot.vec(h + 6), velocity = add_cross(hot.vec(h + 3), spin, lever);
  WallForces<V> found{};
  touch_walls(constants, centre, lever, velocity, box, found, radius);
  wall.put(at, found.force);
  wall.put(at + 3, wall.vec(at + 3) + pressure(edges, found.lower + found.upper));
  if constexpr (rubs)
    touching = static_cast<unsigned char>(
        rub_planes<V, Law>(on, constants, parameter, number, centre, lever, velocity, spin, box, radius, touching));
}

// The input of a contact at `point`; the numbers of its grains begin in rows i and j of `hot`.
template <class V>
GMEM_INLINE ContactInput<V> meeting(const Column<V>& hot, int i, int j, Vec<V> gap, Vec<V> point) {
  return {gap, point - hot.vec(i), point - hot.vec(j), hot.vec(j + 3) - hot.vec(i + 3), hot.vec(i + 6), hot.vec(j + 6)};
}

// The forces between the spheres of a candidate, or of the walls on a sphere. One thread for each lane of a candidate
// or sphere.
template <class V, class Law, bool periodic, bool unequal, bool rubs, bool keeps = false>
void touch(const Arguments& a, int step, int thread) {
  const ReplicaView<V> on(a, thread);
  const int row = on.item;
  if (row >= a.rows) return touch_walls<V, Law, periodic, unequal, rubs>(on, step, row - a.rows);
  if (!a.valid.of(on.entry)[row]) return;
  const int one = a.first.of(on.entry)[row], other = a.second.of(on.entry)[row];
  const unsigned all = static_cast<unsigned>(a.grains * a.spheres);
  if (static_cast<unsigned>(one) >= all || static_cast<unsigned>(other) >= all) return;
  unsigned char& touching = a.touching[on.of_lane(row)];
  const bool touched = touching;
  const Column<V> sphere = on.in(a.sphere);
  Cell<V> cell{};
  Vec<V> shift{};
  if constexpr (periodic) {
    const signed char* image = a.image.of(on.entry) + 3ll * row;
    cell = on.cell(step), shift = cell.shift(image[0], image[1], image[2]);
  }
  const Vec<V> here = sphere.vec(3 * one), listed = sphere.vec(3 * other);
  const Vec<V> there = periodic ? listed + shift : listed, gap = there - here;
  const V square = dot(gap, gap);
  Memory<V, Law> memory{on, a.contacts, row, {}};
  Unequal<V> differing{};
  double reach = 2.0;
  if constexpr (unequal) {
    const double radius = radius_of(on, one), of_other = radius_of(on, other);
    reach = radius + of_other;
    differing = {splat<V>(reach), splat<V>(0.5 * (radius - of_other)), splat<V>(root(2.0 * radius * of_other / reach))};
  }
  if (!bits_less(square, splat<V>(reach * reach))) {
    if (touched) memory.forget(), touching = 0;
    return;
  }
  V parameter[kParameters];
  read_parameters(on, parameter);
  const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
  const Column<V> hot = on.in(a.hot), load = on.in(a.load);
  const int i = 9 * a.by_spheres.of(one), j = 9 * a.by_spheres.of(other);
  Vec<V> point = splat<V>(0.5) * (here + there);
  ContactInput<V> input = meeting(hot, i, j, gap, point);
  if constexpr (periodic) to_image(input, shift, cell);
  memory.read();
  if constexpr (keeps) {
    const int first = Law::kHistory * (step * a.rows + row);
    for (int n = 0; n < Law::kHistory; ++n) on.lane_of(a.back.history).put(first + n, memory.number[n]);
  }
  Contact<V> contact;
  relative_motion(input, square, contact);
  contact.history = memory.number;
  if constexpr (unequal)
    close<true>(&contact, 1, parameter, &differing, [&](int) { return input.spin_other - input.spin_one; });
  else close(&contact, 1, parameter);
  rub<Law>(&contact, 1, law, unequal ? &differing : nullptr, [&](int) { return segments_of(on, a.contacts, row); });
  if constexpr (unequal) point = point + differing.lean * contact.normal;
  memory.write();
  load.put(kLoad * row, fnma(contact.normal_force, contact.normal, contact.force));
  load.put(kLoad * row + 3, point);
  if (!touched) touching = 1;
}

// Force and torque on a grain.
template <class V>
struct Load {
  Vec<V> force, torque;
  Vec<V> through;  // force through the faces of a periodic box, of contacts in which the grain is the first
  Vec<V> rubbed;   // the part of the force that is friction of the walls
};

template <class V>
inline Load<V> operator+(const Load<V>& one, const Load<V>& other) {
  return {one.force + other.force, one.torque + other.torque, one.through + other.through, one.rubbed + other.rubbed};
}

// A force that acts `lever` away from the grain's centre.
template <class V>
inline Load<V> at_lever(Vec<V> force, Vec<V> lever) {
  return {force, cross(lever, force), {}, {}};
}

// Calls `each(row, is_second)` for the candidates of a sphere that touch, in the order of the list.
template <class V, class Each>
GMEM_INLINE void for_touching(const ReplicaView<V>& on, int number, const Each& each) {
  const Arguments& a = on.a;
  const int fours = a.columns / 4, rows = a.rows;
  const Four* listed = a.incidence.of(on.entry) + static_cast<long long>(number) * fours;
  Four next = listed[0];
  for (int n = 1; n <= fours; ++n) {
    const Four now = next;
    if (n < fours) next = listed[n];
    int row[4];
    bool second[4], touching[4];
    for (int q = 0; q < 4; ++q) {
      second[q] = now.of[q] >= rows;
      row[q] = second[q] ? now.of[q] - rows : now.of[q];
      touching[q] = static_cast<unsigned>(row[q]) < static_cast<unsigned>(rows) && a.touching[on.of_lane(row[q])];
    }
    for (int q = 0; q < 4; ++q)
      if (touching[q]) each(row[q], second[q]);
    if (static_cast<unsigned>(now.of[3]) >= 2u * rows) break;  // the columns that follow are blank, too
  }
}

// The sum over the contacts of a sphere of a grain, walls included.
template <class V, bool periodic, bool rubs>
GMEM_INLINE Load<V> loads_of(const ReplicaView<V>& on, int step, int sphere) {
  const Arguments& a = on.a;
  Load<V> sum{};
  if (on.item >= a.grains || sphere >= a.spheres) return sum;
  const int number = on.item * a.spheres + sphere;
  const Column<V> load = on.in(a.load);
  const Vec<V> position = on.in(a.hot).vec(9 * on.item);
  if (a.touching[on.of_lane(a.rows + number)]) {
    const Column<V> wall = on.in(a.wall);
    const int at = a.of_wall * number;
    sum = at_lever(wall.vec(at), on.in(a.sphere).vec(3 * number) - position);
    if constexpr (rubs) sum.torque = sum.torque + wall.vec(at + 6);
    if constexpr (rubs && periodic) sum.rubbed = wall.vec(at + 9);
  }
  for_touching(on, number, [&](int row, bool second) {
    const int at = kLoad * row;
    const Vec<V> force = load.vec(at);
    Vec<V> lever = load.vec(at + 3) - position;
    if constexpr (periodic) {
      const signed char* image = a.image.of(on.entry) + 3ll * row;
      const Vec<V> moved{splat<V>(image[0]), splat<V>(image[1]), splat<V>(image[2])};
      if (second) lever = lever - on.cell(step).shift(image[0], image[1], image[2]);
      else sum.through = sum.through + through_faces(moved, force);
    }
    sum = sum + at_lever(second ? -force : force, lever);
  });
  return sum;
}

// The end of a step, and the beginning of the next, of a grain in a lane.
template <class V, bool periodic, bool unequal, bool keeps = false>
GMEM_INLINE void move(const ReplicaView<V>& on, int step, const Load<V>& load) {
  const Arguments& a = on.a;
  if (on.item >= a.grains) return;
  const Column<V> hot = on.in(a.hot), cold = on.in(a.cold);
  const int h = on.item * 9, c = on.item * 4;
  const HalfStep<V> half{hot.vec(h), {cold[c], cold.vec(c + 1)}, hot.vec(h + 3), hot.vec(h + 6)};
  V parameter[kParameters];
  const GrainParameters<V> constants = read_parameters(on, parameter);
  Vec<V> force = load.force, torque = load.torque;
  V mass = parameter[kMass];
  if constexpr (unequal) {
    const double size = size_of(on, on.item), cube = size * size * size;
    force = splat<V>(1.0 / cube) * force, torque = splat<V>(1.0 / (cube * size * size)) * torque,
    mass = splat<V>(cube) * mass;
  }
  Grain<V> after{};
  if constexpr (periodic) {
    const WallState<V> box = on.walls(step);
    const Cell<V> cell = Cell<V>::of(a.periodic, box);
    const Vec<V> own_part = section(cell, mass, half, load.force - load.rubbed);
    const Column<V> wall = on.in(a.wall);
    const int at = a.of_wall * on.item * a.spheres + 3;
    wall.put(at, wall.vec(at) + section_pressure(a.periodic, box, cell, own_part, load.through));
    after = end_step(constants, a.isotropic, half, force, torque, cell);
  } else {
    after = end_step(constants, a.isotropic, half, force, torque);
  }
  if constexpr (keeps) {
    const Column<double> total = on.lane_of(a.back.total);
    const int at = 6 * (step * a.grains + on.item);
    total.put(at, force), total.put(at + 3, torque);
    if (step + 1 == a.steps) return;
    keep(on, step + 1, after);
  } else {
    if (step + 1 == a.steps) return deliver(on, after);
  }
  begin<V, periodic, unequal>(on, step + 1, constants, after);
}

// One thread for all spheres of a grain.
template <class V, bool periodic, bool unequal, bool rubs, bool keeps = false>
void move_alone(const Arguments& a, int step, int thread) {
  const ReplicaView<V> on(a, thread);
  Load<V> sum{};
  for (int k = 0; k < a.spheres; ++k) sum = sum + loads_of<V, periodic, rubs>(on, step, k);
  move<V, periodic, unequal, keeps>(on, step, sum);
}

// Sums of pressures over a chunk of spheres that are `stride` apart, written in the place of its first sphere. One
// thread for each lane of a chunk and axis.
template <class V>
void collect(const Arguments& a, int stride, int thread) {
  const ReplicaView<V> on(a, thread);
  const int axis = on.item % 3, first = on.item / 3 * kChunk * stride;
  if (first >= a.grains * a.spheres) return;
  const Column<V> wall = on.in(a.wall);
  const int all = a.grains * a.spheres, end = first + kChunk * stride < all ? first + kChunk * stride : all;
  V total{};
  for (int sphere = first; sphere < end; sphere += stride) total = total + wall[a.of_wall * sphere + 3 + axis];
  wall.put(a.of_wall * first + 3 + axis, total);
}

// Copies the part of history `row` of `kept` that is not yet in the arrays of the call.
template <class V, class Law>
void leave(const ReplicaView<V>& on, const Memories& kept, int row) {
  const Arguments& a = on.a;
  for (int n = 0; a.tangent && n < Law::kGiven; ++n) {
    const Place place = place_of<Law>(row, n);
    const int at = static_cast<int>(place.row);
    on.out(kept.history_out[place.leaf]).put(at, result(on.in(kept.history[place.leaf])[at]));
  }
  if constexpr (Law::kLayered) {
    const Column<double> out = on.out(kept.history_out[0]);
    V parameter[kParameters], layers[kOfLayers];
    read_parameters(on, parameter);
    const LawParameters<V> law(parameter + kLaw, parameter[kDt]);
    for (int n = 0; n < kOfLayers; ++n) layers[n] = on.in(kept.layers)[kOfLayers * row + n];
    const int first = 2 * row * a.points, outer = outermost<V, Law>(on, kept, row, law);
    segments_of(on, kept, row).unload(load_layers(layers), outer, [&](int j, Flat<V> f) {
      out.put(first + 2 * j, result(f.along)), out.put(first + 2 * j + 1, result(f.across));
    });
  }
}

// Copies pressures and histories to the arrays of the call. One thread for each lane of an axis, of a candidate, or of
// a sphere at walls that have friction.
template <class V, class Law, bool rubs>
void leave(const Arguments& a, int thread) {
  const ReplicaView<V> on(a, thread);
  const int row = on.item, sphere = row - a.rows;
  if (row < 3) on.out(a.pressure_out).put(row, result(on.in(a.wall)[3 + row]));
  if (row < a.rows) return leave<V, Law>(on, a.contacts, row);
  if (!rubs || sphere >= a.grains * a.spheres) return;
  for (int w = 0; w < kPlanes; ++w) leave<V, Law>(on, a.at_walls, kPlanes * sphere + w);
}

}  // namespace GMEM_ISA
}  // namespace gmem
