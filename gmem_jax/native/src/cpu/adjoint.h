// Reverse mode: all steps of one block gone through forwards, then backwards. The physics is that of the other headers,
// recorded by the compiler (calculations.h) or, where a contact comes to another of Mindlin's rings, on a tape
// (`Taped`). This file only passes derivatives on from results to arguments.
// "Bar" x is the derivative of the final result by x.
//
// With numbers that carry a derivative (`Dual`) this file gives the derivative of these derivatives along a direction.
//
// Grains and contacts are shared among the threads of a team as in the forward steps, and sums are taken in the same
// fixed order.

#pragma once

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <type_traits>
#include <vector>

#include "cpu/replicas.h"
#include "numbers/tape.h"
#include "physics/calculations.h"

namespace gmem {
namespace GMEM_ISA {

// What a contact adds to the bars of a grain of another domain.
enum RemoteRow { kRemoteCentre = 0, kRemotePosition = 3, kRemoteVelocity = 6, kRemoteSpin = 9, kRemote = 12 };

template <class V>
inline void add_vec(V* to, Vec<V> a) {
  store_vec(to, load_vec(to) + a);
}

template <class V>
inline void seed(Taped<V> a, V bar) {
  if (a.slot) tape<V>->bar(a.slot) += bar;
}
template <class V>
inline void seed(Vec<Taped<V>> a, Vec<V> bar) {
  seed(a.x, bar.x), seed(a.y, bar.y), seed(a.z, bar.z);
}

template <class V>
struct TapedWalls {
  int first;
  WallState<Taped<V>> box;

  explicit TapedWalls(const WallState<V>& w)
      : first(tape<V>->mark().slots),
        box{leaf(w.lower), leaf(w.upper), leaf(w.lower_velocity), leaf(w.upper_velocity)} {}

  void add_bars(V* to) const {
    for (int row = 0; row < kWalls; ++row) to[row] += tape<V>->bar(first + row);
  }
};

template <class V>
struct TapedParameters {
  int first;
  Taped<V> row[kParameters];

  explicit TapedParameters(const V* parameter) : first(tape<V>->mark().slots) {
    for (int r = 0; r < kParameters; ++r) row[r] = leaf(parameter[r]);
  }

  void add_bars(V* to) const {
    for (int r = 0; r < kParameters; ++r) to[r] += tape<V>->bar(first + r);
  }
};

// The memory of an `Adjoint`. Arrays of every step have room for all candidates; the system provides no memory for the
// part that is never written because contacts are apart.
template <class Law, class V>
struct AdjointLayout {
  EngineLayout<Replicas<Law, V>> of_forward;
  V* state;         // [steps, N, kState]: at the beginning of each step
  V* total;         // [steps, N, 6]: force and torque in the step
  Trace<V>* trace;  // [steps]
  V* state_bar;     // [N, kState]
  V* mid_bar;       // [N, kMid]
  V* sphere_bar;    // [S, 3]
  V* remote_bar;    // [remote_contacts, kRemote]
  V* history_bar;   // [candidates, kHistory and the forces of Mindlin's segments, 2 Q]
  bool* has_bar;    // [candidates]: whether bars of the history and of the remote contact may differ from zero
  V* domain_bar;    // [domains, kParameters + kLawNumbers]
  V* chunk_bar;     // [chunks, kGrainNumbers, the offsets, 3 K, the mass, and kWallLawNumbers]
  V* wall_bar;      // [chunks, kWalls], of one step
  // Where calculations are general (calculations.h):
  V* faces;            // [steps, 2, 3]: sections of periodic boxes, and forces through their faces
  V* domain_cell_bar;  // [domains, kCellNumbers], of one step
  V* chunk_cell_bar;   // [chunks, 2, kCellNumbers], of the cell in that step and of the one before
  // Where walls have friction: the histories there at the beginning of each step, the planes where they are not 0;
  // bars.
  V* wall_history;        // [steps, N, wall_rows, kHistory]
  unsigned char* planes;  // [steps, S], bits
  V* wall_history_bar;    // [N, wall_rows, kHistory and the forces of Mindlin's segments, 2 Q]
  V* rubbed_bar;          // [N, 3], in periodic boxes: of `rubbed`
  Trace<V>* wall_trace;   // [steps]: of Mindlin's segments at walls, [N, wall_rows, ...]

  // Numbers in the history of a contact.
  static int remembered(const Problem& p) { return Law::kHistory + (Law::kLayered ? 2 * p.points : 0); }

  // Rows of `chunk_bar`.
  static int chunk_rows(const Problem& p) { return mass_row(p) + 1 + kWallLawNumbers; }
  static int mass_row(const Problem& p) { return kGrainNumbers + 3 * p.spheres_per_grain; }

  static bool is_general(const Problem& p, const Plan& plan) { return p.periodic || plan.radii; }

  // With `fills` also fills in the traces of the steps. One thread does so; the others see them after a barrier.
  void place(const Problem& p, const Block& block, Arena& arena, bool fills = false) {
    of_forward.place(p, block, arena);
    const Plan& plan = *block.pack->plan;
    const std::size_t steps = block.lanes[0].steps, grains = p.grains, candidates = plan.candidates;
    const std::size_t layered = Law::kLayered ? candidates : 0, chunks = gmem::GMEM_ISA::chunks(p);
    state = arena.take<V>(steps * grains * kState);
    total = arena.take<V>(steps * grains * 6);
    trace = arena.take<Trace<V>>(steps);
    for (std::size_t step = 0; step < steps; ++step) {
      Trace<V> t;
      t.touching = arena.take<int>(candidates);
      t.end = arena.take<int>(candidates);
      t.history = arena.take<V>(candidates * Law::kHistory);
      t.segment = arena.take<Segment<V>>(layered * p.points);
      t.segments = arena.take<int>(layered);
      if (fills) trace[step] = t;
    }
    state_bar = arena.take<V>(grains * kState);
    mid_bar = arena.take<V>(grains * kMid);
    sphere_bar = arena.take<V>(static_cast<std::size_t>(p.spheres()) * 3);
    remote_bar = arena.take<V>(static_cast<std::size_t>(plan.remote_contacts) * kRemote);
    history_bar = arena.take<V>(candidates * remembered(p));
    has_bar = arena.take<bool>(candidates);
    domain_bar = arena.take<V>(static_cast<std::size_t>(plan.domains) * (kParameters + kLawNumbers));
    chunk_bar = arena.take<V>(chunks * chunk_rows(p));
    wall_bar = arena.take<V>(chunks * kWalls);
    const bool general = is_general(p, plan);
    faces = arena.take<V>(general ? steps * 6 : 0);
    domain_cell_bar = arena.take<V>(general ? static_cast<std::size_t>(plan.domains) * kCellNumbers : 0);
    chunk_cell_bar = arena.take<V>(general ? chunks * 2 * kCellNumbers : 0);
    wall_history = arena.take<V>(p.rubs ? steps * grains * p.wall_rows() * Law::kHistory : 0);
    planes = arena.take<unsigned char>(p.rubs ? steps * p.spheres() : 0);
    const std::size_t wall_rows = p.rubs ? grains * p.wall_rows() : 0, rings = Law::kLayered ? p.points : 0;
    wall_history_bar = arena.take<V>(wall_rows * remembered(p));
    rubbed_bar = arena.take<V>(p.rubs && p.periodic ? grains * 3 : 0);
    wall_trace = arena.take<Trace<V>>(Law::kLayered && p.rubs ? steps : 0);
    for (std::size_t step = 0; Law::kLayered && p.rubs && step < steps; ++step) {
      Trace<V> t;
      t.segment = arena.take<Segment<V>>(wall_rows * rings);
      t.segments = arena.take<int>(wall_rows);
      if (fills) wall_trace[step] = t;
    }
  }
};

template <class Law, class V>
struct Adjoint : AdjointLayout<Law, V> {
  using Layout = AdjointLayout<Law, V>;
  using Layout::state, Layout::total, Layout::trace, Layout::state_bar, Layout::mid_bar, Layout::sphere_bar;
  using Layout::remote_bar, Layout::history_bar, Layout::has_bar, Layout::domain_bar;
  using Layout::chunk_bar, Layout::wall_bar, Layout::faces, Layout::domain_cell_bar, Layout::chunk_cell_bar;
  using Layout::wall_history, Layout::planes, Layout::wall_history_bar, Layout::rubbed_bar, Layout::wall_trace;
  using Layout::remembered, Layout::chunk_rows, Layout::mass_row;
  using Forward = Engine<Replicas<Law, V>>;
  using Taped = GMEM_ISA::Taped<V>;
  static constexpr bool kDual = std::is_same<V, Dual<Real>>::value;
  static constexpr int kParts = sizeof(V) / sizeof(Real);  // vectors of lanes in a number
  static constexpr int kNumbers = OneContact<Law, true>::kNumbers, kResults = OneContact<Law, true>::kResults;

  Forward forward;
  const Problem& problem;
  const Block& block;
  const Plan& plan;
  Team& team;
  const int rank, steps;
  const bool adjacent;  // the lanes are neighbours in every array of bars
  const bool general;
  Tape<V> recorded;
  V law_numbers[kLawNumbers], grain_numbers[kGrainNumbers], wall_law_numbers[kWallLawNumbers], last_ring;
  // Of the step that is gone back through: its cell, the numbers of this cell and of the one before; bars of `faces`.
  Cell<V> cell;
  V cell_numbers[kCellNumbers], before_numbers[kCellNumbers], faces_bar[6];
  V earlier_bar[kCellNumbers] = {};  // of the cell before those steps that were gone back through already

  Adjoint(const Problem& problem, const Block& block, Team& team, int rank, void* scratch)
      : forward(problem, block, team, rank, scratch), problem(problem), block(block), plan(*block.pack->plan),
        team(team), rank(rank), steps(block.lanes[0].steps), adjacent(all_adjacent()),
        general(Layout::is_general(problem, plan)) {
    Arena arena{static_cast<char*>(scratch)};
    this->place(problem, block, arena, rank == 0);  // `forward` has its memory at the beginning of the same scratch
    forward.mode.apart = true;
    store_numbers(law_numbers, LawParameters<V>(forward.parameter + kLaw, forward.parameter[kDt]));
    store_numbers(grain_numbers, forward.constants);
    if (problem.rubs) store_numbers(wall_law_numbers, forward.wall_law);
    last_ring = splat<V>(problem.points - 2.0);
  }

  // The centre of sphere k in a grain.
  Vec<V> offset_of(int k) const {
    if constexpr (kDual) return load_vec(forward.offsets + 3 * k);
    else return body_at<V>(block.pack->offsets + 3 * k);
  }

  V* history_of(std::size_t c) const { return history_bar + c * remembered(problem); }

  int chunks() const { return gmem::GMEM_ISA::chunks(problem); }
  V* of_domain(int domain) const { return domain_bar + static_cast<std::size_t>(domain) * (kParameters + kLawNumbers); }
  V* of_chunk(int chunk) const { return chunk_bar + static_cast<std::size_t>(chunk) * chunk_rows(problem); }
  V* cell_bar_of_domain(int domain) const { return domain_cell_bar + static_cast<std::size_t>(domain) * kCellNumbers; }
  V* cell_bar_of_chunk(int chunk) const { return chunk_cell_bar + static_cast<std::size_t>(chunk) * 2 * kCellNumbers; }
  V* of_grain(V* array, int u, int rows) const { return array + static_cast<std::size_t>(u) * rows; }

  // Calls `each(u)` for this rank's grains.
  template <class Each>
  void for_grains(const Each& each) const {
    for (int u = forward.share_begin(problem.grains); u < forward.share_begin(problem.grains, 1); ++u) each(u);
  }

  // Calls `each(chunk)` for the chunks of grains as the team shares them.
  template <class Each>
  void for_chunks(const Each& each) {
    team.share(Team::kGrains, rank, chunks());
    for (int chunk; team.take(Team::kGrains, rank, &chunk);) each(chunk);
    team.barrier();
  }

  // Calls `move` with each number of a state and its place in the forward steps.
  template <class Move>
  void move_state(int u, V* s, const Move& move) const {
    for (int f = 0; f < kFields; ++f)
      for (int q = 0; q < kField[f].size; ++q) move(*s++, field_at(f, u, forward.hot, forward.cold)[q]);
  }

  V* state_of(int step, int u) const {
    return of_grain(state + static_cast<std::size_t>(step) * problem.grains * kState, u, kState);
  }
  V* total_of(int step, int u) const {
    return of_grain(total + static_cast<std::size_t>(step) * problem.grains * 6, u, 6);
  }

  // The history of sphere k of grain u at plane w: its row, its place in the array `histories`, and its bars.
  std::size_t plane_row(int u, int k, int w) const { return forward.wall_row(u, kPlanes * k + w); }
  V* at_plane(V* histories, int u, int k, int w) const { return histories + plane_row(u, k, w) * Law::kHistory; }
  V* bar_at_plane(int u, int k, int w) const { return wall_history_bar + plane_row(u, k, w) * remembered(problem); }
  V* wall_history_at(int step) const {
    return wall_history + static_cast<std::size_t>(step) * problem.grains * problem.wall_rows() * Law::kHistory;
  }
  unsigned char& planes_of(int step, int u, int k) const {
    return planes[(static_cast<std::size_t>(step) * problem.grains + u) * problem.spheres_per_grain + k];
  }

  // Calls `each(k, w, planes)` for sphere k of grain u and plane w; `planes` are those that the forward steps know of
  // sphere k.
  template <class Each>
  void for_planes(int u, const Each& each) const {
    if (!problem.rubs) return;
    for (int k = 0; k < problem.spheres_per_grain; ++k)
      for (int w = 0; w < kPlanes; ++w)
        each(k, w, forward.remembered[static_cast<std::size_t>(u) * problem.spheres_per_grain + k]);
  }

  // Keeps the numbers of grain u at the beginning of a step ...
  void keep(int step, int u) const {
    move_state(u, state_of(step, u), [](V& kept, V now) { kept = now; });
    for_planes(u, [&](int k, int w, const KnownPlanes& known) {
      planes_of(step, u, k) = known.now;
      if constexpr (Law::kLayered) wall_trace[step].segments[plane_row(u, k, w)] = -1;
      if (!(known.now >> w & 1)) return;
      std::copy_n(at_plane(forward.wall_history, u, k, w), Law::kHistory, at_plane(wall_history_at(step), u, k, w));
    });
  }

  // ... and brings them back.
  void bring_back(int step, int u) const {
    move_state(u, state_of(step, u), [](V kept, V& now) { now = kept; });
    if (problem.rubs) forward.remembers[u] = false;
    for_planes(u, [&](int k, int w, KnownPlanes& known) {
      V* const now = at_plane(forward.wall_history, u, k, w);
      known.now = planes_of(step, u, k);
      forward.remembers[u] |= known.now != 0;
      if (known.now >> w & 1) std::copy_n(at_plane(wall_history_at(step), u, k, w), Law::kHistory, now);
      else if (known.ever >> w & 1) std::fill_n(now, Law::kHistory, V{});
    });
    restore_segments(step, u);
  }

  // Puts back Mindlin's segments of grain u at walls that a step changed. (The step does not look at other segments.)
  void restore_segments(int step, int u) const {
    if constexpr (Law::kLayered)
      for_planes(u, [&](int k, int w, const KnownPlanes&) {
        const std::size_t row = plane_row(u, k, w);
        const int before = wall_trace[step].segments[row];
        StoredSegments<V> segments = forward.wall_segments_of(row);
        for (int n = 0; n < before; ++n) segments.set(n, wall_trace[step].segment[row * problem.points + n]);
        if (before >= 0) *segments.stored = before;
      });
  }

  void trace_walls(int step) {
    if (Law::kLayered && problem.rubs) forward.trace = wall_trace[step];
  }

  // --- forwards

  void go_forward() {
    forward.load();
    for (int step = 0; step < steps; ++step) {
      for_grains([&](int u) { keep(step, u); });
      team.barrier();
      trace_walls(step);
      forward.grains(false, true, step);
      forward.mode.trace = trace[step];
      forward.contacts();
      for_grains([&](int u) {
        Vec<V> force, torque;
        forward.mode.total_force(u, force, torque);
        store_vec(total_of(step, u), force);
        store_vec(total_of(step, u) + 3, torque);
      });
      team.barrier();
      if (general || step + 1 < steps) forward.grains(true, false, 0);
      if (problem.periodic && rank == 0) {
        store_vec(faces + 6 * step, forward.mode.sum_walls(forward.sections, chunks()));
        store_vec(faces + 6 * step + 3, forward.sum_through());
      }
    }
    team.barrier();
  }

  // --- bars in and out

  bool all_adjacent() const {
    return forward.mode.neighbours(block.bars) && (!kDual || forward.mode.neighbours(block.bar_slopes));
  }

  template <class Pointer>
  V read(const Pointer& pointer, std::ptrdiff_t row) const {
    const auto of = [&](const ReplicaArrays* lanes) { return forward.mode.read_lanes(lanes, adjacent, pointer, row); };
    if constexpr (kDual) return {of(block.bars), of(block.bar_slopes)};
    else return of(block.bars);
  }

  template <class Pointer>
  void write(const Pointer& pointer, std::ptrdiff_t row, V bar) const {
    const Real a = result(bar);
    double* const to = pointer(block.bars[0]) + row * problem.stride;
    if (adjacent) return block.count < W ? store(to, a, block.count) : store(to, a);
    for (int l = 0; l < block.count; ++l) pointer(block.bars[l])[row * problem.stride] = a[l];
  }

  // Calls `each(field, row in the arrays of the call, row of the state)` for the numbers of grain u.
  template <class Each>
  void for_fields(int u, const Each& each) const {
    for (int f = 0, first = 0; f < kFields; first += kField[f++].size)
      for (int q = 0; q < kField[f].size; ++q)
        each(f, static_cast<std::ptrdiff_t>(plan.grain[u]) * kField[f].size + q, first + q);
  }

  // Calls `each(leaf, row in the arrays of the call, number)` for the history in `row` of the list.
  template <class Each>
  void for_history(std::ptrdiff_t row, const Each& each) const {
    for (int q = 0; q < Law::kGiven; ++q) {
      const Place place = place_of<Law>(row, q);
      each(place.leaf, place.row, q);
    }
    for (int q = Law::kHistory; q < remembered(problem); ++q)
      each(0, ring_place(problem, row, 0, q - Law::kHistory).row, q);
  }

  // Calls `each(leaf, row in the arrays of the call, bar)` for the histories at walls of grain u.
  template <class Each>
  void for_wall_history(int u, const Each& each) const {
    for_planes(u, [&](int k, int w, const KnownPlanes&) {
      for_history(forward.mode.wall_row(u, kPlanes * k + w),
                  [&](int leaf, std::ptrdiff_t row, int q) { each(leaf, row, bar_at_plane(u, k, w)[q]); });
    });
  }

  void load_bars() {
    for_grains([&](int u) {
      for_wall_history(u, [&](int leaf, std::ptrdiff_t row, V& bar) {
        bar = read([leaf](const ReplicaArrays& lane) { return lane.wall_history_in[leaf]; }, row);
      });
      if constexpr (Law::kLayered)
        for_planes(u, [&](int k, int w, const KnownPlanes&) {
          const std::size_t row = plane_row(u, k, w);
          to_layers(bar_at_plane(u, k, w), forward.wall_segments_of(row), forward.wall_outermost(row));
        });
      for_fields(u, [&](int f, std::ptrdiff_t row, int number) {
        of_grain(state_bar, u, kState)[number] =
            read([f](const ReplicaArrays& lane) { return lane.grains_in[f]; }, row);
      });
    });
    for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
      for_history(plan.candidate[c].row, [&](int leaf, std::ptrdiff_t row, int q) {
        history_of(c)[q] = read([leaf](const ReplicaArrays& lane) { return lane.history_in[leaf]; }, row);
      });
    const int first = forward.share_begin(plan.candidates);
    std::fill_n(has_bar + first, forward.share_begin(plan.candidates, 1) - first, true);
    if constexpr (Law::kLayered) {
      const LawParameters<V> law(forward.parameter + kLaw, forward.parameter[kDt]);
      for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
        to_layers(history_of(c), forward.mode.segments_of(c), forward.mode.outermost(c, law));
    }
    if (rank == 0) {
      std::memset(domain_bar, 0, sizeof(V) * plan.domains * (kParameters + kLawNumbers));
      std::memset(chunk_bar, 0, sizeof(V) * chunks() * chunk_rows(problem));
    }
    team.barrier();
  }

  // In one history: from the bars of rings to those of the layers and segments that hold the rings after the last step.
  void to_layers(V* history, const StoredSegments<V>& segments, V outer) {
    for (int q = kLayers; q < Law::kHistory; ++q) history[q] = V{};
    for (int part = 0; part < kParts; ++part) {
      const auto at = [&](int q) -> Real& { return reinterpret_cast<Real*>(history + q)[part]; };
      const auto ring = [&](int j, int axis) -> Real& { return at(Law::kHistory + 2 * j + axis); };
      for (int l = 0; l < W; ++l)
        for (int k = 0, j = 0; j < problem.points; ++j) {
          if (k + 1 < segments.count() && segments.get(k + 1).start[l] <= j) ++k;
          for (int axis = 0; axis < 2; ++axis) {
            const double bar = ring(j, axis)[l];
            ring(j, axis)[l] = 0.0;
            if (j < outer[l]) ring(k, axis)[l] += bar, at(kLayers + axis)[l] += bar;
            if (j == outer[l]) at(kLayers + 4 + axis)[l] = bar;
          }
        }
    }
  }

  // From the bars of layers and segments before the first step, when each ring is a segment, to those of the rings, for
  // the history in `row`. `histories` are those between grains or at walls.
  void to_rings(V* history, std::ptrdiff_t row, const double* const (ReplicaArrays::*histories)[kMaxHistory]) {
    const LawParameters<V> law(forward.parameter + kLaw, forward.parameter[kDt]);
    const Place place = place_of<Law>(row, kLastOverlap);
    const V overlap =
        forward.mode.read([&](const ReplicaArrays& lane) { return (lane.*histories)[place.leaf]; }, place.row);
    const V outer = Reach<V, Law::variant>(overlap, law, last_ring).outer;
    const V* layers = history + kLayers;
    V* ring = history + Law::kHistory;
    for (int j = 0; j < problem.points; ++j) {
      const V at = splat<V>(j), weight = splat<V>(j == 0 ? 1.0 - kLacking<Law::variant> : 1.0);
      for (int axis = 0; axis < 2; ++axis) {
        V& bar = ring[2 * j + axis];
        bar = zero_unless(at <= outer, select(at < outer, fma(weight, layers[2 + axis], bar), layers[4 + axis]));
      }
    }
  }

  void unload_bars() {
    for_grains([&](int u) {
      if constexpr (Law::kLayered)
        for_planes(u, [&](int k, int w, const KnownPlanes&) {
          to_rings(bar_at_plane(u, k, w), forward.mode.wall_row(u, kPlanes * k + w), &ReplicaArrays::wall_history_in);
        });
      for_wall_history(u, [&](int leaf, std::ptrdiff_t row, V bar) {
        write([leaf](const ReplicaArrays& lane) { return lane.wall_history_out[leaf]; }, row, bar);
      });
      for_fields(u, [&](int f, std::ptrdiff_t row, int number) {
        write([f](const ReplicaArrays& lane) { return lane.grains_out[f]; }, row,
              of_grain(state_bar, u, kState)[number]);
      });
    });
    if constexpr (Law::kLayered)
      for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
        to_rings(history_of(c), plan.candidate[c].row, &ReplicaArrays::history_in);
    for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
      for_history(plan.candidate[c].row, [&](int leaf, std::ptrdiff_t row, int q) {
        write([leaf](const ReplicaArrays& lane) { return lane.history_out[leaf]; }, row, history_of(c)[q]);
      });
    for (int n = forward.share_begin(plan.padding); n < forward.share_begin(plan.padding, 1); ++n)
      for_history(plan.padding_row[n], [&](int leaf, std::ptrdiff_t row, int) {
        write([leaf](const ReplicaArrays& lane) { return lane.history_out[leaf]; }, row, V{});
      });
    if (rank == 0) unload_parameter_bars();
    team.barrier();
  }

  void unload_parameter_bars() {
    recorded.clear();
    const TapedParameters parameter(forward.parameter);
    LawParameters<Taped> law(parameter.row + kLaw, parameter.row[kDt]);
    GrainParameters<Taped> of_grains(parameter.row);
    const Taped wall_mu = leaf(forward.wall_law.law.mu);
    WallLaw<Taped> of_walls(parameter.row, wall_mu);
    for (int domain = 0; domain < plan.domains; ++domain) {
      const V* bar = of_domain(domain);
      for (Taped number : parameter.row) seed(number, *bar++);
      for_numbers(law, [&](Taped number) { seed(number, *bar++); });
    }
    for (int chunk = 0; chunk < chunks(); ++chunk) {
      const V* bar = of_chunk(chunk);
      for_numbers(of_grains, [&](Taped number) { seed(number, *bar++); });
      bar = of_chunk(chunk) + mass_row(problem);
      seed(parameter.row[kMass], *bar++);
      if (problem.rubs) for_numbers(of_walls, [&](Taped number) { seed(number, *bar++); });
    }
    recorded.reverse({});
    V sum[kRows] = {}, edges[kWalls] = {};
    parameter.add_bars(sum);
    const V mu_bar = problem.rubs ? recorded.bar(wall_mu.slot) : V{};
    if (problem.periodic) add_cell_bars(forward.cell_edges(-1), earlier_bar, edges);
    sum[kWallMu] = mu_bar;
    std::copy_n(edges, 6, sum + kCell);
    for (int r = 0; r < kRows; ++r) write([](const ReplicaArrays& lane) { return lane.parameters_out; }, r, sum[r]);
    for (int row = 0; row < 3 * problem.spheres_per_grain; ++row) {
      V of_offset{};
      for (int chunk = 0; chunk < chunks(); ++chunk) of_offset += of_chunk(chunk)[kGrainNumbers + row];
      write([](const ReplicaArrays& lane) { return lane.offsets_out; }, row, of_offset);
    }
  }

  // Adds the bars of a cell's numbers to those of the walls that it was made of.
  void add_cell_bars(const WallState<V>& box, const V* cell_bar, V* to) {
    recorded.clear();
    const TapedWalls walls(box);
    Cell<Taped> cell = Cell<Taped>::of(problem.periodic, walls.box);
    for_numbers(cell, [&](Taped number) { seed(number, *cell_bar++); });
    recorded.reverse({});
    walls.add_bars(to);
  }

  // --- backwards

  // The second half of a step, of one chunk of grains.
  void end_back(int chunk, int step) {
    const int of_spheres = 3 * problem.spheres_per_grain;
    if (general) std::fill_n(cell_bar_of_chunk(chunk), 2 * kCellNumbers, V{});
    for (int u = chunk * kChunk; u < (chunk + 1) * kChunk && u < problem.grains; ++u) {
      V mid[kMid];
      store_numbers(mid, forward.half_step_of(u));
      std::copy_n(total_of(step, u), 6, mid + kMidForce);
      if (general) {
        const Size size = plan.size ? plan.size[u] : Size{1.0, 1.0, 1.0, 1.0};
        const V power[] = {splat<V>(size.cube), splat<V>(size.inverse_cube), splat<V>(size.inverse_fifth)};
        V nothing[3] = {}, unused[3];
        const bool rubs = problem.rubs && problem.periodic;
        const V* in[] = {mid,          grain_numbers,
                         cell_numbers, forward.parameter + kMass,
                         power,        rubs ? of_grain(forward.rubbed, u, 3) : nothing};
        V* bar[] = {of_grain(mid_bar, u, kMid),          of_chunk(chunk), cell_bar_of_chunk(chunk),
                    of_chunk(chunk) + mass_row(problem), nullptr,         rubs ? of_grain(rubbed_bar, u, 3) : unused};
        V result_bar[kState + 3];
        std::copy_n(of_grain(state_bar, u, kState), kState, result_bar);
        std::copy_n(faces_bar, 3, result_bar + kState);
        if (problem.isotropic) pull_back<StepEnd<true, true>>(in, result_bar, bar);
        else pull_back<StepEnd<false, true>>(in, result_bar, bar);
      } else {
        const V* in[] = {mid, grain_numbers};
        V* bar[] = {of_grain(mid_bar, u, kMid), of_chunk(chunk)};
        if (problem.isotropic) pull_back<StepEnd<true>>(in, of_grain(state_bar, u, kState), bar);
        else pull_back<StepEnd<false>>(in, of_grain(state_bar, u, kState), bar);
      }
      std::fill_n(of_grain(sphere_bar, u, of_spheres), of_spheres, V{});
    }
  }

  // Mindlin's segments of one contact, on the tape: at first those before the step, then those that the law leaves.
  struct Segments {
    int rings;
    std::vector<Segment<Taped>>* now;

    Taped last() const { return splat<Taped>(rings - 2.0); }
    int count() const { return static_cast<int>(now->size()); }
    const Segment<Taped>& get(int k) const { return (*now)[k]; }
    void set(int k, const Segment<Taped>& segment) {
      if (k == count()) now->push_back(segment);
      (*now)[k] = segment;
    }
    void keep(Taped counts) { now->resize(static_cast<std::size_t>(largest(counts))); }
    void remember() const {}
  };

  // The contacts of one domain.
  void contacts_back(int domain, int step) {
    constexpr int kAhead = 4;
    const Trace<V>& seen = trace[step];
    const int first = plan.domain_candidate[domain], end = plan.domain_candidate[domain + 1];
    if (general) std::fill_n(cell_bar_of_domain(domain), kCellNumbers, V{});
    if (first == end) return;
    int c = first;
    for (int n = first; n < seen.end[first]; ++n) {
      for (; c < seen.touching[n]; ++c) forget(c);
      if (n + kAhead < seen.end[first]) ask_for(seen.touching[n + kAhead]);
      const V* history = seen.history + static_cast<std::size_t>(n) * Law::kHistory;
      bool changes = false;
      if constexpr (Law::kLayered) {
        changes = seen.segments[c] >= 0;
        if (changes) rings_back(c, domain, history, seen);
      }
      if (!changes) contact_back(c, domain, history);
      has_bar[c++] = true;
    }
    for (; c < end; ++c) forget(c);
  }

  // Prefetches the numbers of a contact that do not lie next to those of others.
  void ask_for(std::size_t c) const {
    const Candidate& pair = plan.candidate[c];
    const auto ask = [](const V* from, int count) {
      for (int n = 0; n < count; ++n) __builtin_prefetch(from + n);
    };
    const V* mid = of_grain(mid_bar, pair.grain_other, kMid);
    ask(history_of(c), Law::kHistory);
    ask(forward.mode.sphere + 3 * static_cast<std::size_t>(pair.other), 3);
    ask(forward.hot + static_cast<std::size_t>(pair.grain_other) * kHot, kForce);
    ask(sphere_bar + 3 * static_cast<std::size_t>(pair.other), 3);
    ask(mid + kMidPosition, 3), ask(mid + kMidVelocity, 6), ask(mid + kMidForce, 6);
  }

  // A contact apart leaves a blank history, whatever the history was before: all bars become zero.
  void forget(std::size_t c) {
    if (!has_bar[c]) return;
    has_bar[c] = false;
    for (int q = 0; q < remembered(problem); ++q) history_of(c)[q] = V{};
    const int remote = plan.candidate[c].remote_contact;
    if (remote >= 0)
      for (int q = 0; q < kRemote; ++q) of_grain(remote_bar, remote, kRemote)[q] = V{};
  }

  // The input of a contact between the grains themselves, not their images.
  ContactInput<V> input_of(const Candidate& pair) const {
    const auto centre = [&](int i) { return load_vec(forward.mode.sphere + 3 * static_cast<std::size_t>(i)); };
    return forward.mode.contact_input(pair, centre(pair.one), centre(pair.other));
  }

  // The bars of the loads of a contact.
  ContactLoads<V> loads_bar(const Candidate& pair) const {
    const V* one = of_grain(mid_bar, pair.grain_one, kMid);
    const V* other = of_grain(mid_bar, pair.grain_other, kMid);
    return {load_vec(one + kMidForce) - load_vec(other + kMidForce), load_vec(one + kMidTorque),
            load_vec(other + kMidTorque)};
  }

  // The bars of the results of a contact's program.
  void load_result_bars(std::size_t c, V* to) const {
    const ContactLoads<V> loads = loads_bar(plan.candidate[c]);
    store_vec(to, loads.force), store_vec(to + 3, loads.torque_one), store_vec(to + 6, loads.torque_other);
    std::copy_n(history_of(c), Law::kHistory, to + 9);
    std::copy_n(faces_bar + 3, 3, to + 9 + Law::kHistory);  // only general calculations have these
  }

  // The constants of sphere k of grain u; see `SphereConstant`.
  void load_constants(int u, int k, V* to) const {
    const double size = plan.size ? plan.size[u].one : 1.0;
    to[kSize] = splat<V>(size);
    to[kRadius] = splat<V>(plan.radii ? block.pack->radii[k] * size : 1.0);
  }

  // The constants of a contact; see `ContactConstant`.
  void load_constants(std::size_t c, V* to) const {
    const Image image = plan.image ? plan.image_of(c) : Image{0.0, 0.0, 0.0};
    const Radii radii = plan.radii ? plan.radii[c] : Radii{2.0, 0.0, 1.0, 4.0};
    const double constant[kContactConstants] = {image.x, image.y, image.z, radii.reach, radii.lean, radii.root};
    for (int n = 0; n < kContactConstants; ++n) to[n] = splat<V>(constant[n]);
  }

  // Back through the program, from the bars of its results to those of the contact's own numbers and of the parameters.
  void contact_back(std::size_t c, int domain, const ContactInput<V>& input, const V* history, const V* result_bar,
                    V* own_bar) const {
    V own[kNumbers], *const parameter_bar = of_domain(domain);
    store_numbers(own, input);
    std::copy_n(history, Law::kHistory, own + kInputs);
    if (general) {
      V constants[kContactConstants];
      load_constants(c, constants);
      const V* in[] = {own, forward.parameter, law_numbers, &last_ring, cell_numbers, constants};
      V* bar[] = {own_bar, parameter_bar, parameter_bar + kParameters, nullptr, cell_bar_of_domain(domain)};
      pull_back<OneContact<Law, true>>(in, result_bar, bar);
    } else {
      const V* in[] = {own, forward.parameter, law_numbers, &last_ring};
      V* bar[] = {own_bar, parameter_bar, parameter_bar + kParameters};
      pull_back<OneContact<Law>>(in, result_bar, bar);
    }
  }

  void contact_back(std::size_t c, int domain, const V* history) {
    V own_bar[kNumbers], result_bar[kResults];
    load_result_bars(c, result_bar);
    contact_back(c, domain, input_of(plan.candidate[c]), history, result_bar, own_bar);
    std::copy_n(own_bar + kInputs, Law::kHistory, history_of(c));
    share_out(plan.candidate[c], load_numbers<ContactInput<V>>(own_bar));
  }

  // Back through a contact that comes to another of Mindlin's rings in some lanes: by the tape in these lanes, by the
  // program in the others. So the bits of a lane do not depend on the others.
  void rings_back(std::size_t c, int domain, const V* history, const Trace<V>& seen) {
    recorded.clear();
    const TapedParameters parameter(forward.parameter);
    const LawParameters<Taped> law(parameter.row + kLaw, parameter.row[kDt]);
    const int of_cell = recorded.mark().slots;
    const Cell<Taped> taped_cell{leaf(cell.lower), leaf(cell.lengths), leaf(cell.rate)};
    const int first = recorded.mark().slots;
    const Candidate& pair = plan.candidate[c];
    const ContactInput<V> m = input_of(pair);
    ContactInput<Taped> input{leaf(m.separation), leaf(m.lever_one), leaf(m.lever_other),
                              leaf(m.velocity),   leaf(m.spin_one),  leaf(m.spin_other)};
    Taped memory[Law::kHistory + 1];
    for (int q = 0; q < Law::kHistory; ++q) memory[q] = leaf(history[q]);
    const int leaves = recorded.mark().slots, before = seen.segments[c];
    std::vector<Segment<Taped>> now = taped(seen.segment + c * problem.points, before);
    V constants[kContactConstants];
    load_constants(c, constants);
    const Vec<V> image = load_vec(constants + kImage);
    const Vec<Taped> taped_image{constant(image.x), constant(image.y), constant(image.z)};
    if (general) move_to_image(input, taped_image, taped_cell);
    const Unequal<Taped> unequal{constant(constants[kReach]), constant(constants[kLean]), constant(constants[kRoot])};
    Contact<Taped> contact;
    contact.history = memory;
    relative_motion(input, dot(input.separation, input.separation), contact);
    general ? close<true>(&contact, 1, parameter.row, &unequal, [&](int) { return input.spin_other - input.spin_one; })
            : close(&contact, 1, parameter.row);
    rub<Law>(&contact, 1, law, general ? &unequal : nullptr, [&](int) { return Segments{problem.points, &now}; });

    const ContactLoads<Taped> found = push(contact);
    const Vec<Taped> through = through_faces(taped_image, found.force);
    const Bits moves = changes_ring(history[kLastOverlap], contact.overlap.value);
    V own_bar[kNumbers], result_bar[kResults], others[kResults];
    load_result_bars(c, result_bar);
    for (int r = 0; r < kResults; ++r) others[r] = zero_unless(~moves, result_bar[r]);
    contact_back(c, domain, m, history, others, own_bar);

    const auto seed_moving = [moves](Taped a, V bar) { seed(a, zero_unless(moves, bar)); };
    const V* from = result_bar;
    for (Vec<Taped> a : {found.force, found.torque_one, found.torque_other})
      for_numbers(a, [&](Taped number) { seed_moving(number, *from++); });
    for (int q = 0; q < Law::kHistory; ++q) seed_moving(memory[q], *from++);
    for (Taped number : {through.x, through.y, through.z}) seed_moving(number, *from++);
    V* const bar = history_of(c);
    seed_segments(now, bar + Law::kHistory, moves);
    recorded.reverse({});

    parameter.add_bars(of_domain(domain));
    for (int q = 0; general && q < kCellNumbers; ++q) cell_bar_of_domain(domain)[q] += recorded.bar(of_cell + q);
    for (int q = 0; q < kInputs + Law::kHistory; ++q) own_bar[q] = select(moves, recorded.bar(first + q), own_bar[q]);
    std::copy_n(own_bar + kInputs, Law::kHistory, bar);
    take_segments(leaves, before, moves, bar + Law::kHistory);
    share_out(pair, load_numbers<ContactInput<V>>(own_bar));
  }

  // `taped` puts Mindlin's segments on the tape. `seed_segments` sets the bars of those that the law left;
  // `take_segments` reads those of the former ones, whose forces begin in slot `leaves`. Both act in the lanes `moves`.
  static std::vector<Segment<Taped>> taped(const Segment<V>* seen, int count) {
    std::vector<Segment<Taped>> all;
    for (int k = 0; k < count; ++k)
      all.push_back({{leaf(seen[k].force.along), leaf(seen[k].force.across)}, constant(seen[k].start)});
    return all;
  }
  static void seed_segments(const std::vector<Segment<Taped>>& now, const V* bar, Bits moves) {
    for (std::size_t k = 0; k < now.size(); ++k) {
      seed(now[k].force.along, zero_unless(moves, bar[2 * k]));
      seed(now[k].force.across, zero_unless(moves, bar[2 * k + 1]));
    }
  }
  void take_segments(int leaves, int before, Bits moves, V* bar) {
    for (int q = 0; q < 2 * problem.points; ++q)
      bar[q] = select(moves, q < 2 * before ? recorded.bar(leaves + q) : V{}, bar[q]);
  }

  // Whether a contact comes to another ring as its overlap changes from one value to another.
  Bits changes_ring(V from, V to) const {
    const LawParameters<V> law(forward.parameter + kLaw, forward.parameter[kDt]);
    const V before = Reach<V, Law::variant>(from, law, last_ring).outer;
    const V now = Reach<V, Law::variant>(to, law, last_ring).outer;
    return (before < now) | (now < before);
  }

  // Gives the bars of a contact's input to the two grains and spheres from which the input was made.
  void share_out(const Candidate& pair, const ContactInput<V>& bar) {
    const Vec<V> point = splat<V>(0.5) * (bar.lever_one + bar.lever_other);
    const bool away_is_one = pair.away_is_one();
    give(pair, !away_is_one, pair.one, pair.grain_one,
         {point - bar.separation, -bar.lever_one, -bar.velocity, bar.spin_one});
    give(pair, away_is_one, pair.other, pair.grain_other,
         {point + bar.separation, -bar.lever_other, bar.velocity, bar.spin_other});
  }

  struct Given {
    Vec<V> centre, position, velocity, spin;
  };

  void give(const Candidate& pair, bool at_home, int sphere, int grain, const Given& bar) {
    if (at_home || pair.remote < 0) {
      add_vec(sphere_bar + 3 * static_cast<std::size_t>(sphere), bar.centre);
      V* to = of_grain(mid_bar, grain, kMid);
      add_vec(to + kMidPosition, bar.position);
      add_vec(to + kMidVelocity, bar.velocity);
      add_vec(to + kMidSpin, bar.spin);
    } else {
      V* to = of_grain(remote_bar, pair.remote_contact, kRemote);
      store_vec(to + kRemoteCentre, bar.centre);
      store_vec(to + kRemotePosition, bar.position);
      store_vec(to + kRemoteVelocity, bar.velocity);
      store_vec(to + kRemoteSpin, bar.spin);
    }
  }

  // The first half of a step, of one chunk of grains; `on_wall` is the bar of the force on either wall of an axis.
  void begin_back(int chunk, int step, Vec<V> on_wall) {
    const WallState<V> box = without(problem.periodic, forward.walls_at(step));
    V walls[kWalls];
    store_numbers(walls, box);
    V* const of_walls = wall_bar + static_cast<std::size_t>(chunk) * kWalls;
    std::fill_n(of_walls, kWalls, V{});
    const int spheres = problem.spheres_per_grain;
    for (int u = chunk * kChunk; u < (chunk + 1) * kChunk && u < problem.grains; ++u) {
      V* const of_spheres = of_grain(sphere_bar, u, 3 * spheres);
      V* const mid = of_grain(mid_bar, u, kMid);
      take_remotes(u, mid);
      V turned[kTurned], turned_bar[kTurned] = {};
      const HalfStep<V> half = forward.half_step_of(u);
      store_numbers(turned, half);
      store_numbers(turned + kTurnedRotation, matrix(half.orientation));
      std::copy_n(mid, kMidForce, turned_bar);
      for (int k = 0; k < spheres; ++k) {
        V body[3];
        store_vec(body, offset_of(k));
        V constants[kSphereConstants];
        load_constants(u, k, constants);
        const V* in[] = {turned, grain_numbers, body, walls, constants};
        V* bar[] = {turned_bar, of_chunk(chunk), of_chunk(chunk) + kGrainNumbers + 3 * k, of_walls};
        const Vec<V> centre = load_vec(forward.mode.sphere + 3 * (static_cast<std::size_t>(u) * spheres + k));
        if (bits_less(V{}, deepest(constants[kRadius], centre, box))) {
          V result_bar[OneSphere<true>::kResults];
          std::copy_n(of_spheres + 3 * k, 3, result_bar);
          std::copy_n(mid + kMidForce, 6, result_bar + 3);
          store_vec(result_bar + 9, on_wall), store_vec(result_bar + 12, on_wall);
          plan.radii ? pull_back<OneSphere<true, true>>(in, result_bar, bar)
                     : pull_back<OneSphere<true>>(in, result_bar, bar);
        } else {
          plan.radii ? pull_back<OneSphere<false, true>>(in, of_spheres + 3 * k, bar)
                     : pull_back<OneSphere<false>>(in, of_spheres + 3 * k, bar);
        }
      }
      friction_back(step, u, chunk, turned, walls, turned_bar, of_walls);
      V* const of_cell = general ? cell_bar_of_chunk(chunk) : nullptr;
      const V* in[] = {state_of(step, u), grain_numbers, before_numbers, cell_numbers};
      V* bar[] = {of_grain(state_bar, u, kState), of_chunk(chunk), of_cell + kCellNumbers, of_cell};
      general ? pull_back<StepBegin<true>>(in, turned_bar, bar) : pull_back<StepBegin<>>(in, turned_bar, bar);
    }
  }

  // Back through friction of the walls on grain u. The forward steps know the planes that it touched in this step.
  void friction_back(int step, int u, int chunk, const V* turned, const V* walls, V* turned_bar, V* of_walls) {
    for_planes(u, [&](int k, int w, const KnownPlanes& known) {
      V* const history_bar = bar_at_plane(u, k, w);
      if (!(known.now >> w & 1)) return void(std::fill_n(history_bar, remembered(problem), V{}));
      V body[3], history[Law::kHistory + 1] = {}, result_bar[OnePlane<Law>::kResults], constants[kPlaneConstants];
      store_vec(body, offset_of(k));
      if (planes_of(step, u, k) >> w & 1) std::copy_n(at_plane(wall_history_at(step), u, k, w), Law::kHistory, history);
      std::copy_n(of_grain(mid_bar, u, kMid) + kMidForce, 6, result_bar);
      if (problem.periodic) add_vec(result_bar, load_vec(of_grain(rubbed_bar, u, 3)));
      std::copy_n(history_bar, Law::kHistory, result_bar + 6);
      load_constants(u, k, constants);
      store_vec(constants + kNormal, normal_of_plane<V>(w));
      V* const of = of_chunk(chunk);
      const V* in[] = {turned, grain_numbers, body, walls + w, constants, history, wall_law_numbers, &last_ring};
      V* bar[] = {turned_bar, of,          of + kGrainNumbers + 3 * k, of_walls + w,
                  nullptr,    history_bar, of + mass_row(problem) + 1};
      if constexpr (Law::kLayered) {
        const std::size_t row = plane_row(u, k, w);
        const int before = wall_trace[step].segments[row];
        if (before >= 0)
          return plane_rings_back(in, result_bar, bar, wall_trace[step].segment + row * problem.points, before);
      }
      pull_back<OnePlane<Law>>(in, result_bar, bar);
    });
  }

  // `rings_back` of a sphere at a plane; arguments as of `pull_back`.
  void plane_rings_back(const V* const* in, const V* result_bar, V* const* bar, const Segment<V>* seen, int before) {
    recorded.clear();
    const int first = recorded.mark().slots;
    const auto leaves_of = [](auto numbers, const V* from) {
      for_numbers(numbers, [&](Taped& number) { number = leaf(*from++); });
      return numbers;
    };
    const auto half = leaves_of(HalfStep<Taped>{}, in[0]);
    const auto rotation = leaves_of(Matrix<Taped>{}, in[0] + kTurnedRotation);
    const auto parameters = leaves_of(GrainParameters<Taped>{}, in[1]);
    const auto body = leaves_of(Vec<Taped>{}, in[2]);
    const Taped at = leaf(in[3][0]), moves_at = leaf(in[3][kPlanes]);
    const auto walls = leaves_of(WallLaw<Taped>{}, in[6]);
    const Taped size = constant(in[4][kSize]), radius = constant(in[4][kRadius]);
    const Vec<V> along = load_vec(in[4] + kNormal);
    const Vec<Taped> normal{constant(along.x), constant(along.y), constant(along.z)};
    const int own = recorded.mark().slots;
    Taped memory[Law::kHistory + 1];
    for (int q = 0; q < Law::kHistory; ++q) memory[q] = leaf(in[5][q]);
    const int leaves = recorded.mark().slots;
    std::vector<Segment<Taped>> now = taped(seen, before);
    Contact<Taped> contact;
    const auto on = rub_plane<Law>(
        half, rotation, size * body, radius, root(radius) * parameters.wall_stiffness, parameters.normal_damping, at,
        moves_at, normal, walls, memory, [&](int) { return Segments{problem.points, &now}; }, contact);
    const Bits moves = changes_ring(in[5][kLastOverlap], contact.overlap.value);
    V others[OnePlane<Law>::kResults], *const of_segments = bar[5] + Law::kHistory;
    for (int r = 0; r < OnePlane<Law>::kResults; ++r) others[r] = zero_unless(~moves, result_bar[r]);
    pull_back<OnePlane<Law>>(in, others, bar);

    const V* from = result_bar;
    for (Vec<Taped> a : {on.force, on.torque})
      for_numbers(a, [&](Taped number) { seed(number, zero_unless(moves, *from++)); });
    for (int q = 0; q < Law::kHistory; ++q) seed(memory[q], zero_unless(moves, *from++));
    seed_segments(now, of_segments, moves);
    recorded.reverse({});
    int slot = first;
    const auto add_bars = [&](V* to, int count) {
      for (int q = 0; q < count; ++q) to[q] += recorded.bar(slot++);
    };
    add_bars(bar[0], kTurned), add_bars(bar[1], kGrainNumbers), add_bars(bar[2], 3);
    add_bars(bar[3], 1), add_bars(bar[3] + kPlanes, 1), add_bars(bar[6], kWallLawNumbers);
    for (int q = 0; q < Law::kHistory; ++q) bar[5][q] = select(moves, recorded.bar(own + q), bar[5][q]);
    take_segments(leaves, before, moves, of_segments);
  }

  void take_remotes(int u, V* bar) {
    for (int n = plan.remote_contact_start[u]; n < plan.remote_contact_start[u + 1]; ++n) {
      const V* from = of_grain(remote_bar, n, kRemote);
      add_vec(sphere_bar + 3 * static_cast<std::size_t>(plan.remote_contact_sphere[n]), load_vec(from + kRemoteCentre));
      add_vec(bar + kMidPosition, load_vec(from + kRemotePosition));
      add_vec(bar + kMidVelocity, load_vec(from + kRemoteVelocity));
      add_vec(bar + kMidSpin, load_vec(from + kRemoteSpin));
    }
  }

  void step_back(int step, Vec<V> pressure_bar) {
    if (general || step + 1 < steps) {  // otherwise the way forward ended midway in the last one
      for_grains([&](int u) { bring_back(step, u); });
      team.barrier();
      trace_walls(step);
      forward.grains(false, true, step);
    }
    V by_walls[kWalls] = {};
    const Vec<V> on_wall = pressure_back(step, pressure_bar, by_walls);
    for_chunks([&](int chunk) { end_back(chunk, step); });
    team.share(Team::kContacts, rank, plan.domains);
    for (int domain; team.take(Team::kContacts, rank, &domain);) contacts_back(domain, step);
    team.barrier();
    for_chunks([&](int chunk) { begin_back(chunk, step, on_wall); });
    if (general && rank == 0) cell_back(step, by_walls);
    for (int row = 0; rank == 0 && row < kWalls; ++row) {
      for (int chunk = 0; chunk < chunks(); ++chunk) by_walls[row] += wall_bar[chunk * kWalls + row];
      write([](const ReplicaArrays& lane) { return lane.walls_out; }, static_cast<std::ptrdiff_t>(step) * kWalls + row,
            by_walls[row]);
    }
  }

  // Back through the pressures of a step. Returns the bar of the force on either wall of an axis, sets those of
  // `faces`, and adds those of the walls to `by_walls`.
  Vec<V> pressure_back(int step, Vec<V> pressure_bar, V* by_walls) {
    recorded.clear();
    const TapedWalls walls(forward.walls_at(step));
    const int first = recorded.mark().slots;
    const Vec<Taped> force = leaf(forward.mode.sum_walls(forward.walls, chunks()));
    seed(pressure(walls.box, force), pressure_bar);
    if (general) {
      cell = forward.cell_at(step);
      store_numbers(cell_numbers, cell);
      store_numbers(before_numbers, forward.cell_at(step - 1));
    }
    const int on_faces = recorded.mark().slots;
    if (problem.periodic) {
      const Vec<Taped> sections = leaf(load_vec(faces + 6 * step)), through = leaf(load_vec(faces + 6 * step + 3));
      const Cell<Taped> taped_cell = Cell<Taped>::of(problem.periodic, walls.box);
      seed(section_pressure(problem.periodic, walls.box, taped_cell, sections, through), pressure_bar);
    }
    recorded.reverse({});
    for (int row = 0; row < 6; ++row) faces_bar[row] = problem.periodic ? recorded.bar(on_faces + row) : V{};
    walls.add_bars(by_walls);
    return load_vec(&recorded.bar(first));
  }

  // Sums up the bars of the cell of a step over domains and chunks, and adds those of its walls to `by_walls`.
  void cell_back(int step, V* by_walls) {
    V bar[kCellNumbers];
    std::copy_n(earlier_bar, kCellNumbers, bar);
    std::fill_n(earlier_bar, kCellNumbers, V{});
    for (int q = 0; q < kCellNumbers; ++q) {
      for (int domain = 0; domain < plan.domains; ++domain) bar[q] += cell_bar_of_domain(domain)[q];
      for (int chunk = 0; chunk < chunks(); ++chunk) {
        bar[q] += cell_bar_of_chunk(chunk)[q];
        earlier_bar[q] += cell_bar_of_chunk(chunk)[kCellNumbers + q];
      }
    }
    add_cell_bars(forward.cell_edges(step), bar, by_walls);
  }

  void run() {
    const Recording recording(&recorded);
    go_forward();
    load_bars();
    V pressure_bar[3];
    for (int axis = 0; axis < 3; ++axis)
      pressure_bar[axis] = read([](const ReplicaArrays& lane) { return lane.pressure; }, axis);
    for (int step = steps - 1; step >= 0; --step) step_back(step, load_vec(pressure_bar));
    unload_bars();
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
