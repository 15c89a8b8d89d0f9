// The search for candidate contacts; see gmem_jax/native/search.py.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <exception>
#include <vector>

#include "cpu/team.h"

namespace gmem {

namespace {

constexpr int64_t kMostCells = int64_t{1} << 24;

// Points sorted into cells no smaller than `reach`.
struct Cells {
  double low[3], inverse;
  int64_t count[3];
  std::vector<int64_t> start;
  std::vector<int32_t> point;
  std::vector<double> place;  // of each point, in the order of `point`

  int64_t along(int axis, double x) const {
    return std::clamp(static_cast<int64_t>((x - low[axis]) * inverse), int64_t{0}, count[axis] - 1);
  }

  Cells(const double* points, int64_t size, double reach) {
    double high[3];
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = high[axis] = points[axis];
      for (int64_t i = 1; i < size; ++i) {
        low[axis] = std::min(low[axis], points[3 * i + axis]);
        high[axis] = std::max(high[axis], points[3 * i + axis]);
      }
    }
    for (double edge = reach * (1.0 + 1e-9);; edge *= 2.0) {
      double cells = 1.0;
      for (int axis = 0; axis < 3; ++axis) cells *= std::floor((high[axis] - low[axis]) / edge) + 1.0;
      if (cells > kMostCells) continue;
      inverse = 1.0 / edge;
      for (int axis = 0; axis < 3; ++axis) count[axis] = static_cast<int64_t>((high[axis] - low[axis]) / edge) + 1;
      break;
    }
    start.assign(count[0] * count[1] * count[2] + 1, 0);
    std::vector<int64_t> cell(size);
    for (int64_t i = 0; i < size; ++i) {
      const double* x = points + 3 * i;
      cell[i] = (along(0, x[0]) * count[1] + along(1, x[1])) * count[2] + along(2, x[2]);
      ++start[cell[i] + 1];
    }
    for (std::size_t c = 1; c < start.size(); ++c) start[c] += start[c - 1];
    std::vector<int64_t> next(start.begin(), start.end() - 1);
    point.resize(size), place.resize(3 * size);
    for (int64_t i = 0; i < size; ++i) {
      const int64_t n = next[cell[i]]++;
      point[n] = static_cast<int32_t>(i);
      std::copy_n(points + 3 * i, 3, place.begin() + 3 * n);
    }
  }

  // Calls `look` with every point in the cells around `x`, and its place.
  template <class Look>
  void around(const double* x, const Look& look) const {
    int64_t from[3], to[3];
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t at = along(axis, x[axis]);
      from[axis] = std::max(at - 1, int64_t{0}), to[axis] = std::min(at + 1, count[axis] - 1);
    }
    for (int64_t a = from[0]; a <= to[0]; ++a)
      for (int64_t b = from[1]; b <= to[1]; ++b) {
        const int64_t row = (a * count[1] + b) * count[2];
        for (int64_t n = start[row + from[2]]; n < start[row + to[2] + 1]; ++n) look(point[n], &place[3 * n]);
      }
  }
};

// The pairs whose sphere i is from `first` to `last` - 1, as numbers of `gmem_search`.
std::vector<int64_t> pairs_of(const Cells& cells, const double* centres, int64_t spheres, int64_t spheres_per_grain,
                              double reach, int64_t first, int64_t last) {
  const double surely_apart = reach * reach * (1.0 + 1e-12);  // the root decides, where it is needed
  std::vector<int64_t> keys;
  for (int64_t i = first; i < last; ++i) {
    const double* x = centres + 3 * i;
    const int64_t others = (i / spheres_per_grain + 1) * spheres_per_grain;
    const std::size_t known = keys.size();
    cells.around(x, [&](int32_t j, const double* y) {
      if (j < others) return;
      const double d[3] = {x[0] - y[0], x[1] - y[1], x[2] - y[2]};
      const double square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
      if (square < surely_apart && std::sqrt(square) < reach) keys.push_back(i * spheres + j);
    });
    std::sort(keys.begin() + known, keys.end());
  }
  return keys;
}

constexpr int64_t kSpheresOfAThread = 2048;  // fewer are found sooner than a thread wakes

}  // namespace

}  // namespace gmem

// Pairs i < j of spheres of different grains whose centres [S, 3], finite, are closer than `reach`, in order, as
// numbers i S + j. Writes the first `room` of them to `keys`; returns how many there are, or -1 without memory or
// threads.
extern "C" int64_t gmem_search(const double* centres, int64_t spheres, int64_t spheres_per_grain, double reach,
                               int64_t* keys, int64_t room) {
  try {
    if (spheres == 0) return 0;
    const gmem::Cells cells(centres, spheres, reach);
    const int64_t useful = std::max(int64_t{1}, spheres / gmem::kSpheresOfAThread);
    const gmem::Threads threads(static_cast<int>(std::min<int64_t>(gmem::thread_count(), useful)));
    std::vector<std::vector<int64_t>> shares(threads.count);
    gmem::run_ranks(threads.count, [&](int rank) {
      const int64_t first = spheres * rank / threads.count, last = spheres * (rank + 1) / threads.count;
      shares[rank] = gmem::pairs_of(cells, centres, spheres, spheres_per_grain, reach, first, last);
    });
    int64_t found = 0;
    for (const std::vector<int64_t>& share : shares) {
      const int64_t fits = std::clamp(room - found, int64_t{0}, static_cast<int64_t>(share.size()));
      std::copy_n(share.begin(), fits, keys + std::min(found, room));
      found += static_cast<int64_t>(share.size());
    }
    return found;
  } catch (const std::exception&) {
    return -1;
  }
}
