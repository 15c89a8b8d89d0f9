// Reverse mode: all steps of one block gone through forwards, then backwards. The physics is that of the other headers,
// read with numbers that are recorded on a tape (`Taped`); here stands only who gets which derivative.
// "Bar" x is the derivative of the final result by x.
//
// Grains and contacts are shared among the threads of a team as in the forward steps, and sums are taken in the same
// fixed order.

#pragma once

#include <cstddef>
#include <cstring>
#include <vector>

#include "cpu/replicas.h"
#include "numbers/tape.h"

namespace gmem {
namespace GMEM_ISA {

// Rows of what is kept, and of the bars, of one grain: at the beginning of a step, the fields in order ...
enum StateRow { kStatePosition = 0, kStateQuaternion = 3, kStateVelocity = 7, kStateSpin = 10, kStateAcceleration = 13,
                kStateSpinRate = 16, kState = 19 };
// ... and midway, with the force and torque found there.
enum MidRow { kMidPosition = 0, kMidQuaternion = 3, kMidVelocity = 7, kMidSpin = 10, kMidHalfVelocity = 13,
              kMidHalfSpin = 16, kMidForce = 19, kMidTorque = 22, kMid = 25 };
// What a contact adds to the bars of a grain of another domain.
enum RemoteRow { kRemoteCentre = 0, kRemotePosition = 3, kRemoteVelocity = 6, kRemoteSpin = 9, kRemote = 12 };

inline void add_vec(Real* to, Vec<Real> a) { store_vec(to, load_vec(to) + a); }

inline Quaternion<Taped> leaf(Quaternion<Real> q) { return {leaf(q.w), leaf(q.v)}; }
inline Vec<Real> bars(int slot) { return load_vec(&tape->bar(slot)); }
inline void seed(Taped a, Real bar) {
  if (a.slot) tape->bar(a.slot) += bar;
}
inline void seed(Vec<Taped> a, Vec<Real> bar) { seed(a.x, bar.x), seed(a.y, bar.y), seed(a.z, bar.z); }

struct TapedWalls {
  int first;
  WallState<Taped> box;

  explicit TapedWalls(const WallState<Real>& w)
      : first(tape->mark().slots), box{leaf(w.lower), leaf(w.upper), leaf(w.lower_velocity), leaf(w.upper_velocity)} {}

  void add_bars(Real* to) const {
    for (int row = 0; row < kWalls; ++row) to[row] += tape->bar(first + row);
  }
};

struct TapedParameters {
  int first;
  Taped row[kParameters];

  explicit TapedParameters(const Real* parameter) : first(tape->mark().slots) {
    for (int r = 0; r < kParameters; ++r) row[r] = leaf(parameter[r]);
  }

  void add_bars(Real* to) const {
    for (int r = 0; r < kParameters; ++r) to[r] += tape->bar(first + r);
  }
};

// The memory of an `Adjoint`. What is kept of every step is given room for all candidates; memory that contacts apart
// leave untouched is not used.
template <class Law>
struct AdjointLayout {
  using V = Real;

  EngineLayout<Replicas<Law, Real>> of_forward;
  V* state;         // [steps, N, kState]: at the beginning of each step
  V* total;         // [steps, N, 6]: force and torque in it
  Trace<V>* trace;  // [steps]
  V* state_bar;     // [N, kState]
  V* mid_bar;       // [N, kMid]
  V* sphere_bar;    // [S, 3]
  V* remote_bar;    // [remotes, kRemote]
  V* history_bar;   // [candidates, kHistory and the forces of Mindlin's segments, 2 Q]
  V* domain_bar;    // [domains, kParameters]
  V* chunk_bar;     // [chunks, kParameters]
  V* wall_bar;      // [chunks, kWalls], of one step

  // Numbers in the history of a contact.
  static int remembered(const Problem& p) { return Law::kHistory + (Law::kLayered ? 2 * p.points : 0); }

  // With `fills` the traces of the steps are written down too: one thread does it, the others see it after a barrier.
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
      t.touched = arena.take<bool>(candidates + 1);
      t.history = arena.take<V>(candidates * Law::kHistory);
      t.segment = arena.take<Segment<V>>(layered * p.points);
      t.segments = arena.take<int>(layered);
      if (fills) trace[step] = t;
    }
    state_bar = arena.take<V>(grains * kState);
    mid_bar = arena.take<V>(grains * kMid);
    sphere_bar = arena.take<V>(static_cast<std::size_t>(p.spheres()) * 3);
    remote_bar = arena.take<V>(static_cast<std::size_t>(plan.remotes) * kRemote);
    history_bar = arena.take<V>(candidates * remembered(p));
    domain_bar = arena.take<V>(static_cast<std::size_t>(plan.domains) * kParameters);
    chunk_bar = arena.take<V>(chunks * kParameters);
    wall_bar = arena.take<V>(chunks * kWalls);
  }
};

template <class Law>
struct Adjoint : AdjointLayout<Law> {
  using Layout = AdjointLayout<Law>;
  using Layout::state, Layout::total, Layout::trace, Layout::state_bar, Layout::mid_bar, Layout::sphere_bar;
  using Layout::remote_bar, Layout::history_bar, Layout::domain_bar, Layout::chunk_bar, Layout::wall_bar;
  using Layout::remembered;
  using V = Real;
  using Forward = Engine<Replicas<Law, Real>>;

  Forward forward;
  const Problem& problem;
  const Block& block;
  const Plan& plan;
  Team& team;
  const int rank, steps;
  Tape recorded;

  Adjoint(const Problem& problem, const Block& block, Team& team, int rank, void* scratch)
      : forward(problem, block, team, rank, scratch), problem(problem), block(block), plan(*block.pack->plan), team(team),
        rank(rank), steps(block.lanes[0].steps) {
    Arena arena{static_cast<char*>(scratch)};
    this->place(problem, block, arena, rank == 0);  // `forward` has found the same at the beginning
    forward.mode.apart = true;
  }

  V* history_of(std::size_t c) const { return history_bar + c * remembered(problem); }

  int chunks() const { return gmem::GMEM_ISA::chunks(problem); }
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

  static Grain<V> grain_of(const V* s) {
    return {load_vec(s + kStatePosition), {s[kStateQuaternion], load_vec(s + kStateQuaternion + 1)},
            load_vec(s + kStateVelocity), load_vec(s + kStateSpin),
            load_vec(s + kStateAcceleration), load_vec(s + kStateSpinRate)};
  }

  // Between the rows of a state and where the forward steps keep them.
  template <class Move>
  void move_state(int u, V* s, const Move& move) const {
    for (int f = 0; f < kFields; ++f)
      for (int q = 0; q < kField[f].size; ++q) move(*s++, field_at(f, u, forward.hot, forward.cold)[q]);
  }

  V* state_of(int step, int u) const { return of_grain(state + static_cast<std::size_t>(step) * problem.grains * kState, u, kState); }
  V* total_of(int step, int u) const { return of_grain(total + static_cast<std::size_t>(step) * problem.grains * 6, u, 6); }

  // --- forwards

  void go_forward() {
    forward.load();
    for (int step = 0; step < steps; ++step) {
      for_grains([&](int u) { move_state(u, state_of(step, u), [](V& kept, V now) { kept = now; }); });
      for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
        trace[step].touched[c] = false;
      team.barrier();
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
      forward.grains(true, false, 0);
    }
  }

  // --- bars in and out

  template <class Pointer>
  void write(const Pointer& pointer, std::ptrdiff_t row, V a) const {
    for (int l = 0; l < block.count; ++l) pointer(block.slopes[l])[row * problem.stride] = a[l];
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

  void load_bars() {
    for_grains([&](int u) {
      for_fields(u, [&](int f, std::ptrdiff_t row, int number) {
        of_grain(state_bar, u, kState)[number] =
            forward.mode.gather(block.slopes, [f](const Lane& lane) { return lane.grains_in[f]; }, row);
      });
    });
    for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
      for_history(plan.candidate[c].row, [&](int leaf, std::ptrdiff_t row, int q) {
        history_of(c)[q] = forward.mode.gather(block.slopes, [leaf](const Lane& lane) { return lane.history_in[leaf]; }, row);
      });
    if constexpr (Law::kLayered)
      for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c) to_layers(c);
    if (rank == 0) {
      std::memset(domain_bar, 0, sizeof(V) * plan.domains * kParameters);
      std::memset(chunk_bar, 0, sizeof(V) * chunks() * kParameters);
    }
    team.barrier();
  }

  // From the bars of rings to those of the layers and segments that they are in at the end.
  void to_layers(std::size_t c) {
    const StoredSegments<V> segments = forward.mode.segments_of(c);
    const LawParameters<V> law(forward.parameter + kLaw, forward.parameter[kDt]);
    const V outer = forward.mode.outermost(c, law);
    V *layers = history_of(c) + kLayers, *ring = history_of(c) + Law::kHistory;
    for (int q = kLayers; q < Law::kHistory; ++q) history_of(c)[q] = V{};
    for (int l = 0; l < W; ++l)
      for (int k = 0, j = 0; j < problem.points; ++j) {
        if (k + 1 < segments.count() && segments.get(k + 1).start[l] <= j) ++k;
        for (int axis = 0; axis < 2; ++axis) {
          const double bar = ring[2 * j + axis][l];
          ring[2 * j + axis][l] = 0.0;
          if (j < outer[l]) ring[2 * k + axis][l] += bar, layers[axis][l] += bar;
          if (j == outer[l]) layers[4 + axis][l] = bar;
        }
      }
  }

  // From the bars of layers and segments at the beginning, when each ring is a segment, to those of the rings.
  void to_rings(std::size_t c) {
    const LawParameters<V> law(forward.parameter + kLaw, forward.parameter[kDt]);
    const Place place = place_of<Law>(plan.candidate[c].row, kLastOverlap);
    const V overlap = forward.mode.read([place](const Lane& lane) { return lane.history_in[place.leaf]; }, place.row);
    const V outer = Reach<V, Law::variant>(overlap, law, problem.points).outer;
    const V *layers = history_of(c) + kLayers;
    V* ring = history_of(c) + Law::kHistory;
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
      for_fields(u, [&](int f, std::ptrdiff_t row, int number) {
        write([f](const Lane& lane) { return lane.grains_out[f]; }, row, of_grain(state_bar, u, kState)[number]);
      });
    });
    if constexpr (Law::kLayered)
      for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c) to_rings(c);
    for (int c = forward.share_begin(plan.candidates); c < forward.share_begin(plan.candidates, 1); ++c)
      for_history(plan.candidate[c].row, [&](int leaf, std::ptrdiff_t row, int q) {
        write([leaf](const Lane& lane) { return lane.history_out[leaf]; }, row, history_of(c)[q]);
      });
    for (int n = forward.share_begin(plan.padding); n < forward.share_begin(plan.padding, 1); ++n)
      for_history(plan.padding_row[n], [&](int leaf, std::ptrdiff_t row, int) {
        write([leaf](const Lane& lane) { return lane.history_out[leaf]; }, row, V{});
      });
    for (int r = 0; rank == 0 && r < kParameters; ++r) {
      V sum{};
      for (int domain = 0; domain < plan.domains; ++domain) sum += domain_bar[domain * kParameters + r];
      for (int chunk = 0; chunk < chunks(); ++chunk) sum += chunk_bar[chunk * kParameters + r];
      write([](const Lane& lane) { return lane.parameters_out; }, r, sum);
    }
    team.barrier();
  }

  // --- backwards

  // The second half of a step, of one chunk of grains.
  void end_back(int chunk, int step) {
    recorded.clear();
    const TapedParameters parameter(forward.parameter);
    const GrainParameters<Taped> constants(parameter.row);
    const auto mark = recorded.mark();
    for (int u = chunk * kChunk; u < (chunk + 1) * kChunk && u < problem.grains; ++u) {
      const HalfStep<V> m = forward.half_step_of(u);
      const V* before = total_of(step, u);
      const int first = recorded.mark().slots;
      const HalfStep<Taped> half{leaf(m.position), leaf(m.orientation), leaf(m.velocity),
                                 leaf(m.spin), leaf(m.half_velocity), leaf(m.half_spin)};
      const Vec<Taped> force = leaf(load_vec(before)), torque = leaf(load_vec(before + 3));
      const Grain<Taped> g = end_step(constants, problem.isotropic, half, force, torque);
      const Grain<V> bar = grain_of(of_grain(state_bar, u, kState));
      seed(g.position, bar.position);
      seed(g.orientation.w, bar.orientation.w);
      seed(g.orientation.v, bar.orientation.v);
      seed(g.velocity, bar.velocity);
      seed(g.spin, bar.spin);
      seed(g.acceleration, bar.acceleration);
      seed(g.spin_rate, bar.spin_rate);
      recorded.reverse(mark);
      for (int q = 0; q < kMid; ++q) of_grain(mid_bar, u, kMid)[q] = recorded.bar(first + q);
      for (int q = 0; q < 3 * problem.spheres_per_grain; ++q)
        of_grain(sphere_bar, u, 3 * problem.spheres_per_grain)[q] = V{};
      recorded.rewind(mark);
    }
    recorded.reverse({});
    parameter.add_bars(chunk_bar + static_cast<std::size_t>(chunk) * kParameters);
  }

  // Mindlin's segments of one contact, on the tape: as they were, then as the law left them.
  struct Segments {
    int rings;
    std::vector<Segment<Taped>>* now;

    int points() const { return rings; }
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
    recorded.clear();
    const TapedParameters parameter(forward.parameter);
    const LawParameters<Taped> law(parameter.row + kLaw, parameter.row[kDt]);
    const auto mark = recorded.mark();
    for (int c = plan.domain_candidate[domain]; c < plan.domain_candidate[domain + 1]; ++c) {
      if (!trace[step].touched[c]) {
        forget(c);
        continue;
      }
      contact_back(c, parameter.row, law, trace[step]);
      recorded.rewind(mark);
    }
    recorded.reverse({});
    parameter.add_bars(domain_bar + static_cast<std::size_t>(domain) * kParameters);
  }

  // A contact apart has a blank history, whatever it was before.
  void forget(std::size_t c) {
    for (int q = 0; q < remembered(problem); ++q) history_of(c)[q] = V{};
    const int remote = plan.candidate[c].remote;
    if (remote >= 0)
      for (int q = 0; q < kRemote; ++q) of_grain(remote_bar, remote, kRemote)[q] = V{};
  }

  void contact_back(std::size_t c, const Taped* parameter, const LawParameters<Taped>& law, const Trace<V>& seen) {
    constexpr int kInputs = 18;
    const auto mark = recorded.mark();
    const Candidate& pair = plan.candidate[c];
    const auto centre = [&](int i) { return load_vec(forward.mode.sphere + 3 * static_cast<std::size_t>(i)); };
    const ContactInput<V> m = forward.mode.contact_input(pair, centre(pair.one), centre(pair.other));
    const ContactInput<Taped> input{leaf(m.separation), leaf(m.lever_one), leaf(m.lever_other),
                                    leaf(m.velocity),   leaf(m.spin_one),  leaf(m.spin_other)};
    Taped memory[Law::kHistory + 1];
    for (int q = 0; q < Law::kHistory; ++q) memory[q] = leaf(seen.history[c * Law::kHistory + q]);
    Contact<Taped> contact;
    contact.history = memory;
    relative_motion(input, dot(input.separation, input.separation), contact);
    close(&contact, 1, parameter);
    std::vector<Segment<Taped>> now;
    const int leaves = recorded.mark().slots, before = Law::kLayered ? seen.segments[c] : -1;
    for (int k = 0; k < before; ++k) {
      const Segment<V>& segment = seen.segment[c * problem.points + k];
      now.push_back({{leaf(segment.force.along), leaf(segment.force.across)}, constant(segment.start)});
    }
    if constexpr (Law::kLayered) {
      friction(Law{}, &contact, 1, law, [&](int) { return Segments{problem.points, &now}; });
    } else {
      friction(Law{}, &contact, 1, law);
    }

    const ContactLoads<Taped> found = push(contact);
    const V* one = of_grain(mid_bar, pair.grain_one, kMid);
    const V* other = of_grain(mid_bar, pair.grain_other, kMid);
    V* bar = history_of(c);
    seed(found.force, load_vec(one + kMidForce) - load_vec(other + kMidForce));
    seed(found.torque_one, load_vec(one + kMidTorque));
    seed(found.torque_other, load_vec(other + kMidTorque));
    for (int q = 0; q < Law::kHistory; ++q) seed(memory[q], bar[q]);
    V* of_segments = bar + Law::kHistory;
    for (std::size_t k = 0; k < now.size(); ++k)
      seed(now[k].force.along, of_segments[2 * k]), seed(now[k].force.across, of_segments[2 * k + 1]);
    recorded.reverse(mark);

    for (int q = 0; q < Law::kHistory; ++q) bar[q] = recorded.bar(mark.slots + kInputs + q);
    for (int q = 0; before >= 0 && q < 2 * problem.points; ++q) of_segments[q] = q < 2 * before ? recorded.bar(leaves + q) : V{};
    share_out(pair, mark.slots);
  }

  // The bars of a contact's input go to the two grains and spheres it was made from.
  void share_out(const Candidate& pair, int first) {
    const Vec<V> separation = bars(first), lever_one = bars(first + 3), lever_other = bars(first + 6);
    const Vec<V> velocity = bars(first + 9), spin_one = bars(first + 12), spin_other = bars(first + 15);
    const Vec<V> point = splat<V>(0.5) * (lever_one + lever_other);
    const bool away_is_one = pair.away_is_one();
    give(pair, !away_is_one, pair.one, pair.grain_one, {point - separation, -lever_one, -velocity, spin_one});
    give(pair, away_is_one, pair.other, pair.grain_other, {point + separation, -lever_other, velocity, spin_other});
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
      V* to = of_grain(remote_bar, pair.remote, kRemote);
      store_vec(to + kRemoteCentre, bar.centre);
      store_vec(to + kRemotePosition, bar.position);
      store_vec(to + kRemoteVelocity, bar.velocity);
      store_vec(to + kRemoteSpin, bar.spin);
    }
  }

  // The first half of a step, of one chunk of grains; `on_wall` is the bar of the force on either wall of an axis.
  void begin_back(int chunk, int step, Vec<V> on_wall) {
    recorded.clear();
    const TapedParameters parameter(forward.parameter);
    const GrainParameters<Taped> constants(parameter.row);
    const TapedWalls walls(forward.walls_at(step));
    const auto mark = recorded.mark();
    const int spheres = problem.spheres_per_grain;
    for (int u = chunk * kChunk; u < (chunk + 1) * kChunk && u < problem.grains; ++u) {
      const V* s = state_of(step, u);
      const Grain<V> g = grain_of(s);
      const int first = recorded.mark().slots;
      const Grain<Taped> grain{leaf(g.position), leaf(g.orientation), leaf(g.velocity),
                               leaf(g.spin), leaf(g.acceleration), leaf(g.spin_rate)};
      const HalfStep<Taped> m = begin_step(constants, grain);
      WallForces<Taped> on{};
      V* of_spheres = of_grain(sphere_bar, u, 3 * spheres);
      V* bar = of_grain(mid_bar, u, kMid);
      take_remotes(u, bar);
      spheres_of(constants, m, block.pack->offsets, spheres, forward.arm, walls.box, on,
                 [&](int k, Vec<Taped> centre) { seed(centre, load_vec(of_spheres + 3 * k)); });
      seed(on.force, load_vec(bar + kMidForce));
      seed(on.torque, load_vec(bar + kMidTorque));
      seed(on.lower, on_wall);
      seed(on.upper, on_wall);
      seed(m.position, load_vec(bar + kMidPosition));
      seed(m.orientation.w, bar[kMidQuaternion]);
      seed(m.orientation.v, load_vec(bar + kMidQuaternion + 1));
      seed(m.velocity, load_vec(bar + kMidVelocity));
      seed(m.spin, load_vec(bar + kMidSpin));
      seed(m.half_velocity, load_vec(bar + kMidHalfVelocity));
      seed(m.half_spin, load_vec(bar + kMidHalfSpin));
      recorded.reverse(mark);
      for (int q = 0; q < kState; ++q) of_grain(state_bar, u, kState)[q] = recorded.bar(first + q);
      recorded.rewind(mark);
    }
    recorded.reverse({});
    parameter.add_bars(chunk_bar + static_cast<std::size_t>(chunk) * kParameters);
    V* to = wall_bar + static_cast<std::size_t>(chunk) * kWalls;
    for (int row = 0; row < kWalls; ++row) to[row] = V{};
    walls.add_bars(to);
  }

  void take_remotes(int u, V* bar) {
    for (int n = plan.remote_start[u]; n < plan.remote_start[u + 1]; ++n) {
      const V* from = of_grain(remote_bar, n, kRemote);
      add_vec(sphere_bar + 3 * static_cast<std::size_t>(plan.remote_sphere[n]), load_vec(from + kRemoteCentre));
      add_vec(bar + kMidPosition, load_vec(from + kRemotePosition));
      add_vec(bar + kMidVelocity, load_vec(from + kRemoteVelocity));
      add_vec(bar + kMidSpin, load_vec(from + kRemoteSpin));
    }
  }

  void step_back(int step, Vec<V> pressure_bar) {
    for_grains([&](int u) { move_state(u, state_of(step, u), [](V kept, V& now) { now = kept; }); });
    team.barrier();
    forward.grains(false, true, step);
    for_chunks([&](int chunk) { end_back(chunk, step); });
    team.share(Team::kContacts, rank, plan.domains);
    for (int domain; team.take(Team::kContacts, rank, &domain);) contacts_back(domain, step);
    team.barrier();

    recorded.clear();
    const TapedWalls walls(forward.walls_at(step));
    const int first = recorded.mark().slots;
    const Vec<Taped> force = leaf(forward.mode.sum_walls(forward.walls, chunks()));
    seed(pressure(walls.box, force), pressure_bar);
    recorded.reverse({});
    const Vec<V> on_wall = bars(first);
    V by_walls[kWalls] = {};
    walls.add_bars(by_walls);
    for_chunks([&](int chunk) { begin_back(chunk, step, on_wall); });
    for (int row = 0; rank == 0 && row < kWalls; ++row) {
      for (int chunk = 0; chunk < chunks(); ++chunk) by_walls[row] += wall_bar[chunk * kWalls + row];
      write([](const Lane& lane) { return lane.walls_out; }, static_cast<std::ptrdiff_t>(step) * kWalls + row, by_walls[row]);
    }
  }

  void run() {
    const Recording recording(&recorded);
    go_forward();
    load_bars();
    V pressure_bar[3];
    for (int axis = 0; axis < 3; ++axis)
      pressure_bar[axis] = forward.mode.gather(block.slopes, [](const Lane& lane) { return lane.pressure; }, axis);
    for (int step = steps - 1; step >= 0; --step) step_back(step, load_vec(pressure_bar));
    unload_bars();
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
