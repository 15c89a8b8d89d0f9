// The search for candidate contacts; see gmem_jax/native/search.py.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <new>
#include <vector>

namespace gmem {

namespace {

constexpr int64_t kMostCells = int64_t{1} << 24;

// Points sorted into cells no smaller than `reach`.
struct Cells {
  double low[3], inverse;
  int64_t count[3];
  std::vector<int64_t> start;
  std::vector<int32_t> point;

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
    point.resize(size);
    for (int64_t i = 0; i < size; ++i) point[next[cell[i]]++] = static_cast<int32_t>(i);
  }

  // Calls `look` with every point in the cells around `x`.
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
        for (int64_t n = start[row + from[2]]; n < start[row + to[2] + 1]; ++n) look(point[n]);
      }
  }
};

}  // namespace

}  // namespace gmem

// Pairs i < j of spheres of different grains whose centres [S, 3], finite, are closer than `reach`, in order, as numbers
// i S + j. Writes the first `room` of them to `keys`; returns how many there are, or -1 without memory.
extern "C" int64_t gmem_search(const double* centres, int64_t spheres, int64_t spheres_per_grain, double reach,
                               int64_t* keys, int64_t room) {
  try {
    if (spheres == 0) return 0;
    const gmem::Cells cells(centres, spheres, reach);
    std::vector<int32_t> near;
    int64_t found = 0;
    for (int64_t i = 0; i < spheres; ++i) {
      const double* x = centres + 3 * i;
      const int64_t others = (i / spheres_per_grain + 1) * spheres_per_grain;
      near.clear();
      cells.around(x, [&](int32_t j) {
        if (j < others) return;
        const double* y = centres + 3 * static_cast<int64_t>(j);
        const double d[3] = {x[0] - y[0], x[1] - y[1], x[2] - y[2]};
        if (std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) < reach) near.push_back(j);
      });
      std::sort(near.begin(), near.end());
      for (const int32_t j : near) {
        if (found < room) keys[found] = i * spheres + j;
        ++found;
      }
    }
    return found;
  } catch (const std::bad_alloc&) {
    return -1;
  }
}
