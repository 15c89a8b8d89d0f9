// How Mindlin's f is stored. A step adds the same to f in all attached rings, so this common part is kept once. f of
// the outermost ring, which is being filled, is kept by itself. The rings inside it are looked at only when a contact
// reaches one ring more or less. Rings that were attached together have the same f for ever, so they are kept as
// segments of equal rings. (A contact of the shipped packs has 37 rings in 2 segments at rest, 52 in 22 if compressed.)

#pragma once

#include "numbers/vectors.h"

namespace gmem {
namespace GMEM_ISA {

// Every lane has its own segments: segment k of one lane may begin at another ring than segment k of another lane.
template <class V>
struct Segment {
  Flat<V> force;  // f without `Layers::common`
  V start;        // its first ring; it ends where the next segment begins, and the last one at the outermost ring
};

// The start of a segment that a lane does not have: beyond all rings.
constexpr double kNowhere = 1e9;

template <class V>
constexpr Segment<V> no_segment() {
  return {Flat<V>{}, splat<V>(kNowhere)};
}

template <class V>
inline void copy_lane(Segment<V>& to, int l, const Segment<V>& from) {
  copy_lane(to.force.along, l, from.force.along);
  copy_lane(to.force.across, l, from.force.across);
  copy_lane(to.start, l, from.start);
}

// The numbers of a contact's rings that change in every step.
template <class V>
struct Layers {
  Flat<V> common;  // to be added to f of every segment
  Flat<V> inside;  // the sum of w f over the rings inside the outermost
  Flat<V> rim;     // f of the outermost ring
};

template <class V>
constexpr Layers<V> load_layers(const V* p) {
  return {{p[0], p[1]}, {p[2], p[3]}, {p[4], p[5]}};
}
template <class V>
constexpr void store_layers(V* p, const Layers<V>& a) {
  p[0] = a.common.along, p[1] = a.common.across;
  p[2] = a.inside.along, p[3] = a.inside.across;
  p[4] = a.rim.along, p[5] = a.rim.across;
}

// Changes segments and layers of a contact from the outermost ring `before` (-1: none is attached) to `outer`, in the
// lanes where the two differ. Rings that the contact left are forgotten; new rings begin with f = 0. The weight of ring
// 0 is 1 - `lacking`.
template <class V, class Segments>
void reattach(Segments& segments, Layers<V>& layers, V before, V outer, double lacking) {
  segments.remember();
  const V one = splat<V>(1.0), nowhere = splat<V>(kNowhere);
  const Mask<V> grows = before < outer, shrinks = outer < before, differs = grows | shrinks;
  const Flat<V> common = zero_unless(differs, layers.common);
  V last = -one, count{};
  Flat<V> force{}, inside{}, rim{};
  const int stored = segments.count();
  for (int k = 0; k < stored + 2; ++k) {
    Segment<V> segment = k < stored ? segments.get(k) : no_segment<V>();
    segment.force = segment.force + common;
    const Mask<V> stays = segment.start < outer, reaches = segment.start <= outer,
                  begins = grows & (outer <= segment.start);
    rim = select(shrinks & reaches, segment.force, rim);
    // New segments are the ring that was the outermost, then the rings that were passed in this step.
    const Mask<V> former = begins & (last < before);
    const Mask<V> passed = begins & (before <= last) & (last <= before) & (before + one < outer);
    const Mask<V> there = stays | former | passed;
    if (!bits(there | reaches)) break;
    const V start = select(stays, segment.start, select(former, before, before + one));
    inside = fma(zero_unless(there, start - last), force, inside);
    force = select(there, zero_unless(stays | former, select(stays, segment.force, layers.rim)), force);
    if (lacking != 0.0 && k == 0) inside = fma(splat<V>(-lacking), force, inside);
    last = select(there, start, last);
    count = count + zero_unless(there, one);
    segments.set(k, {force, select(there, start, nowhere)});
  }
  segments.keep(count);
  inside = fma(outer - last, force, inside);
  layers = {select(differs, Flat<V>{}, layers.common), select(differs, inside, layers.inside),
            select(differs, rim, layers.rim)};
}

// Segments in an array, `stride` apart.
template <class V, class Stored = Segment<V>>
struct StoredSegments {
  Stored* first;
  long long stride;
  int* stored;  // how many there are in the lane that has most
  int rings;
  Segment<V>* seen = nullptr;  // where `remember` copies the segments, one after the other, and their number
  int* seen_count = nullptr;

  V last() const { return splat<V>(rings - 2.0); }
  int count() const { return *stored; }
  const Segment<V>& get(int k) const { return first[k * stride]; }
  void set(int k, const Segment<V>& segment) { static_cast<Segment<V>&>(first[k * stride]) = segment; }
  void keep(V counts) { *stored = static_cast<int>(largest(counts)); }
  void forget() { remember(), *stored = 0; }
  void remember() const {
    if (!seen) return;
    *seen_count = count();
    for (int k = 0; k < count(); ++k) seen[k] = get(k);
  }

  // Makes the segments from rings; `ring(j)` reads f of ring j. With `apart` each ring is a segment of its own.
  template <class Ring>
  Layers<V> load(V outer, double lacking, bool apart, const Ring& ring) {
    const int end = static_cast<int>(largest(outer)) + 1;
    int found[kLanes<V>] = {};
    *stored = 0;
    Flat<V> previous{};
    Layers<V> layers{};
    for (int j = 0; j < end; ++j) {
      const Segment<V> segment{ring(j), splat<V>(j)};
      const Mask<V> within = segment.start < outer;
      layers.inside = fma(zero_unless(within, splat<V>(j == 0 ? 1.0 - lacking : 1.0)), segment.force, layers.inside);
      layers.rim = select(segment.start <= outer, segment.force, layers.rim);
      const unsigned begins = bits(within) & (apart || j == 0 ? ~0u : bits(differ(segment.force, previous)));
      previous = segment.force;
      for (int l = 0; begins && l < kLanes<V>; ++l) {
        if (!(begins >> l & 1)) continue;
        if (found[l] == *stored) set((*stored)++, no_segment<V>());
        copy_lane(static_cast<Segment<V>&>(first[found[l]++ * stride]), l, segment);
      }
    }
    return layers;
  }

  // Calls `put(j, f)` for the first `end` rings of a contact whose outermost ring is `outer`.
  template <class Put>
  void unload(const Layers<V>& layers, V outer, int end, const Put& put) const {
    int next[kLanes<V>] = {};  // the next segment of each lane
    Segment<V> now = no_segment<V>();
    V until{};  // where the next segments begin
    for (int j = 0; j < end; ++j) {
      const V at = splat<V>(j);
      const unsigned begins = bits(until <= at);
      for (int l = 0; begins && l < kLanes<V>; ++l) {
        if (!(begins >> l & 1)) continue;
        copy_lane(now, l, next[l] < *stored ? get(next[l]) : no_segment<V>());
        const int after = ++next[l];
        copy_lane(until, l, after < *stored ? get(after).start : splat<V>(kNowhere));
      }
      put(j, zero_unless(at <= outer, select(at < outer, now.force + layers.common, layers.rim)));
    }
  }
};

}  // namespace GMEM_ISA
}  // namespace gmem
