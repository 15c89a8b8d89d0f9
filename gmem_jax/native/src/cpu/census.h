// The census of a configuration. Lanes are replicas; where replicas are few, each is done by itself. Numbers of
// contacts and largest values do not depend on the order in which threads look.

#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <new>
#include <stdexcept>
#include <utility>
#include <vector>

#include "cpu/configuration.h"
#include "cpu/problem.h"
#include "cpu/scratch.h"
#include "cpu/team.h"
#include "numbers/number.h"
#include "physics/rotation.h"

namespace gmem {
namespace GMEM_ISA {

// How often each set of lanes occurred; the sets are bits.
template <int lanes>
class Tally {
 public:
  void add(unsigned set) { ++count_[set]; }
  void add(const Tally& other) {
    for (std::size_t set = 0; set < count_.size(); ++set) count_[set] += other.count_[set];
  }
  double of(int lane) const {
    std::int64_t sum = 0;
    for (std::size_t set = 0; set < count_.size(); ++set) sum += set >> lane & 1 ? count_[set] : 0;
    return static_cast<double>(sum);
  }

 private:
  std::array<std::int64_t, std::size_t{1} << lanes> count_{};
};

// The counts and largest values that one thread found.
template <class V>
struct Share {
  Tally<kLanes<V>> spheres, walls;
  V deepest, fastest{}, farthest{};  // an overlap, and the squares of a speed and a distance
  V amiss{}, lost{};  // 0, or not a number: of numbers that the next step needs; of those that make these three
  unsigned outside = 0;
  bool foreign = false;  // a candidate is not of this pack
};

template <class V>
class CensusOf {
 public:
  // Of `count` replicas from the one numbered `replica` on.
  CensusOf(const Configuration& c, int replica, int count, int threads)
      : c_(c), replica_(replica), count_(count), all_((1u << count) - 1), threads_(threads), shares_(threads) {
    const std::size_t spheres = static_cast<std::size_t>(c.spheres()), pairs = c.candidates;
    Arena arena{nullptr};
    arena.take<V>(spheres * 3), arena.take<Lanes>(pairs);
    scratch_ = take_scratch(arena.used);
    arena = {static_cast<char*>(scratch_.aligned())};
    sphere_ = arena.take<V>(spheres * 3), pair_ = arena.take<Lanes>(pairs);
  }
  ~CensusOf() { give_scratch(std::move(scratch_)); }

  void run() {
    run_ranks(threads_, [this](int rank) { look_at_grains(rank); });
    run_ranks(threads_, [this](int rank) { look_at_candidates(rank); });
    write();
  }

 private:
  using Lanes = std::atomic<unsigned char>;  // their bits: any thread may find that a pair of grains touches

  V at(const double* array, std::ptrdiff_t row) const {
    const double* from = array + row * c_.stride + replica_;
    if constexpr (kLanes<V> == 1) {
      return *from;
    } else {
      return count_ < kLanes<V> ? load(from, count_) : load(from);
    }
  }
  Vec<V> at3(const double* array, std::ptrdiff_t row) const {
    return {at(array, 3 * row), at(array, 3 * row + 1), at(array, 3 * row + 2)};
  }

  int share_begin(int of, int rank) const { return static_cast<int>(static_cast<std::int64_t>(of) * rank / threads_); }

  template <class Number>
  static Vec<V> spread(const Number* a) {
    return {splat<V>(a[0]), splat<V>(a[1]), splat<V>(a[2])};
  }
  // Axis by axis.
  static Vec<V> along(Vec<V> a, Vec<V> b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
  // 0, or not a number where one of these is not finite.
  static V nothing_of(Vec<V> a) { return (a.x - a.x) + (a.y - a.y) + (a.z - a.z); }

  // The bits of the lanes where a sphere's centre is beyond one of two walls. Counts the walls that the sphere touches.
  unsigned at_walls(V x, V lower, V upper, V radius, Tally<kLanes<V>>& touching) const {
    const V above = x - lower, below = upper - x;
    const unsigned one = bits_less(above, radius) & all_, other = bits_less(below, radius) & all_;
    if (one | other) touching.add(one), touching.add(other);
    return (bits_less(x, lower) | bits_less(upper, x)) & all_;
  }

  void look_at_grains(int rank) {
    Share<V> share;
    share.deepest = splat<V>(c_.candidates ? -std::numeric_limits<double>::infinity() : -1.0);
    const Vec<V> lower = at3(c_.walls, 0), upper = at3(c_.walls, 1), lengths = upper - lower;
    for (int n = share_begin(c_.grains, rank); n < share_begin(c_.grains, rank + 1); ++n) {
      const Vec<V> position = at3(c_.fields[0], n), velocity = at3(c_.fields[2], n);
      const Quaternion<V> q{at(c_.fields[1], 4 * n),
                            {at(c_.fields[1], 4 * n + 1), at(c_.fields[1], 4 * n + 2), at(c_.fields[1], 4 * n + 3)}};
      share.lost = share.lost + nothing_of(position) + (q.w - q.w) + nothing_of(q.v) + nothing_of(velocity);
      share.amiss = share.amiss + nothing_of(position) + nothing_of(at3(c_.fields[4], n));
      share.amiss = share.amiss + nothing_of(at3(c_.fields[5], n));
      share.fastest = max(share.fastest, dot(velocity, velocity));
      const Matrix<V> rotation = matrix(q);
      for (int k = 0; k < c_.spheres_per_grain; ++k) {
        const double size = c_.sizes ? c_.sizes[n] : 1.0;
        const V radius = splat<V>(c_.radii ? c_.radii[k] * size : 1.0);
        const Vec<V> x = position + rotation * (splat<V>(size) * spread(c_.offsets + 3 * k));
        const std::size_t s = static_cast<std::size_t>(n) * c_.spheres_per_grain + k;
        store_vec(sphere_ + 3 * s, x);
        if (!(c_.periodic & 1)) share.outside |= at_walls(x.x, lower.x, upper.x, radius, share.walls);
        if (!(c_.periodic & 2)) share.outside |= at_walls(x.y, lower.y, upper.y, radius, share.walls);
        if (!(c_.periodic & 4)) share.outside |= at_walls(x.z, lower.z, upper.z, radius, share.walls);
        const Vec<V> place = c_.common ? spread(c_.reference + 3 * s) : at3(c_.reference, s);
        const Vec<V> moved = x - (lower + along(place, lengths));
        share.farthest = max(share.farthest, dot(moved, moved));
      }
    }
    shares_[rank] = share;
    for (int p = share_begin(c_.candidates, rank); p < share_begin(c_.candidates, rank + 1); ++p)
      new (pair_ + p) Lanes(0);
  }

  double radius_of(int sphere) const {
    return c_.radii[sphere % c_.spheres_per_grain] * c_.sizes[sphere / c_.spheres_per_grain];
  }

  void look_at_candidates(int rank) {
    Share<V> share = shares_[rank];
    const unsigned spheres = static_cast<unsigned>(c_.spheres()), most = static_cast<unsigned>(c_.candidates);
    const Vec<V> edges = at3(c_.edges, 0);
    const V contact_square = splat<V>(4.0), apart = splat<V>(-1.0);
    V nearest = splat<V>(std::numeric_limits<double>::infinity());  // of equal spheres, a square
    for (int p = share_begin(c_.candidates, rank); p < share_begin(c_.candidates, rank + 1); ++p) {
      if (!c_.valid[p]) {
        share.deepest = max(share.deepest, apart);
        continue;
      }
      const unsigned i = c_.first[p], j = c_.second[p], pair = c_.grain_pair[p];
      if (i >= spheres || j >= spheres || pair >= most) {
        share.foreign = true;
        break;
      }
      Vec<V> between = load_vec(sphere_ + 3 * std::size_t{j}) - load_vec(sphere_ + 3 * std::size_t{i});
      if (c_.image) {
        const int8_t* turns = c_.image + 3 * static_cast<std::size_t>(p);
        between = between + along(spread(turns), edges);
      }
      const V square = dot(between, between);
      unsigned touching;
      if (c_.radii) {
        const V overlap = splat<V>(radius_of(i) + radius_of(j)) - root(square);
        share.deepest = max(share.deepest, overlap);
        touching = bits_less(V{}, overlap) & all_;
      } else {
        nearest = -max(-nearest, -square);
        touching = bits_less(square, contact_square) & all_;
      }
      if (!touching) continue;
      share.spheres.add(touching);
      if (touching & ~pair_[pair].load(std::memory_order_relaxed))
        pair_[pair].fetch_or(static_cast<unsigned char>(touching), std::memory_order_relaxed);
    }
    share.deepest = max(share.deepest, splat<V>(2.0) - root(nearest));
    shares_[rank] = share;
  }

  void write() {
    Share<V> sum = shares_[0];
    for (int rank = 1; rank < threads_; ++rank) {
      const Share<V>& one = shares_[rank];
      sum.spheres.add(one.spheres), sum.walls.add(one.walls);
      sum.deepest = max(sum.deepest, one.deepest), sum.fastest = max(sum.fastest, one.fastest);
      sum.farthest = max(sum.farthest, one.farthest);
      sum.amiss = sum.amiss + one.amiss, sum.lost = sum.lost + one.lost;
      sum.outside |= one.outside, sum.foreign |= one.foreign;
    }
    if (sum.foreign) throw std::invalid_argument("a candidate is not of spheres of the pack");
    Tally<kLanes<V>> grains;
    for (int pair = 0; pair < c_.candidates; ++pair)
      if (const unsigned touching = pair_[pair].load(std::memory_order_relaxed)) grains.add(touching);
    const unsigned bad = bits(differ(sum.amiss, V{}));
    const V rows[] = {sum.deepest + sum.lost, root(sum.fastest) + sum.lost, root(sum.farthest) + sum.lost};
    for (int l = 0; l < count_; ++l) {
      const auto to = [&](CensusRow row) -> double& { return c_.result[row * c_.stride + replica_ + l]; };
      to(kSphereContacts) = sum.spheres.of(l), to(kGrainContacts) = grains.of(l), to(kWallContacts) = sum.walls.of(l);
      to(kLargestOverlap) = lane(rows[0], l), to(kLargestSpeed) = lane(rows[1], l), to(kDeviation) = lane(rows[2], l);
      to(kOutside) = sum.outside >> l & 1, to(kFinite) = ~bad >> l & 1;
    }
  }

  static double lane(V a, int l) {
    if constexpr (kLanes<V> == 1) {
      return a;
    } else {
      return a[l];
    }
  }

  const Configuration& c_;
  const int replica_, count_;
  const unsigned all_;  // bits of the lanes that are replicas
  const int threads_;
  Scratch scratch_;
  V* sphere_;    // centres, [S, 3]
  Lanes* pair_;  // where a pair of grains touches, [candidates]
  std::vector<Share<V>> shares_;
};

constexpr int kCandidatesOfAThread = 1024;  // fewer are looked at sooner than a thread wakes

// Puts as many replicas side by side as the steps do: see call/handler.cc.
inline void census(const Configuration& c, int most) {
  const int threads = std::min(most, std::max(1, c.candidates / kCandidatesOfAThread));
  const int replicas = static_cast<int>(c.stride);
  int done = 0;
  for (; 2 * (replicas - done) >= W; done += W)
    CensusOf<Real>(c, done, W < replicas - done ? W : replicas - done, threads).run();
  for (; done < replicas; ++done) CensusOf<double>(c, done, 1, threads).run();
}

}  // namespace GMEM_ISA
}  // namespace gmem
