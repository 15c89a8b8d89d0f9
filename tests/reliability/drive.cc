// Drives the kernels without Python or XLA, to be compiled with sanitizers: every law and task, thread counts, sizes of
// batches and lists, calls at once; the numbers must not depend on threads, batches or company. An argument plants a
// defect: what the library is told about its arrays is then a lie, which the sanitizers must notice in its own code.
// The argument "numbers" prints a hash of what each case gives, to be compared with another machine's (tests/arm).

#include <cmath>
#include <cstdio>
#include <cstring>
#include <deque>
#include <map>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "../native/check.h"
#include "cpu/blocks.h"
#include "cpu/configuration.h"
#include "cpu/plan.h"
#include "cpu/team.h"

namespace gmem {
namespace steps { extern const InstructionSet kernel; }
namespace derivatives { extern const InstructionSet kernel; }
namespace second_derivatives { extern const InstructionSet kernel; }
}  // namespace gmem

using namespace gmem;
using Numbers = std::vector<double>;

constexpr int kSpheres = 2, kSteps = 2;
constexpr int kSizes[kFields] = {3, 4, 3, 3, 3, 3};

// Something between -1 and 1 that depends on three integers alone: rounded, since sines differ in their last bit
// between machines.
double noise(int a, int b, int c) {
  return std::round(1e6 * std::sin(12.9898 * a + 78.233 * b + 37.719 * c + 1.0)) / 1e6;
}

struct Case {
  Law law;
  Variant variant;
  Task task;
  int edge;      // grains along the edge of a block of them, or 0: two grains
  double reach;  // of the candidates
  int replicas;
  bool mixed = false;
  bool general = false;  // in a periodic box, grains of sizes and of spheres that differ
  bool rubs = false;     // walls have friction; along z alone if the box is periodic
};

// Grains of two spheres that touch their neighbours and the walls.
struct Scene {
  int grains;
  Numbers position, reference, smallest{1.0, 1.0, 1.0}, offsets{-0.5, 0.0, 0.0, 0.5, 0.0, 0.0};
  std::vector<int32_t> first, second, grain_pair;
  std::vector<char> valid;
  std::vector<int8_t> images;
  Numbers radii{1.0, 0.95}, sizes;

  explicit Scene(const Case& c) : grains(c.edge ? c.edge * c.edge * c.edge : 2) {
    const int edge = c.edge ? c.edge : 2;
    for (int g = 0; g < grains; ++g) {
      const double x[3] = {2.9 * (g % edge) + 1.45, 1.95 * (g / edge % edge) + 0.97, 1.95 * (g / edge / edge) + 0.97};
      for (int axis = 0; axis < 3; ++axis) position.push_back(x[axis] + 0.03 * noise(g, axis, 0));
      for (int k = 0; k < kSpheres; ++k)
        for (int axis = 0; axis < 3; ++axis) reference.push_back(position[3 * g + axis] + offsets[3 * k + axis]);
    }
    for (int i = 0; i < grains * kSpheres; ++i)
      for (int j = (i / kSpheres + 1) * kSpheres; j < grains * kSpheres; ++j) {
        double square = 0.0;
        for (int axis = 0; axis < 3; ++axis) square += std::pow(reference[3 * i + axis] - reference[3 * j + axis], 2);
        if (square > c.reach * c.reach) continue;
        if (first.size() % 5 == 2) list(-7, 1 << 30, false);  // padding may hold anything
        list(i, j, true);
      }
    std::map<std::pair<int, int>, int> pairs;
    for (std::size_t row = 0; row < first.size(); ++row)
      grain_pair.push_back(
          pairs.emplace(std::pair{first[row] / kSpheres, second[row] / kSpheres}, static_cast<int>(pairs.size()))
              .first->second);
    for (int g = 0; g < grains; ++g) sizes.push_back(1.0 + 0.03 * noise(g, 0, 12));
    for (std::size_t row = 0; row < first.size(); ++row)
      images.insert(images.end(), {static_cast<int8_t>(row % 7 == 3), 0, 0});
  }

  void list(int i, int j, bool is_valid) { first.push_back(i), second.push_back(j), valid.push_back(is_valid); }
};

constexpr Task kTasks[] = {Task::forward, Task::tangent, Task::adjoint, Task::second_adjoint};

// Runs one call; the results of the first replica. `plant` is the defect.
Numbers run(const Case& c, int threads, const std::string& plant = "") {
  const Scene scene(c);
  const int n = scene.grains, b = c.replicas, points = 5, candidates = static_cast<int>(scene.first.size());
  std::deque<Numbers> arrays;  // each of its very size
  std::vector<double*> results;
  const auto array = [&](int rows, bool result, auto number) {
    Numbers& a = arrays.emplace_back(static_cast<std::size_t>(rows) * b);
    for (int row = 0; row < rows; ++row)
      for (int l = 0; l < b; ++l) a[row * b + l] = result ? NAN : number(row, l);
    if (result) results.insert(results.end(), {a.data(), a.data() + a.size()});
    return a.data();
  };
  const auto small = [](int row, int l) { return 1e-3 * noise(row, l, 1); };
  const auto positive = [](int row, int l) { return 1e-3 * (1.5 + noise(row, l, 2)); };
  const double box = 2.9 * (c.edge ? c.edge : 2);
  const auto parameter = [&](int row, int) {
    if (row >= kCell) return row == kWallMu ? 0.3 : row < kCell + 3 ? 0.0 : box;
    const double numbers[kRows] = {0.05, 0.01, 1.5, 0.8, 1.0, 1.3, 0.47, 0.069, 0.66, 0.4, 0.145, 0.069, 0.9, 0.06};
    return numbers[row];
  };
  const auto wall = [&](int row, int) { return row % 12 < 3 ? 0.0 : row % 12 < 6 ? box : 1e-3; };
  const auto field = [&](int f) {
    return [&scene, f](int row, int l) {
      if (f == 0) return scene.position[row] + 1e-3 * noise(row, l, 3);
      return f == 1 && row % 4 == 0 ? 1.0 : f == 1 ? 0.0 : 0.01 * noise(row, l, 4 + f);
    };
  };
  // Numbers of a contact in each array of the histories, the last of them its overlap but for Hooke's law.
  const std::vector<int> sizes = c.law == Law::frictionless ? std::vector<int>{}
                                 : c.law == Law::hooke      ? std::vector<int>{3}
                                 : c.law == Law::mindlin    ? std::vector<int>{2 * points, 3, 1}
                                                            : std::vector<int>{3, 1};
  const bool forward = c.task == Task::forward, second = c.task == Task::second_adjoint;
  const bool back = second || c.task == Task::adjoint;

  ReplicaArrays lane{};
  lane.steps = kSteps;
  for (int f = 0; f < kFields; ++f) {
    lane.grains_in[f] = array(n * kSizes[f] - (plant == "bounds" && f == 5), false, field(f));
    lane.grains_out[f] = array(n * kSizes[f], true, small);
  }
  if (plant == "alignment")
    lane.grains_in[4] = reinterpret_cast<double*>(reinterpret_cast<char*>(array(n * 3 + 1, false, small)) + 1);
  for (std::size_t leaf = 0; leaf < sizes.size(); ++leaf) {
    const int rows = sizes[leaf] * candidates;
    const bool overlap = sizes[leaf] == 1;
    lane.history_in[leaf] =
        array(rows, false, [&](int row, int l) { return overlap ? positive(row, l) : small(row, l); });
    lane.history_out[leaf] = array(rows, true, small);
  }
  for (std::size_t leaf = 0; c.rubs && leaf < sizes.size(); ++leaf) {
    const int rows = sizes[leaf] * kPlanes * n * kSpheres;
    const bool overlap = sizes[leaf] == 1;
    lane.wall_history_in[leaf] = array(rows, false, [&](int row, int l) {
      return row % 5 == 0 ? 0.0 : overlap ? positive(row, l) : small(row, l);
    });
    lane.wall_history_out[leaf] = array(rows, true, small);
  }
  lane.parameters = array(kRows, false, parameter);
  lane.walls = array(kSteps * kWalls, false, wall);
  lane.offsets = array(kSpheres * 3, false, small);
  lane.pressure = array(3, !back, small);
  if (back) lane.parameters_out = array(kRows, true, small), lane.walls_out = array(kSteps * kWalls, true, small);
  if (back) lane.offsets_out = array(kSpheres * 3, true, small);
  // The same with arguments of their own: slopes, or bars.
  const auto other = [&] {
    ReplicaArrays of = lane;
    for (int f = 0; f < kFields; ++f) of.grains_in[f] = array(n * kSizes[f], false, small);
    for (std::size_t leaf = 0; leaf < sizes.size(); ++leaf) {
      of.history_in[leaf] = array(sizes[leaf] * candidates, false, small);
      if (c.rubs) of.wall_history_in[leaf] = array(sizes[leaf] * kPlanes * n * kSpheres, false, small);
    }
    of.parameters = array(kRows, false, small);
    of.walls = array(kSteps * kWalls, false, small);
    of.offsets = array(kSpheres * 3, false, small);
    if (back) of.pressure = array(3, false, small);
    return of;
  };
  const ReplicaArrays slope = other(), bar = other(), bar_slope = other();

  const Problem problem{
      c.task, c.law, c.variant, false, false, points, n, kSpheres, b, c.mixed, c.general ? c.rubs ? 3 : 7 : 0, c.rubs};
  const auto store = plan_for({n, kSpheres, candidates, scene.first.data(), scene.second.data(),
                               reinterpret_cast<const bool*>(scene.valid.data()), scene.reference.data(),
                               scene.smallest.data(), c.general ? scene.images.data() : nullptr,
                               c.general ? scene.radii.data() : nullptr, c.general ? scene.sizes.data() : nullptr});
  const Pack pack{&store->plan, scene.offsets.data(), c.general ? scene.radii.data() : nullptr};
  const InstructionSet& kernel = forward ? steps::kernel : second ? second_derivatives::kernel : derivatives::kernel;
  const auto moved = [](ReplicaArrays of, std::ptrdiff_t l) {
    for (int f = 0; f < kFields; ++f) of.grains_in[f] += l, of.grains_out[f] += l;
    for (int leaf = 0; leaf < kMaxHistory; ++leaf)
      if (of.history_in[leaf]) of.history_in[leaf] += l, of.history_out[leaf] += l;
    for (int leaf = 0; leaf < kMaxHistory; ++leaf)
      if (of.wall_history_in[leaf]) of.wall_history_in[leaf] += l, of.wall_history_out[leaf] += l;
    of.parameters += l, of.walls += l, of.offsets += l, of.pressure += l;
    if (of.parameters_out) of.parameters_out += l, of.walls_out += l, of.offsets_out += l;
    return of;
  };
  std::vector<ReplicaArrays> lanes, slopes, bars, bar_slopes;
  for (int l = 0; l < b; ++l) {
    lanes.push_back(moved(lane, l)), slopes.push_back(moved(slope, l));
    bars.push_back(moved(bar, l)), bar_slopes.push_back(moved(bar_slope, l));
  }
  std::vector<Block> blocks;
  for (int l = 0; l < b;) {
    // Of two lanes the library has no use for this; here it is to be seen.
    const bool packed = forward && (2 * (b - l) < kernel.width || b == 1);
    const int count = packed ? 1 : b - l < kernel.width ? b - l : kernel.width;
    blocks.push_back({&pack, &lanes[l], &slopes[l], &bars[l], &bar_slopes[l], count, packed});
    l += count;
  }
  if (plant == "race") blocks = {blocks[0], blocks[0]};  // two threads write the same results
  Configuration configuration{};
  if (forward && plant.empty()) {
    configuration = {n,
                     kSpheres,
                     candidates,
                     problem.periodic,
                     b,
                     true,
                     scene.first.data(),
                     scene.second.data(),
                     scene.grain_pair.data(),
                     reinterpret_cast<const bool*>(scene.valid.data()),
                     c.general ? scene.images.data() : nullptr,
                     c.general ? scene.radii.data() : nullptr,
                     c.general ? scene.sizes.data() : nullptr,
                     scene.offsets.data()};
    for (int f = 0; f < kFields; ++f) configuration.fields[f] = lane.grains_in[f];
    configuration.walls = lane.walls, configuration.edges = lane.walls + 3 * b;
    configuration.reference = scene.reference.data();
    configuration.result = array(kCensusRows, true, small);
  }
  {
    const Threads held(threads);
    run_blocks(problem, kernel, blocks, held.count);
    if (configuration.result) kernel.census(configuration, held.count);
  }
  Numbers found;
  for (std::size_t i = 0; i < results.size(); i += 2)
    for (const double* a = results[i]; a < results[i + 1]; a += b) found.push_back(*a);
  return found;
}

bool same(const Numbers& a, const Numbers& b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(double)) == 0);
}

// FNV-1a of the bytes.
unsigned long long hash(const Numbers& numbers) {
  unsigned long long found = 14695981039346656037ull;
  const auto* bytes = reinterpret_cast<const unsigned char*>(numbers.data());
  for (std::size_t i = 0; i < numbers.size() * sizeof(double); ++i) found = (found ^ bytes[i]) * 1099511628211ull;
  return found;
}

int main(int count, char** arguments) {
  const bool printed = count > 1 && std::string(arguments[1]) == "numbers";
  if (count > 1 && !printed) {
    for (int repeat = 0; repeat < 50; ++repeat)
      run({Law::hooke, Variant::exact, Task::forward, 4, 4.5, 16}, 2, arguments[1]);
    return 0;
  }
  const struct {
    Law law;
    Variant variant;
  } laws[] = {{Law::frictionless, Variant::exact},     {Law::hooke, Variant::exact},
              {Law::mindlin_rescaled, Variant::exact}, {Law::mindlin, Variant::exact},
              {Law::mindlin, Variant::averaged},       {Law::mindlin, Variant::paper}};
  const struct {
    int edge;
    double reach;
  } packs[] = {{0, 0.0}, {0, 2.5}, {3, 0.0}, {3, 2.5}, {4, 4.5}};
  for (const auto& law : laws)
    for (const Task task : kTasks)
      for (const auto& pack : packs) {
        const auto with = [&](int replicas) {
          return Case{law.law, law.variant, task, pack.edge, pack.reach, replicas};
        };
        const Numbers alone = run(with(1), 1);
        for (const double number : alone) CHECK(std::isfinite(number));
        if (printed) {
          const int name[] = {static_cast<int>(law.law), static_cast<int>(law.variant), static_cast<int>(task)};
          const auto print = [&](const char* precision, const Numbers& numbers) {
            std::printf("law %d.%d task %d pack %d.%g %s %016llx\n", name[0], name[1], name[2], pack.edge, pack.reach,
                        precision, hash(numbers));
          };
          print("double", alone);
          Case mixed = with(1);
          mixed.mixed = true;
          if (task == Task::forward) print("mixed", run(mixed, 2));
        }
        for (const int replicas : {2, 7, 9, 17})
          if (pack.edge < 4) CHECK(same(run(with(replicas), 2), alone));
        for (const int threads : {2, 5})
          if (pack.edge == 4) CHECK(same(run(with(1), threads), alone));
        if (pack.edge == 3) {  // calls at once
          std::vector<std::thread> callers;
          std::deque<Numbers> found(4);
          for (Numbers& one : found) callers.emplace_back([&, to = &one] { *to = run(with(3), 3); });
          for (std::thread& caller : callers) caller.join();
          for (const Numbers& one : found) CHECK(same(one, alone));
        }
      }
  // Periodic boxes of unequal spheres, rough walls, and both.
  for (const auto& law : laws)
    for (const Task task : kTasks)
      for (const int kind : {0, 1, 2}) {
        const bool general = kind != 1, rubs = kind != 0;
        const bool some = law.law == Law::hooke || law.variant == Variant::paper,
                   has = general ? some : !some && law.law != Law::mindlin;
        const auto with = [&](int edge, int replicas) {
          return Case{law.law, law.variant, task, edge, edge == 4 ? 4.5 : 2.5, replicas, false, general, rubs};
        };
        if (!has || printed) continue;
        for (const int edge : {3, 4}) {
          const Numbers alone = run(with(edge, 1), 1);
          for (const double number : alone) CHECK(std::isfinite(number));
          for (const int threads : {2, 5}) CHECK(same(run(with(edge, 1), threads), alone));
          if (edge == 3) CHECK(same(run(with(edge, 7), 2), alone));
        }
      }
  return failures != 0;
}
