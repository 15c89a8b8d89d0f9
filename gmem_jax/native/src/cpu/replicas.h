// The mode for W replicas of a pack side by side: each vector is one number of one grain or contact, in all of them.
// See `Engine` in block.h for how it is used.

#pragma once

#include <algorithm>
#include <cstddef>
#include <type_traits>

#include "cpu/block.h"
#include "cpu/histories.h"
#include "numbers/dual.h"
#include "numbers/single.h"

namespace gmem {
namespace GMEM_ISA {

template <class V>
constexpr int kReplicas = std::is_same<V, Pair>::value ? 2 * W : W;

// How numbers are put together from the arrays of a block, and which part of them is a result. `gather(lanes, first)`
// returns a vector of lanes, from lane `first` on.
template <class V, class Gather>
inline V of_lanes(const Block& block, const Gather& gather) {
  if constexpr (std::is_same<V, Real>::value) {
    return gather(block.lanes, 0);
  } else if constexpr (std::is_same<V, Pair>::value) {
    return {gather(block.lanes, 0), gather(block.lanes, W)};
  } else {
    return {gather(block.lanes, 0), gather(block.slopes, 0)};
  }
}
inline Real result(Real a) { return a; }
inline Pair result(Pair a) { return a; }
inline Real result(Dual<Real> a) { return a.slope; }

// An overlap is a small difference of distances. In mixed precision `before` is first the difference of their squares,
// taken in double precision.
template <int N>
GMEM_INLINE Single<N> overlap_of(const Contact<Single<N>>& c) {
  return c.before / fma(c.square, c.inverse, Single<N>::of(2.0));
}

// What contacts look up of a grain, in their precision.
template <class C>
struct GrainMotion {
  C velocity[3], spin[3];
};

// The memory of a `Replicas`.
template <class Law, class V, class C>
struct ReplicasLayout {
  V* sphere;               // [S, 3]: centres
  GrainMotion<C>* motion;  // [N], in mixed precision; otherwise `hot` has these numbers
  C* remote;               // [remotes, 6]: sums of forces and torques
  C* history;              // [candidates, Law::kHistory]
  Segment<C>* segment;     // [Q, candidates] of the Mindlin law: segment k of all contacts lies together
  Marks<Law> marks;

  void place(const Problem& p, const Plan& plan, Arena& arena) {
    const std::size_t candidates = plan.candidates;
    sphere = arena.take<V>(static_cast<std::size_t>(p.spheres()) * 3);
    motion = arena.take<GrainMotion<C>>(std::is_same<V, C>::value ? 0 : p.grains);
    remote = arena.take<C>(static_cast<std::size_t>(plan.remotes) * 6);
    history = arena.take<C>(candidates * Law::kHistory);
    marks.place(plan, arena);
    segment = arena.take<Segment<C>>(Law::kLayered ? candidates * p.points : 0);
  }
};

// V is the type of a grain's numbers, C that of contacts and their histories: the same, or in single precision.
template <class Law, class V, class C = V>
struct Replicas : ReplicasLayout<Law, V, C> {
  using Layout = ReplicasLayout<Law, V, C>;
  using Layout::sphere, Layout::motion, Layout::remote, Layout::history, Layout::segment, Layout::marks;
  using Number = V;
  using OfContacts = C;
  using OfLaw = Law;
  static constexpr bool kMixed = !std::is_same<V, C>::value, kDual = std::is_same<V, Dual<Real>>::value;

  const Problem& problem;
  const Block& block;
  const Plan& plan;
  bool adjacent;  // the lanes are neighbours in every array of the call
  bool together;  // they all have the same number of steps
  V* hot;         // `Engine::hot`
  Trace<C> trace;
  bool apart = false;  // each of Mindlin's rings is a segment, for their derivatives

  Replicas(const Problem& problem, const Block& block) : problem(problem), block(block), plan(*block.pack->plan) {
    adjacent = neighbours(block.lanes);
    together = true;
    for (int l = 1; l < block.count; ++l) together &= block.lanes[l].steps == block.lanes[0].steps;
  }

  // Whether the lanes are neighbours in every array.
  bool neighbours(const ReplicaArrays* lanes) const {
    bool found = true;
    const ReplicaArrays& a = lanes[0];
    for (int l = 1; l < block.count; ++l) {
      const ReplicaArrays& b = lanes[l];
      for (int f = 0; f < kFields; ++f)
        found &= b.grains_in[f] == a.grains_in[f] + l && b.grains_out[f] == a.grains_out[f] + l;
      for (int leaf = 0; leaf < kMaxHistory; ++leaf)
        if (a.history_in[leaf])
          found &= b.history_in[leaf] == a.history_in[leaf] + l && b.history_out[leaf] == a.history_out[leaf] + l;
      for (int leaf = 0; leaf < kMaxHistory; ++leaf)
        if (a.wall_history_in[leaf])
          found &= b.wall_history_in[leaf] == a.wall_history_in[leaf] + l &&
                   b.wall_history_out[leaf] == a.wall_history_out[leaf] + l;
    }
    return found;
  }

  static int units(const Problem& p) { return p.grains; }
  static int unit_of(int grain) { return grain; }

  void use(const Layout& layout, V* of_engine) { static_cast<Layout&>(*this) = layout, hot = of_engine; }

  // Number `row` of an array in every lane; a short block repeats its last replica.
  template <class Pointer>
  Real gather(const ReplicaArrays* lanes, const Pointer& pointer, std::ptrdiff_t row, int first = 0) const {
    Real a{};
    for (int l = 0; l < W; ++l)
      a[l] = pointer(lanes[first + l < block.count ? first + l : block.count - 1])[row * problem.stride];
    return a;
  }

  V per_lane(const double* ReplicaArrays::* array, std::ptrdiff_t row) const {
    return of_lanes<V>(block, [&](const ReplicaArrays* lanes, int first) {
      return gather(lanes, [array](const ReplicaArrays& lane) { return lane.*array; }, row, first);
    });
  }

  // Number `row` of the pack's offsets, with its derivative.
  Dual<Real> offset(int row) const {
    return {splat<Real>(block.pack->offsets[row]),
            gather(block.slopes, [](const ReplicaArrays& lane) { return lane.offsets; }, row)};
  }

  V size_of(int u, double Size::* power) const { return splat<V>(plan.size[u].*power); }

  // --- copying in and out

  const ReplicaArrays* results() const { return problem.task == Task::forward ? block.lanes : block.slopes; }

  template <class Pointer>
  V read(const Pointer& pointer, std::ptrdiff_t row) const {
    return of_lanes<V>(
        block, [&](const ReplicaArrays* lanes, int first) { return read_lanes(lanes, adjacent, pointer, row, first); });
  }

  template <class Pointer>
  Real read_lanes(const ReplicaArrays* lanes, bool adjacent, const Pointer& pointer, std::ptrdiff_t row,
                  int first = 0) const {
    const int count = block.count - first;
    if (!adjacent || count < 1) return gather(lanes, pointer, row, first);
    const double* from = pointer(lanes[first]) + row * problem.stride;
    return count < W ? load(from, count) : load(from);
  }

  // Only lanes that have done all their steps.
  template <class Pointer>
  void write(const Pointer& pointer, std::ptrdiff_t row, V number, int steps_done) const {
    const auto a = result(number);
    const ReplicaArrays* lanes = results();
    if (adjacent && together) {
      double* to = pointer(lanes[0]) + row * problem.stride;
      return block.count < kReplicas<V> ? store(to, a, block.count) : store(to, a);
    }
    for (int l = 0; l < block.count; ++l)
      if (block.lanes[l].steps == steps_done) pointer(lanes[l])[row * problem.stride] = a[l];
  }

  void unload_pressure(Vec<V> pressure, int steps_done) const {
    const V p[3] = {pressure.x, pressure.y, pressure.z};
    for (int l = 0; l < block.count; ++l)
      for (int axis = 0; axis < 3; ++axis)
        if (block.lanes[l].steps == steps_done) results()[l].pressure[axis * problem.stride] = result(p[axis])[l];
  }

  void load_unit(int u, V* hot, V* cold) const {
    for (int f = 0; f < kFields; ++f)
      for (int q = 0; q < kField[f].size; ++q)
        field_at(f, u, hot, cold)[q] = read([f](const ReplicaArrays& lane) { return lane.grains_in[f]; },
                                            static_cast<std::ptrdiff_t>(plan.grain[u]) * kField[f].size + q);
  }

  void unload_unit(int u, const V* hot, const V* cold, int steps_done) const {
    for (int f = 0; f < kFields; ++f)
      for (int q = 0; q < kField[f].size; ++q)
        write([f](const ReplicaArrays& lane) { return lane.grains_out[f]; },
              static_cast<std::ptrdiff_t>(plan.grain[u]) * kField[f].size + q, field_at(f, u, hot, cold)[q],
              steps_done);
  }

  StoredSegments<V> segments_of(std::size_t c) const {
    int* const stored = marks.segments + c;
    if (!trace.touching) return {segment + c, plan.candidates, stored, problem.points};
    Segment<V>* const seen = trace.segment + c * problem.points;
    return {segment + c, plan.candidates, stored, problem.points, seen, trace.segments + c};
  }
  V outermost(std::size_t c, const LawParameters<V>& law) const {
    return Reach<V, Law::variant>(history[c * Law::kHistory + kLastOverlap], law, splat<V>(problem.points - 2.0)).outer;
  }

  // Number q of the history of a contact.
  C& remembered(std::size_t c, int q) const { return history[c * Law::kHistory + q]; }

  C history_in(Place place) const {
    return convert<C>(read([place](const ReplicaArrays& lane) { return lane.history_in[place.leaf]; }, place.row));
  }
  void history_out(Place place, C number, int steps_done) const {
    const auto out = [place](const ReplicaArrays& lane) { return lane.history_out[place.leaf]; };
    write(out, place.row, convert<V>(number), steps_done);
  }

  // One number of a history at walls, for the grain of unit u. `row` counts the rows of one grain; `place_at` finds the
  // place in the arrays of the call from the row among those of all grains.
  template <class PlaceAt>
  V wall_in(int u, int row, const PlaceAt& place_at) const {
    const Place place = place_at(wall_row(u, row));
    return read([place](const ReplicaArrays& lane) { return lane.wall_history_in[place.leaf]; }, place.row);
  }
  template <class PlaceAt>
  void wall_out(int u, int row, const PlaceAt& place_at, V number, int steps_done) const {
    const Place place = place_at(wall_row(u, row));
    write([place](const ReplicaArrays& lane) { return lane.wall_history_out[place.leaf]; }, place.row, number,
          steps_done);
  }
  std::ptrdiff_t wall_row(int u, int row) const {
    return static_cast<std::ptrdiff_t>(plan.grain[u]) * problem.wall_rows() + row;
  }

  void mark_new(std::size_t c) const {
    marks.touched[c] = true;
    marks.next_check[c] = 0.0;
  }

  void load_dummies() {}

  // --- what the grains tell the contacts, and the contacts the grains

  void put_sphere(int u, int k, Vec<V> centre) {
    store_vec(sphere + 3 * (static_cast<std::size_t>(u) * problem.spheres_per_grain + k), centre);
  }

  void put_grain(int u, Vec<V>, [[maybe_unused]] Vec<V> velocity, [[maybe_unused]] Vec<V> spin, Vec<V> force,
                 Vec<V> torque) {
    if constexpr (kMixed) {
      store_vec(motion[u].velocity, convert<C>(velocity));
      store_vec(motion[u].spin, convert<C>(spin));
    }
    store_vec(hot + static_cast<std::size_t>(u) * kHot + kForce, force);
    store_vec(hot + static_cast<std::size_t>(u) * kHot + kTorque, torque);
    std::fill(remote + 6 * static_cast<std::size_t>(plan.remote_start[u]),
              remote + 6 * static_cast<std::size_t>(plan.remote_start[u + 1]), C{});
  }

  void total_force(int u, Vec<V>& force, Vec<V>& torque) const {
    force = load_vec(hot + static_cast<std::size_t>(u) * kHot + kForce);
    torque = load_vec(hot + static_cast<std::size_t>(u) * kHot + kTorque);
    for (int n = plan.remote_start[u]; n < plan.remote_start[u + 1]; ++n) {
      force = force + convert<V>(load_vec(remote + 6 * static_cast<std::size_t>(n)));
      torque = torque + convert<V>(load_vec(remote + 6 * static_cast<std::size_t>(n) + 3));
    }
  }

  void add_walls(int, double* sums, Vec<V> lower, Vec<V> upper) const {
    V* s = reinterpret_cast<V*>(sums);
    store_vec(s, load_vec(s) + lower);
    store_vec(s + 3, load_vec(s + 3) + upper);
  }

  Vec<V> sum_walls(const double* walls, int chunks) const {
    const V* s = reinterpret_cast<const V*>(walls);
    Vec<V> lower{}, upper = lower;
    for (int chunk = 0; chunk < chunks; ++chunk) {
      lower = lower + load_vec(s + 6 * chunk);
      upper = upper + load_vec(s + 6 * chunk + 3);
    }
    return lower + upper;
  }

  // --- contacts

  void remember(std::size_t c, std::size_t place) {
    trace.touching[place] = static_cast<int>(c);
    for (int q = 0; q < Law::kHistory; ++q) trace.history[place * Law::kHistory + q] = history[c * Law::kHistory + q];
    if constexpr (Law::kLayered) trace.segments[c] = -1;
  }

  void contacts(int first, int end, const C* parameter, const LawParameters<C>& law, double travel, Faces<V>& faces) {
    if constexpr (!kMixed)
      if (plan.radii) return contacts_of<true>(first, end, parameter, law, travel, faces);
    contacts_of<false>(first, end, parameter, law, travel, faces);
  }

  // `contacts` of spheres that `differ` in radius, or do not.
  template <bool differ>
  void contacts_of(int first, int end, const C* parameter, const LawParameters<C>& law, double travel,
                   Faces<V>& faces) {
    constexpr int kLook = Marks<Law>::kLook, kBatch = kTogether, kAhead = 6;
    const V contact_square = splat<V>(4.0);
    int near[kLook], touching[kBatch];
    Contact<C> contact[kBatch];
    Unequal<C> unequal[differ ? kBatch : 1];
    int count = 0, remembered = first;
    for (int look = first; look < end; look += kLook) {
      const int found = marks.find_near(look, end, travel, near);
      for (int n = 0; n < found; ++n) {
        const int c = near[n];
        const Candidate& pair = plan.candidate[c];
        // Large packs are in no cache: prefetch the data of a later contact that do not lie next to those of others.
        // (In a function of its own GCC drops the prefetches.)
        if (n + kAhead < found) {
          const std::size_t later = near[n + kAhead];
          const V* of_sphere = sphere + 3 * static_cast<std::size_t>(plan.candidate[later].other);
          const char* centre = reinterpret_cast<const char*>(of_sphere);
          const char* remembered = reinterpret_cast<const char*>(history + later * Law::kHistory);
          for (std::size_t at = 0; at < 3 * sizeof(V); at += 64) __builtin_prefetch(centre + at);
          if (marks.touched[later])
            for (std::size_t at = 0; at < Law::kHistory * sizeof(C); at += 64) __builtin_prefetch(remembered + at);
        }
        const Vec<V> one = load_vec(sphere + 3 * static_cast<std::size_t>(pair.one));
        Vec<V> other = load_vec(sphere + 3 * static_cast<std::size_t>(pair.other));
        if (plan.image) other = other + shift(faces.cell, c);
        const V square = dot(other - one, other - one);
        const Radii* const radii = differ ? plan.radii + c : nullptr;
        if (!bits_less(square, differ ? splat<V>(radii->square) : contact_square)) {
          if (marks.touched[c]) forget(c);
          marks.next_check[c] = differ ? next_check(travel, smallest(square), radii->reach, plan.far)
                                       : next_check(travel, smallest(square));
          continue;
        }
        marks.touched[c] = true;
        if (trace.touching) remember(c, remembered++);
        if constexpr (differ) {
          unequal[count] = {splat<C>(radii->reach), splat<C>(radii->lean), splat<C>(radii->root)};
          contact[count].normal = other - one, contact[count].square = square;
        } else {
          relative_motion(input_of(c, one, other, faces.cell), convert<C>(square), contact[count]);
        }
        if constexpr (kMixed) contact[count].before = convert<C>(contact_square - square);
        contact[count].history = history + static_cast<std::size_t>(c) * Law::kHistory;
        touching[count++] = c;
        if (count < kBatch) continue;
        compute(touching, count, contact, differ ? unequal : nullptr, parameter, law, faces);
        count = 0;
      }
    }
    compute(touching, count, contact, differ ? unequal : nullptr, parameter, law, faces);
    if (trace.touching && first < end) trace.end[first] = remembered;
  }

  // The input of a contact between spheres with these centres; in a periodic box, `other` is the centre of the image.
  GMEM_INLINE ContactInput<C> input_of(std::size_t c, Vec<V> one, Vec<V> other, const Cell<V>& cell) const {
    ContactInput<C> input = contact_input(plan.candidate[c], one, other);
    if constexpr (!kMixed)
      if (plan.image) to_image(input, shift(cell, c), cell);
    return input;
  }

  Vec<V> shift(const Cell<V>& cell, std::size_t c) const {
    const Image& image = plan.image_of(c);
    return cell.shift(image.x, image.y, image.z);
  }

  void compute(const int* touching, int count, Contact<C>* contact, const Unequal<C>* unequal, const C* parameter,
               const LawParameters<C>& law, Faces<V>& faces) {
    if constexpr (kMixed) {
      close(contact, count, parameter);
    } else if (unequal) {
      close<true>(contact, count, parameter, unequal, [&](int n) {
        const Candidate& pair = plan.candidate[touching[n]];
        const Vec<V> one = load_vec(sphere + 3 * static_cast<std::size_t>(pair.one));
        Vec<V> other = load_vec(sphere + 3 * static_cast<std::size_t>(pair.other));
        if (plan.image) other = other + shift(faces.cell, touching[n]);
        return input_of(touching[n], one, other, faces.cell);
      });
    } else {
      close(contact, count, parameter);
    }
    rub<Law>(contact, count, law, unequal, [&](auto n) { return segments_of(touching[n]); });
    for (int n = 0; n < count; ++n) {
      const ContactLoads<C> found = push(contact[n]);
      add(plan.candidate[touching[n]], found);
      if (!plan.image || plan.image[touching[n]] == 0) continue;
      const Image& image = plan.image_of(touching[n]);
      const Vec<V> force = convert<V>(found.force);
      faces.through = faces.through + through_faces({splat<V>(image.x), splat<V>(image.y), splat<V>(image.z)}, force);
    }
  }

  void forget(std::size_t c) {
    marks.touched[c] = false;
    for (int q = 0; q < Law::kHistory; ++q) history[c * Law::kHistory + q] = C{};
    if constexpr (Law::kLayered) marks.segments[c] = 0;
  }

  GMEM_INLINE ContactInput<C> contact_input(const Candidate& pair, Vec<V> centre_one, Vec<V> centre_other) const {
    const V* one = hot + static_cast<std::size_t>(pair.grain_one) * kHot;
    const V* other = hot + static_cast<std::size_t>(pair.grain_other) * kHot;
    if constexpr (kMixed) {
      const GrainMotion<C>&of_one = motion[pair.grain_one], &of_other = motion[pair.grain_other];
      const Vec<C> separation = convert<C>(centre_other - centre_one), half = splat<C>(0.5) * separation;
      return {separation,
              convert<C>(centre_one - load_vec(one + kPosition)) + half,
              convert<C>(centre_other - load_vec(other + kPosition)) - half,
              load_vec(of_other.velocity) - load_vec(of_one.velocity),
              load_vec(of_one.spin),
              load_vec(of_other.spin)};
    } else {
      const Vec<V> point = splat<V>(0.5) * (centre_one + centre_other);
      return {centre_other - centre_one,
              point - load_vec(one + kPosition),
              point - load_vec(other + kPosition),
              load_vec(other + kVelocity) - load_vec(one + kVelocity),
              load_vec(one + kSpin),
              load_vec(other + kSpin)};
    }
  }

  GMEM_INLINE void add(const Candidate& pair, const ContactLoads<C>& push) {
    V* one = hot + static_cast<std::size_t>(pair.grain_one) * kHot;
    V* other = hot + static_cast<std::size_t>(pair.grain_other) * kHot;
    const bool away_is_one = pair.away_is_one();
    if (pair.remote < 0 || !away_is_one) {
      store_vec(one + kForce, load_vec(one + kForce) + convert<V>(push.force));
      store_vec(one + kTorque, load_vec(one + kTorque) + convert<V>(push.torque_one));
    }
    if (pair.remote < 0 || away_is_one) {
      store_vec(other + kForce, load_vec(other + kForce) - convert<V>(push.force));
      store_vec(other + kTorque, load_vec(other + kTorque) + convert<V>(push.torque_other));
    }
    if (pair.remote >= 0) {
      C* to = remote + 6 * static_cast<std::size_t>(pair.remote);
      store_vec(to, away_is_one ? load_vec(to) + push.force : load_vec(to) - push.force);
      store_vec(to + 3, load_vec(to + 3) + (away_is_one ? push.torque_one : push.torque_other));
    }
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
