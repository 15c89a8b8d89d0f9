#include "cpu/plan.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <numeric>
#include <stdexcept>
#include <string>
#include <tuple>

#include "cpu/process.h"

namespace gmem {

namespace {

constexpr std::size_t kRemembered = std::size_t{256} << 20;  // bytes

struct Point {
  double x[3];
  int grain;
};

// Recursive bisection across the longest side until a piece fits into a few cache lines.
void bisect(Point* points, int count) {
  if (count <= 4) return;
  double low[3], high[3];
  for (int axis = 0; axis < 3; ++axis) {
    low[axis] = high[axis] = points[0].x[axis];
    for (int i = 1; i < count; ++i) {
      low[axis] = std::min(low[axis], points[i].x[axis]);
      high[axis] = std::max(high[axis], points[i].x[axis]);
    }
  }
  int axis = 0;
  for (int other = 1; other < 3; ++other)
    if (high[other] - low[other] > high[axis] - low[axis]) axis = other;
  const int half = count / 2;
  std::nth_element(points, points + half, points + count, [axis](const Point& a, const Point& b) {
    return std::tie(a.x[axis], a.grain) < std::tie(b.x[axis], b.grain);
  });
  bisect(points, half);
  bisect(points + half, count - half);
}

std::vector<int32_t> spatial_order(const List& list) {
  std::vector<Point> points(list.grains);
  const int spheres = list.spheres_per_grain;
  for (int g = 0; g < list.grains; ++g) {
    points[g].grain = g;
    for (int axis = 0; axis < 3; ++axis) {
      double sum = 0.0;
      for (int k = 0; k < spheres; ++k) sum += list.reference[3 * (static_cast<std::size_t>(g) * spheres + k) + axis];
      sum *= list.smallest[axis];
      points[g].x[axis] = sum == sum ? sum : 0.0;  // not-a-numbers cannot be sorted
    }
  }
  bisect(points.data(), list.grains);
  std::vector<int32_t> order(list.grains);
  for (int g = 0; g < list.grains; ++g) order[g] = points[g].grain;
  return order;
}

// A power of two, so that domains end where the bisection did: 4 for a pack of 325 grains, 32 for 31,680. More domains
// would occupy more threads, but they have more remotes, which are written to memory and read again.
int domains_for(int candidates) {
  const double logarithm = 0.5 * std::log2(std::max(1.0, candidates / 330.0));
  return 1 << static_cast<int>(std::lround(logarithm));
}

// A list that would lead outside of its arrays must not become a plan.
void check(const List& list) {
  const int spheres = list.grains * list.spheres_per_grain;
  for (int row = 0; row < list.rows; ++row) {
    const int i = list.first[row], j = list.second[row];
    if (!list.valid[row] ||
        (0 <= i && i < j && j < spheres && i / list.spheres_per_grain != j / list.spheres_per_grain))
      continue;
    throw std::invalid_argument("candidate " + std::to_string(row) + " joins spheres " + std::to_string(i) + " and " +
                                std::to_string(j) + "; wanted are two of different grains, in order, from 0 to " +
                                std::to_string(spheres - 1));
  }
}

// Sorts by a number from 0 to `end` - 1; candidates with the same number stay in order.
template <class Number>
void sort_by(std::vector<Candidate>& candidates, int end, const Number& number) {
  std::vector<int32_t> next(end + 1, 0);
  for (const Candidate& c : candidates) ++next[number(c) + 1];
  std::partial_sum(next.begin(), next.end(), next.begin());
  std::vector<Candidate> sorted(candidates.size());
  for (const Candidate& c : candidates) sorted[next[number(c)]++] = c;
  candidates.swap(sorted);
}

// Numbers the remotes by the grain that they act on, so that a grain's remotes lie together, and then by domain.
// Numbers their contacts in the same way; candidates are sorted by their domains.
void number_remotes(const std::vector<int32_t>& domain_of, PlanStore& store) {
  const std::size_t grains = domain_of.size();
  std::vector<std::vector<int32_t>> of_grain(grains);
  for (std::size_t n = 0; n < store.candidate.size(); ++n)
    if (const Candidate& c = store.candidate[n]; domain_of[c.home()] != domain_of[c.away()])
      of_grain[c.away()].push_back(static_cast<int32_t>(n));
  store.remote_start.push_back(0);
  store.remote_contact_start.push_back(0);
  int32_t remotes = 0;
  for (const auto& contacts : of_grain) {
    int32_t domain = -1;
    for (const int32_t n : contacts) {
      Candidate& c = store.candidate[n];
      if (domain_of[c.home()] != domain) domain = domain_of[c.home()], ++remotes;
      c.remote = remotes - 1;
      c.remote_contact = static_cast<int32_t>(store.remote_contact_sphere.size());
      store.remote_contact_sphere.push_back(c.away_is_one() ? c.one : c.other);
    }
    store.remote_start.push_back(remotes);
    store.remote_contact_start.push_back(static_cast<int32_t>(store.remote_contact_sphere.size()));
  }
}

// Boxes that are large enough have at most 27 images: as a table of rows, they stay in the cache.
void number_images(const List& list, PlanStore& store) {
  std::map<std::array<int8_t, 3>, int32_t> number{{{0, 0, 0}, 0}};
  store.images.push_back({0.0, 0.0, 0.0});
  for (const Candidate& c : store.candidate) {
    const int8_t* of = list.image + 3 * static_cast<std::size_t>(c.row);
    const auto [found, is_new] = number.insert({{of[0], of[1], of[2]}, static_cast<int32_t>(number.size())});
    if (is_new) store.images.push_back({1.0 * of[0], 1.0 * of[1], 1.0 * of[2]});
    store.image.push_back(found->second);
  }
  store.image.push_back(0);
}

std::shared_ptr<const PlanStore> make_plan(const List& list) {
  check(list);
  auto store = std::make_shared<PlanStore>();
  const int spheres = list.spheres_per_grain;
  store->grain = spatial_order(list);
  std::vector<int32_t> place(list.grains);
  for (int g = 0; g < list.grains; ++g) place[store->grain[g]] = g;

  std::vector<Candidate>& candidates = store->candidate;
  for (int row = 0; row < list.rows; ++row) {
    if (!list.valid[row]) {
      store->padding_row.push_back(row);
      continue;
    }
    const int i = list.first[row], j = list.second[row];
    const int grain_i = place[i / spheres], grain_j = place[j / spheres];
    candidates.push_back(
        {grain_i * spheres + i % spheres, grain_j * spheres + j % spheres, grain_i, grain_j, -1, -1, row});
  }
  sort_by(candidates, list.grains, std::mem_fn(&Candidate::away));  // they are sorted by rows already
  sort_by(candidates, list.grains, std::mem_fn(&Candidate::home));

  // Domains end between grains.
  const int count = static_cast<int>(candidates.size());
  const int wanted = domains_for(count);
  std::vector<int32_t> domain_of(list.grains);
  store->domain_candidate.push_back(0);
  int next = 0;
  for (int g = 0; g < list.grains; ++g) {
    domain_of[g] = static_cast<int>(store->domain_candidate.size()) - 1;
    while (next < count && candidates[next].home() == g) ++next;
    const int64_t ended = static_cast<int>(store->domain_candidate.size());
    if (ended < wanted && next >= ended * count / wanted) store->domain_candidate.push_back(next);
  }
  store->domain_candidate.push_back(count);

  number_remotes(domain_of, *store);
  if (list.image) number_images(list, *store);

  double largest = 1.0, widest = 1.0;
  if (list.radii) {
    for (const int32_t grain : store->grain) {
      const double size = list.sizes[grain], cube = size * size * size;
      store->size.push_back({size, cube, 1.0 / cube, 1.0 / (cube * size * size)});
    }
    for (const Candidate& c : candidates) {
      const double one = store->size[c.grain_one].one * list.radii[c.one % spheres];
      const double other = store->size[c.grain_other].one * list.radii[c.other % spheres], reach = one + other;
      store->radii.push_back({reach, 0.5 * (one - other), std::sqrt(2.0 * one * other / reach), reach * reach});
    }
    store->radii.push_back({2.0, 0.0, 1.0, 4.0});
    largest = *std::max_element(list.sizes, list.sizes + list.grains);
    widest = largest * *std::max_element(list.radii, list.radii + spheres);
  }

  store->plan = {count,
                 static_cast<int>(store->domain_candidate.size()) - 1,
                 store->remote_start.back(),
                 store->remote_contact_start.back(),
                 static_cast<int>(store->padding_row.size()),
                 store->grain.data(),
                 candidates.data(),
                 list.image ? store->image.data() : nullptr,
                 list.image ? store->images.data() : nullptr,
                 list.radii ? store->radii.data() : nullptr,
                 list.radii ? store->size.data() : nullptr,
                 largest,
                 4.0 * widest,
                 store->domain_candidate.data(),
                 store->remote_start.data(),
                 store->remote_contact_start.data(),
                 store->remote_contact_sphere.data(),
                 store->padding_row.data()};
  return store;
}

// A copy of what a plan was made from.
struct Key {
  int grains, spheres_per_grain, rows;
  bool images, radii;
  std::vector<char> bytes;

  explicit Key(const List& list)
      : grains(list.grains), spheres_per_grain(list.spheres_per_grain), rows(list.rows), images(list.image),
        radii(list.radii) {
    visit(list, [this](const void* data, std::size_t size) {
      const char* begin = static_cast<const char*>(data);
      bytes.insert(bytes.end(), begin, begin + size);
      return true;
    });
  }

  bool matches(const List& list) const {
    if (grains != list.grains || spheres_per_grain != list.spheres_per_grain || rows != list.rows) return false;
    if (images != (list.image != nullptr) || radii != (list.radii != nullptr)) return false;
    std::size_t at = 0;
    return visit(list, [&](const void* data, std::size_t size) {
      const bool same = std::memcmp(bytes.data() + at, data, size) == 0;
      at += size;
      return same;
    });
  }

  template <class Function>
  static bool visit(const List& list, const Function& function) {
    const std::size_t rows = list.rows, spheres = static_cast<std::size_t>(list.grains) * list.spheres_per_grain;
    return function(list.first, rows * sizeof(int32_t)) && function(list.second, rows * sizeof(int32_t)) &&
           function(list.valid, rows * sizeof(bool)) && function(list.reference, 3 * spheres * sizeof(double)) &&
           function(list.smallest, 3 * sizeof(double)) && (!list.image || function(list.image, 3 * rows)) &&
           (!list.radii || (function(list.radii, list.spheres_per_grain * sizeof(double)) &&
                            function(list.sizes, list.grains * sizeof(double))));
  }
};

struct Memory {
  std::mutex mutex;
  std::deque<std::pair<Key, std::shared_ptr<const PlanStore>>> known;
};

}  // namespace

std::shared_ptr<const PlanStore> plan_for(const List& list) {
  auto& [mutex, known] = of_process<Memory>();
  {
    std::lock_guard<std::mutex> lock(mutex);
    for (const auto& entry : known)
      if (entry.first.matches(list)) return entry.second;
  }
  auto plan = make_plan(list);
  Key key(list);
  std::lock_guard<std::mutex> lock(mutex);
  known.emplace_front(std::move(key), plan);
  std::size_t bytes = 0, keep = 0;
  for (const auto& entry : known) {
    bytes += entry.first.bytes.size() + entry.second->candidate.size() * sizeof(Candidate);
    if (keep == 0 || bytes <= kRemembered) ++keep;
  }
  known.resize(keep, known.front());
  return plan;
}

}  // namespace gmem
