// The mode for one replica: each vector is one number of W grains or of W contacts. Numbers that contacts look up or
// add to are also kept in rows of four doubles. See `Engine` in block.h for how it is used.

#pragma once

#include <algorithm>
#include <cstddef>

#include "cpu/block.h"
#include "cpu/histories.h"
#include "numbers/rows.h"

namespace gmem {
namespace GMEM_ISA {

struct GrainRows {
  Row position, velocity, spin, force, torque;
};

struct alignas(Row) RowOfSegment : Segment<double> {};

// The memory of a `Packed`.
template <class Law>
struct PackedLayout {
  static constexpr int kHistoryRows = (Law::kHistory + 3) / 4;

  Row* sphere;            // [S + 2]: centres; the last two are far apart: those of `dummy`
  GrainRows* grain;       // [N + 1]
  Row* remote;            // [remotes, 2]: sums of forces and torques
  Row* history;           // [candidates + 1, kHistoryRows]
  RowOfSegment* segment;  // [Q, candidates + 1] of the Mindlin law: segment k of all contacts lies together
  Marks<Law> marks;

  void place(const Problem& p, const Plan& plan, Arena& arena) {
    const std::size_t candidates = static_cast<std::size_t>(plan.candidates) + 1;
    const std::size_t grains = (static_cast<std::size_t>(p.grains) + W - 1) / W * W;
    sphere = arena.take<Row>(grains * p.spheres_per_grain + 2);
    grain = arena.take<GrainRows>(grains + 1);
    remote = arena.take<Row>(static_cast<std::size_t>(plan.remotes) * 2);
    history = arena.take<Row>(candidates * kHistoryRows);
    marks.place(plan, arena);
    segment = arena.take<RowOfSegment>(Law::kLayered ? candidates * p.points : 0);
  }
};

template <class Law>
struct Packed : PackedLayout<Law> {
  using Layout = PackedLayout<Law>;
  using Layout::sphere, Layout::grain, Layout::remote, Layout::history, Layout::segment, Layout::marks;
  using Number = Real;
  using V = Real;
  using OfContacts = Real;
  static constexpr bool apart = false;  // see `Replicas::apart`
  static constexpr bool kDual = false;
  using Layout::kHistoryRows;
  using OfLaw = Law;

  const Problem& problem;
  const Block& block;
  const Plan& plan;
  const ReplicaArrays& lane;
  const Candidate dummy;  // fills up vectors where contacts are fewer than W
  V* hot;                 // `Engine::hot`

  Packed(const Problem& problem, const Block& block)
      : problem(problem), block(block), plan(*block.pack->plan), lane(block.lanes[0]),
        dummy{dummy_sphere(), dummy_sphere() + 1, dummy_grain(), dummy_grain(), -1, -1, 0} {}

  static int units(const Problem& p) { return (p.grains + W - 1) / W; }
  static int unit_of(int grain) { return grain / W; }

  void use(const Layout& layout, V* of_engine) { static_cast<Layout&>(*this) = layout, hot = of_engine; }

  V per_lane(const double* ReplicaArrays::* array, std::ptrdiff_t row) const {
    return splat<V>((lane.*array)[row * problem.stride]);
  }

  V size_of(int u, double Size::* power) const {
    V size;
    for (int l = 0; l < W; ++l) size[l] = plan.size[grain_in(u, l)].*power;
    return size;
  }

  // --- copying in and out

  // Grain of lane l in unit u. The last vector is filled up with copies of the last grain, on which no contact acts.
  int grain_in(int u, int l) const { return u * W + l < problem.grains ? u * W + l : problem.grains - 1; }

  void load_unit(int u, V* hot, V* cold) const {
    for (int f = 0; f < kFields; ++f)
      for (int l = 0; l < W; ++l) {
        const std::ptrdiff_t from = static_cast<std::ptrdiff_t>(plan.grain[grain_in(u, l)]) * kField[f].size;
        for (int q = 0; q < kField[f].size; ++q)
          field_at(f, u, hot, cold)[q][l] = lane.grains_in[f][(from + q) * problem.stride];
      }
  }

  void unload_unit(int u, const V* hot, const V* cold, int) const {
    for (int f = 0; f < kFields; ++f)
      for (int l = 0; l < W && u * W + l < problem.grains; ++l) {
        const std::ptrdiff_t to = static_cast<std::ptrdiff_t>(plan.grain[u * W + l]) * kField[f].size;
        for (int q = 0; q < kField[f].size; ++q)
          lane.grains_out[f][(to + q) * problem.stride] = field_at(f, u, hot, cold)[q][l];
      }
  }

  std::ptrdiff_t segment_stride() const { return plan.candidates + 1; }
  StoredSegments<double, RowOfSegment> segments_of(std::size_t c) const {
    return {segment + c, segment_stride(), marks.segments + c, problem.points};
  }
  // Number q of the history of a contact.
  double& remembered(std::size_t c, int q) const { return reinterpret_cast<double*>(history + c * kHistoryRows)[q]; }
  double outermost(std::size_t c, const LawParameters<V>& law) const {
    return Reach<V, Law::variant>(splat<V>(remembered(c, kLastOverlap)), law, splat<V>(problem.points - 2.0)).outer[0];
  }

  double history_in(Place place) const { return lane.history_in[place.leaf][place.row * problem.stride]; }
  void history_out(Place place, double number, int) const {
    lane.history_out[place.leaf][place.row * problem.stride] = number;
  }

  // One number of a history at walls, for each grain of unit u. `row` counts the rows of one grain; `place_at` finds
  // the place in the arrays of the call from the row among those of all grains.
  template <class PlaceAt>
  V wall_in(int u, int row, const PlaceAt& place_at) const {
    V a;
    for (int l = 0; l < W; ++l) {
      const Place place = place_at(wall_row(u, l, row));
      a[l] = lane.wall_history_in[place.leaf][place.row * problem.stride];
    }
    return a;
  }
  template <class PlaceAt>
  void wall_out(int u, int row, const PlaceAt& place_at, V number, int) const {
    for (int l = 0; l < W && u * W + l < problem.grains; ++l) {
      const Place place = place_at(wall_row(u, l, row));
      lane.wall_history_out[place.leaf][place.row * problem.stride] = number[l];
    }
  }
  std::ptrdiff_t wall_row(int u, int l, int row) const {
    return static_cast<std::ptrdiff_t>(plan.grain[grain_in(u, l)]) * problem.wall_rows() + row;
  }

  void mark_new(std::size_t c) const {
    // A contact whose history is not 0 counts as touching. If it is apart, the first step finds that.
    bool any = false;
    for (int q = 0; q < Law::kGiven; ++q) any |= remembered(c, q) != 0.0;
    marks.touched[c] = any;
    marks.next_check[c] = -1.0;  // not looked at yet
  }

  void unload_pressure(Vec<V> pressure, int) const {
    const V p[3] = {pressure.x, pressure.y, pressure.z};
    for (int axis = 0; axis < 3; ++axis) lane.pressure[axis * problem.stride] = p[axis][0];
  }

  int dummy_sphere() const { return units(problem) * W * problem.spheres_per_grain; }
  int dummy_grain() const { return units(problem) * W; }

  void load_dummies() {
    sphere[dummy_sphere()] = Row{};
    sphere[dummy_sphere() + 1] = Row{4.0};
    grain[dummy_grain()] = GrainRows{};
    forget(plan.candidates);
  }

  // --- what the grains tell the contacts, and the contacts the grains

  void put_sphere(int u, int k, Vec<V> centre) {
    const int spheres = problem.spheres_per_grain;
    store_rows(sphere + static_cast<std::size_t>(u) * W * spheres + k, spheres, centre);
  }

  void put_grain(int u, Vec<V> position, Vec<V> velocity, Vec<V> spin, Vec<V> force, Vec<V> torque) {
    constexpr std::ptrdiff_t stride = sizeof(GrainRows) / sizeof(Row);
    GrainRows* first = grain + static_cast<std::size_t>(u) * W;
    store_rows(&first->position, stride, position);
    store_rows(&first->velocity, stride, velocity);
    store_rows(&first->spin, stride, spin);
    store_rows(&first->force, stride, force);
    store_rows(&first->torque, stride, torque);
    const int begin = u * W, end = begin + W < problem.grains ? begin + W : problem.grains;
    std::fill(remote + 2 * static_cast<std::size_t>(plan.remote_start[begin]),
              remote + 2 * static_cast<std::size_t>(plan.remote_start[end]), Row{});
  }

  void total_force(int u, Vec<V>& force, Vec<V>& torque) const {
    Row f[W], t[W];
    for (int l = 0; l < W; ++l) {
      const int g = u * W + l;
      // Lanes beyond the last grain are copies of it without its contacts. No force acts on them: the walls alone would
      // throw them out of the box, and by their speed (`Engine::travel`) all candidates would have to be looked at.
      f[l] = g < problem.grains ? grain[g].force : Row{};
      t[l] = g < problem.grains ? grain[g].torque : Row{};
      if (g >= problem.grains) continue;
      for (int n = plan.remote_start[g]; n < plan.remote_start[g + 1]; ++n) {
        f[l] += remote[2 * static_cast<std::size_t>(n)];
        t[l] += remote[2 * static_cast<std::size_t>(n) + 1];
      }
    }
    force = columns(load_rows([&](int l) { return f + l; }));
    torque = columns(load_rows([&](int l) { return t + l; }));
  }

  void add_walls(int u, double* sums, Vec<V> lower, Vec<V> upper) const {
    const V parts[6] = {lower.x, lower.y, lower.z, upper.x, upper.y, upper.z};
    for (int l = 0; l < W && u * W + l < problem.grains; ++l)
      for (int q = 0; q < 6; ++q) sums[q] += parts[q][l];
  }

  Vec<V> sum_walls(const double* walls, int chunks) const {
    double sums[6] = {};
    for (int chunk = 0; chunk < chunks; ++chunk)
      for (int q = 0; q < 6; ++q) sums[q] += walls[static_cast<std::size_t>(chunk) * 6 * W + q];
    return {splat<V>(sums[0] + sums[3]), splat<V>(sums[1] + sums[4]), splat<V>(sums[2] + sums[5])};
  }

  // --- contacts

  static constexpr int kCached = 8192;  // up to so many candidates, some 700 grains, nothing need be prefetched

  // Mindlin's segments of W contacts.
  struct Segments {
    RowOfSegment* first[W];
    int* stored[W];
    std::ptrdiff_t stride;
    int rings, most, lanes;

    V last() const { return splat<V>(rings - 2.0); }
    int count() const { return most; }
    Segment<V> get(int k) const {
      const Row none{0.0, 0.0, kNowhere};
      const Rows rows = load_rows(
          [&](int l) { return k < *stored[l] ? reinterpret_cast<const Row*>(first[l] + k * stride) : &none; });
      const Vec<V> segment = columns(rows);
      return {{segment.x, segment.y}, segment.z};
    }
    void set(int k, const Segment<V>& segment) {
      const Rows rows = rows_of({segment.force.along, segment.force.across, segment.start});
      for (int l = 0; l < lanes; ++l) *reinterpret_cast<Row*>(first[l] + k * stride) = row_of(rows, l);
    }
    void keep(V counts) {
      for (int l = 0; l < lanes; ++l) *stored[l] = static_cast<int>(counts[l]);
      most = static_cast<int>(largest(counts));
    }
    void remember() const {}
  };

  // W contacts; where there are fewer, the rest are dummies far apart, which all threads read and none writes.
  struct Group {
    int count;
    int c[W];
    const Candidate* pair[W];  // pointers, since a read of a copy would wait until the copy has been written
  };

  void contacts(int first, int end, const V* parameter, const LawParameters<V>& law, double travel, Faces<V>& faces) {
    constexpr int kLook = Marks<Law>::kLook, kBatch = kTogether * W, kAhead = 8;
    const bool asks = plan.candidates > kCached;
    int near[kLook], touching[kBatch];
    int count = 0;
    for (int look = first; look < end; look += kLook) {
      const int found = marks.find_near(look, end, travel, near);
      for (int n = 0; n < found; ++n) {
        const int c = near[n];
        // Large packs are in no cache: prefetch the data of a later contact that do not lie next to those of others.
        if (asks && n + kAhead < found) {
          const std::size_t later = near[n + kAhead];
          const GrainRows* other = grain + plan.candidate[later].grain_other;
          __builtin_prefetch(sphere + plan.candidate[later].other);
          if constexpr (kHistoryRows > 0) __builtin_prefetch(history + later * kHistoryRows);
          if (marks.touched[later])
            __builtin_prefetch(other), __builtin_prefetch(&other->spin), __builtin_prefetch(&other->torque);
        }
        if (!marks.touched[c] && !touches(c, travel, faces.cell)) continue;
        touching[count++] = c;
        if (count < kBatch) continue;
        compute(touching, count, parameter, law, faces);
        count = 0;
      }
    }
    compute(touching, count, parameter, law, faces);
  }

  // By how many edges of a periodic box the second sphere of a candidate is moved, and the lengths of the edges.
  const Row& image_of(std::size_t c) const { return reinterpret_cast<const Row&>(plan.image_of(c)); }
  static Row edges(const Cell<V>& cell) { return Row{cell.lengths.x[0], cell.lengths.y[0], cell.lengths.z[0]}; }

  // Whether a candidate that did not touch at the last step does now, by the same arithmetic as in vectors.
  bool touches(std::size_t c, double travel, const Cell<V>& cell) {
    const Row other = sphere[plan.candidate[c].other];
    const Row d = (plan.image ? other + image_of(c) * edges(cell) : other) - sphere[plan.candidate[c].one];
    const double square = fma(d[2], d[2], fma(d[1], d[1], d[0] * d[0]));
    const Radii radii = plan.radii ? plan.radii[c] : Radii{2.0, 0.0, 1.0, 4.0};
    if (square < radii.square) return marks.touched[c] = true;
    if (marks.next_check[c] < 0.0) forget(c);
    marks.next_check[c] = next_check(travel, square, radii.reach, plan.far);
    return false;
  }

  void forget(std::size_t c) {
    for (int r = 0; r < kHistoryRows; ++r) history[c * kHistoryRows + r] = Row{};
    if constexpr (Law::kLayered) marks.segments[c] = 0;
  }

  void compute(const int* touching, int count, const V* parameter, const LawParameters<V>& law, Faces<V>& faces) {
    plan.image ? compute_in<true>(touching, count, parameter, law, faces)
               : compute_in<false>(touching, count, parameter, law, faces);
  }

  // `compute` in a box with or without periodic axes: GCC makes faster code of the two apart.
  template <bool periodic>
  __attribute__((noinline)) void compute_in(const int* touching, int count, const V* parameter,
                                            const LawParameters<V>& law, Faces<V>& faces) {
    constexpr int kGroups = kTogether;
    Group group[kGroups];
    Contact<V> contact[kGroups];
    Vec<V> spin[kGroups];
    Unequal<V> unequal[kGroups];
    V memory[kGroups][kHistoryRows ? 4 * kHistoryRows : 1];
    const int groups = (count + W - 1) / W;
    for (int n = 0; n < groups; ++n) {
      group[n] = group_of(touching + n * W, count - n * W);
      contact[n].history = memory[n];
      read_history(group[n], memory[n]);
      const ContactInput<V> m = contact_input<periodic>(group[n], faces.cell);
      relative_motion(m, dot(m.separation, m.separation), contact[n]);
      if (plan.radii) unequal[n] = unequal_of(group[n]), spin[n] = m.spin_other - m.spin_one;
    }
    plan.radii ? close<true>(contact, groups, parameter, unequal, [&](int n) { return spin[n]; })
               : close(contact, groups, parameter);
    for (int n = 0; n < groups; ++n) forget_apart(group[n], contact[n].overlap);
    rub<Law>(contact, groups, law, plan.radii ? unequal : nullptr, [&](int n) { return segments_of(group[n]); });
    for (int n = 0; n < groups; ++n) {
      write_history(group[n], memory[n]);
      const ContactLoads<V> found = push(contact[n]);
      add(group[n], found);
      if (periodic && any_image(group[n])) add_through(group[n], found.force, faces.through);
    }
  }

  bool any_image(const Group& g) const {
    int32_t any = 0;
    for (int l = 0; l < W; ++l) any |= plan.image[g.c[l]];
    return any != 0;
  }

  // All lanes of `through` are the same.
  GMEM_INLINE void add_through(const Group& g, Vec<V> force, Vec<V>& through) const {
    const Rows forces = rows_of(force);
    Row sum{through.x[0], through.y[0], through.z[0]};
    for (int l = 0; l < W; ++l) sum -= image_of(g.c[l]) * row_of(forces, l);
    through = {splat<V>(sum[0]), splat<V>(sum[1]), splat<V>(sum[2])};
  }

  // Marks contacts that have come apart in this step. The laws give them no force and a blank history.
  void forget_apart(const Group& g, V overlap) {
    if (!bits_less(overlap, splat<V>(1e-300))) return;
    for (int l = 0; l < g.count; ++l)
      if (!(overlap[l] > 0.0)) marks.touched[g.c[l]] = false;
  }

  Group group_of(const int* touching, int count) const {
    Group g;
    g.count = count < W ? count : W;
    for (int l = 0; l < W; ++l) {
      g.c[l] = l < count ? touching[l] : plan.candidates;
      g.pair[l] = l < count ? plan.candidate + g.c[l] : &dummy;
    }
    return g;
  }

  // The input of W contacts; in a periodic box, with the images of the second grains.
  template <bool periodic>
  GMEM_INLINE ContactInput<V> contact_input(const Group& g, const Cell<V>& cell) const {
    const auto one = [&](Row GrainRows::* row) {
      return load_rows([&](int l) { return &(grain[g.pair[l]->grain_one].*row); });
    };
    const auto other = [&](Row GrainRows::* row) {
      return load_rows([&](int l) { return &(grain[g.pair[l]->grain_other].*row); });
    };
    const Rows centre_one = load_rows([&](int l) { return sphere + g.pair[l]->one; });
    Rows centre_other = load_rows([&](int l) { return sphere + g.pair[l]->other; }), moved{};
    if constexpr (periodic) {
      const Row edge = edges(cell);
      const Rows images = load_rows([&](int l) { return &image_of(g.c[l]); });
      moved = images * load_rows([&](int) { return &edge; });
      centre_other = centre_other + moved;
    }
    const Rows point = splat<V>(0.5) * (centre_one + centre_other);
    const Rows lever_one = point - one(&GrainRows::position), lever_other = point - other(&GrainRows::position);
    ContactInput<V> input{columns(centre_other - centre_one),
                          columns(lever_one),
                          columns(periodic ? lever_other - moved : lever_other),
                          columns(other(&GrainRows::velocity) - one(&GrainRows::velocity)),
                          columns(one(&GrainRows::spin)),
                          columns(other(&GrainRows::spin))};
    if constexpr (periodic) drift(input, cell);
    return input;
  }

  Unequal<V> unequal_of(const Group& g) const {
    const Rows rows = load_rows([&](int l) { return reinterpret_cast<const Row*>(plan.radii + g.c[l]); });
    const Vec<V> radii = columns(rows);
    return {radii.x, radii.y, radii.z};
  }

  void read_history(const Group& g, V* memory) const {
    for (int r = 0; r < kHistoryRows; ++r) {
      const Rows rows = load_rows([&](int l) { return history + static_cast<std::size_t>(g.c[l]) * kHistoryRows + r; });
      store_vec(memory + 4 * r, columns(rows));
      if (Law::kHistory > 4 * r + 3) memory[4 * r + 3] = spare_column(rows);
    }
  }

  void write_history(const Group& g, const V* memory) {
    for (int r = 0; r < kHistoryRows; ++r) {
      const Rows kept = rows_of(load_vec(memory + 4 * r), Law::kHistory > 4 * r + 3 ? memory[4 * r + 3] : V{});
      for (int l = 0; l < g.count; ++l) history[static_cast<std::size_t>(g.c[l]) * kHistoryRows + r] = row_of(kept, l);
    }
  }

  Segments segments_of(const Group& g) {
    Segments segments;
    segments.stride = segment_stride();
    segments.rings = problem.points;
    segments.most = 0;
    segments.lanes = g.count;
    for (int l = 0; l < W; ++l) {
      segments.first[l] = segment + g.c[l];
      segments.stored[l] = marks.segments + g.c[l];
      segments.most = *segments.stored[l] > segments.most ? *segments.stored[l] : segments.most;
    }
    return segments;
  }

  GMEM_INLINE void add(const Group& g, const ContactLoads<V>& push) {
    const Rows force = rows_of(push.force);
    const Rows torque_one = rows_of(push.torque_one), torque_other = rows_of(push.torque_other);
    Row f[W], t_one[W], t_other[W];
    for (int l = 0; l < W; ++l)
      f[l] = row_of(force, l), t_one[l] = row_of(torque_one, l), t_other[l] = row_of(torque_other, l);
    for (int l = 0; l < g.count; ++l) add(*g.pair[l], f[l], t_one[l], t_other[l]);
  }

  GMEM_INLINE void add(const Candidate& pair, Row force, Row torque_one, Row torque_other) {
    GrainRows &one = grain[pair.grain_one], &other = grain[pair.grain_other];
    const bool away_is_one = pair.away_is_one();
    if (pair.remote < 0 || !away_is_one) one.force += force, one.torque += torque_one;
    if (pair.remote < 0 || away_is_one) other.force -= force, other.torque += torque_other;
    if (pair.remote >= 0) {
      Row* to = remote + 2 * static_cast<std::size_t>(pair.remote);
      to[0] += away_is_one ? force : -force;
      to[1] += away_is_one ? torque_one : torque_other;
    }
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
