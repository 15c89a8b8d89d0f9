// What is stored of Mindlin's f. All attached rings are changed alike in every step, so that rings which were attached
// in the same step share their f for ever: kept are runs of equal rings. (A contact of the shipped packs has 37 rings
// in 2 runs at rest, and 52 in 22 where it is compressed.)

#pragma once

#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

// Every lane has its own runs: number k of one may begin elsewhere than number k of another.
template <class V>
struct Run {
  Vec<V> force;  // f
  V start;       // its first ring; it ends where the next one begins
};

// Where a run begins that a lane does not have: beyond all rings.
constexpr double kNowhere = 1e9;

template <class V>
inline Run<V> no_run() { return {Vec<V>{}, splat<V>(kNowhere)}; }

template <class V>
inline void copy_lane(Run<V>& to, int l, const Run<V>& from) {
  copy_lane(to.force.x, l, from.force.x);
  copy_lane(to.force.y, l, from.force.y);
  copy_lane(to.force.z, l, from.force.z);
  copy_lane(to.start, l, from.start);
}

// The runs of a contact that reaches to ring `outer` where it reached to `before` (-1: to none): rings that it left are
// forgotten, new ones begin with nothing. The outermost ring, whose f may change while it fills, is a run of its own.
template <class V, class Runs>
void reattach(Runs& runs, V before, V outer) {
  const V one = splat<V>(1.0), nowhere = splat<V>(kNowhere);
  const Mask<V> left = outer < before;
  V previous = -one, count{};
  Vec<V> force{};
  const int stored = runs.count();
  for (int k = 0; k < stored + 2; ++k) {
    const Run<V> run = k < stored ? runs.get(k) : no_run<V>();
    const Mask<V> stays = run.start <= outer, begins = (outer < run.start) & (previous < outer);
    if (!bits(stays | begins)) break;
    // First the new rings that are full, then the outermost.
    const V start = select((previous <= before) & (before + one < outer), before + one, outer);
    force = zero_unless(stays | (begins & left), select(stays, run.force, force));
    previous = select(stays, run.start, select(begins, start, nowhere));
    count = count + zero_unless(stays | begins, one);
    runs.set(k, {force, previous});
  }
  runs.keep(count);
}

// Runs that lie `stride` apart.
template <class V>
struct StoredRuns {
  Run<V>* first;
  long long stride;
  int* stored;  // in the lane that has most
  int rings;

  int points() const { return rings; }
  int count() const { return *stored; }
  const Run<V>& get(int k) const { return first[k * stride]; }
  void set(int k, const Run<V>& run) { first[k * stride] = run; }
  void keep(V counts) { *stored = static_cast<int>(largest(counts)); }

  // From rings, of which `ring(j)` reads one. With `apart` each is a run of its own, whatever it holds.
  template <class Ring>
  void load(V outer, bool apart, const Ring& ring) {
    const int end = static_cast<int>(largest(outer)) + 1;
    int found[kLanes<V>] = {};
    *stored = 0;
    Vec<V> previous{};
    for (int j = 0; j < end; ++j) {
      const Run<V> run{ring(j), splat<V>(j)};
      const bool all = apart || j == 0;
      const unsigned begins = bits(run.start <= outer) & (all ? ~0u : bits(differ(run.force, previous) | (outer <= run.start)));
      previous = run.force;
      for (int l = 0; begins && l < kLanes<V>; ++l) {
        if (!(begins >> l & 1)) continue;
        if (found[l] == *stored) set((*stored)++, no_run<V>());
        copy_lane(first[found[l]++ * stride], l, run);
      }
    }
  }

  // The first `end` rings of a contact that reaches to `outer`, to `put(j, f)`.
  template <class Put>
  void unload(V outer, int end, const Put& put) const {
    int next[kLanes<V>] = {};  // run of each lane
    Run<V> now = no_run<V>();
    V until{};  // where they begin
    for (int j = 0; j < end; ++j) {
      const V at = splat<V>(j);
      const unsigned begins = bits(until <= at);
      for (int l = 0; begins && l < kLanes<V>; ++l) {
        if (!(begins >> l & 1)) continue;
        copy_lane(now, l, next[l] < *stored ? get(next[l]) : no_run<V>());
        const int after = ++next[l];
        copy_lane(until, l, after < *stored ? get(after).start : splat<V>(kNowhere));
      }
      put(j, zero_unless(at <= outer, now.force));
    }
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
