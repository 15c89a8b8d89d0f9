// The XLA custom call: finds the replicas in the arguments, shares them out to blocks and threads.
//
// Every argument and result may have further leading axes, from jax.vmap: all have the same number of them, each of
// size one or of the full size. Each index into them times each index of the innermost axis is a replica; replicas
// with the same candidate list may share a block.

#include <algorithm>
#include <array>
#include <cstdlib>
#include <exception>
#include <map>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include "call/signature.h"
#include "cpu/blocks.h"
#include "cpu/plan.h"
#include "cpu/problem.h"
#include "cpu/team.h"

namespace gmem {

namespace {

namespace ffi = xla::ffi;

enum Argument {
  kFirst = kFields,
  kSecond,
  kValid,
  kReference,
  kSmallest,
  kImages,
  kRadii,
  kSizes,
  kOffsets,
  kParameterRows,
  kWallRows,
  kHistoryIn
};
constexpr int kHistoryOut = kFields + 1;  // results: after the pressure

struct Signature {
  Wants arguments, results;
};

// The arguments of every task begin with those of the steps. Then come, as `Task` says, derivatives of the arguments
// along a direction, derivatives by the results, and derivatives of the latter along the direction.
// gmem_jax/native/calls.py: call_library, of_results, of_arrays
Signature signature(Task task, Law law, bool rubs) {
  const Wants pack = {{"first spheres", "P", ffi::S32},
                      {"second spheres", "P", ffi::S32},
                      {"validities", "P", ffi::PRED},
                      {"reference centres", "S3"},
                      {"smallest lengths", "3"},
                      {"images", "PI", ffi::S8},
                      {"radii", "KU"},
                      {"sizes", "NU"},
                      {"offsets", "K3"}};
  const Wants fields = fields_of_grains(), numbers = numbers_of_steps();
  const Wants walls = wall_histories(law, rubs), history = histories(law) + walls;
  const Wants arguments = fields + pack + numbers + history, arrays = arrays_of_steps(law) + walls;
  const Wants moved = fields + pressures() + history;
  switch (task) {
    case Task::tangent: return {arguments + arrays, moved};
    case Task::adjoint: return {arguments + moved, arrays};
    case Task::second_adjoint: return {arguments + arrays + moved + moved, arrays};
    default: return {arguments, moved};
  }
}

ffi::Error call(Task task, int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t leaves,
                int64_t mixed, int64_t periodic, int64_t unequal, int64_t rubs, ffi::RemainingArgs args,
                ffi::RemainingRets rets) {
  require_law(law, variant, points);
  require_axes(periodic);
  Problem problem{};
  problem.task = task;
  problem.law = static_cast<Law>(law);
  problem.variant = static_cast<Variant>(variant);
  problem.isotropic = isotropic != 0;
  problem.mixed = mixed != 0;
  problem.periodic = static_cast<int>(periodic);
  problem.rubs = rubs != 0;
  require(!(periodic || unequal) || !problem.mixed,
          "in a periodic box, and of unequal spheres, there is no mixed precision");
  require(!problem.mixed || (task == Task::forward && !is_layered(problem.law)),
          "there is no mixed precision for derivatives and the Mindlin law");
  require(!(rubs && problem.mixed), "at walls with friction there is no mixed precision");
  const Signature wanted = signature(task, problem.law, problem.rubs);
  require(static_cast<std::size_t>(leaves) == histories(problem.law).size() && args.size() == wanted.arguments.size() &&
              rets.size() == wanted.results.size(),
          "the number of arguments or results is not that of the friction law");

  std::vector<ffi::AnyBuffer> results;
  for (std::size_t i = 0; i < rets.size(); ++i) results.push_back(*rets.get<ffi::AnyBuffer>(i).value());
  const auto dims = results[0].dimensions();
  require(dims.size() >= 3, "positions need three axes");
  const std::vector<int64_t> batch(dims.begin(), dims.end() - 3);
  Reader reader(batch);
  reader.size('R') = kRows;
  reader.size('I') = periodic ? 3 : 0;
  reader.size('U') = unequal ? 1 : 0;
  reader.size('W') = kWalls;
  reader.size('Q') = points;
  std::vector<Array> in, out;
  for (std::size_t i = 0; i < args.size(); ++i)
    in.push_back(reader.read(args.get<ffi::AnyBuffer>(i).value(), wanted.arguments[i]));
  for (std::size_t i = 0; i < results.size(); ++i) {
    out.push_back(reader.read(results[i], wanted.results[i]));
    for (std::size_t axis = 0; axis < batch.size(); ++axis)
      require(batch[axis] == results[i].dimensions()[axis], "results differ in their leading axes");
  }
  const int64_t replicas = reader.size('B'), rows = reader.size('T');
  problem.points = static_cast<int>(points);
  problem.grains = static_cast<int>(reader.size('N'));
  problem.spheres_per_grain = static_cast<int>(reader.size('K'));
  problem.stride = replicas;
  require(problem.grains > 0 && problem.spheres_per_grain > 0, "there is no grain");
  require(reader.size('S') == reader.size('N') * reader.size('K'), "there are not as many spheres as the grains have");
  require(!rubs || leaves == 0 || reader.size('F') == kPlanes * reader.size('S'),
          "walls' histories are not those of all spheres");
  problem.history_aliased = task == Task::forward && leaves > 0;
  const int64_t all_leaves = rubs ? 2 * leaves : leaves;
  const bool of_results = task == Task::forward || task == Task::tangent;  // otherwise they are by arguments
  const bool has_slopes = task == Task::tangent || task == Task::second_adjoint;
  for (int64_t leaf = 0; leaf < all_leaves; ++leaf)
    problem.history_aliased &= in[kHistoryIn + leaf].data == out[kHistoryOut + leaf].data;

  // Collect the replicas by candidate list.
  constexpr int kOfPack = 9;  // arguments that belong to a pack
  std::map<std::array<int64_t, kOfPack>, std::size_t> known;
  std::vector<std::shared_ptr<const PlanStore>> plans;
  std::vector<std::unique_ptr<Pack>> packs;
  std::vector<std::vector<ReplicaArrays>> lanes, slopes, bars, bar_slopes;
  std::vector<int64_t> index(batch.size(), 0);
  int64_t entries = 1;
  for (const int64_t n : batch) entries *= n;
  for (int64_t entry = 0; entry < entries; ++entry) {
    std::array<int64_t, kOfPack> key;
    for (int i = 0; i < kOfPack; ++i) key[i] = in[kFirst + i].at(index);
    const auto place = known.emplace(key, packs.size());
    if (place.second) {
      const auto doubles = [&](Argument i) { return reinterpret_cast<const double*>(in[i].data) + key[i - kFirst]; };
      const auto integers = [&](Argument i) { return reinterpret_cast<const int32_t*>(in[i].data) + key[i - kFirst]; };
      const bool* valid = reinterpret_cast<const bool*>(in[kValid].data) + key[kValid - kFirst];
      const int8_t* image =
          periodic ? reinterpret_cast<const int8_t*>(in[kImages].data) + key[kImages - kFirst] : nullptr;
      plans.push_back(plan_for({problem.grains, problem.spheres_per_grain, static_cast<int>(reader.size('P')),
                                integers(kFirst), integers(kSecond), valid, doubles(kReference), doubles(kSmallest),
                                image, unequal ? doubles(kRadii) : nullptr, unequal ? doubles(kSizes) : nullptr}));
      packs.emplace_back(new Pack{&plans.back()->plan, doubles(kOffsets), unequal ? doubles(kRadii) : nullptr});
      for (auto* all : {&lanes, &slopes, &bars, &bar_slopes}) all->emplace_back();
    }
    for (int64_t b = 0; b < replicas; ++b) {
      // Pointers to this replica in the next array of arguments, and of results.
      std::size_t argument = 0, result = 0;
      const auto source = [&](const Array& a) { return reinterpret_cast<double*>(a.data) + a.at(index) + b; };
      const auto next_argument = [&] { return source(in[argument++]); };
      const auto next_result = [&] { return source(out[result++]); };
      const auto read_grains = [&](ReplicaArrays& lane) {
        for (int f = 0; f < kFields; ++f) lane.grains_in[f] = next_argument();
      };
      const auto read_histories = [&](ReplicaArrays& lane) {
        for (int64_t leaf = 0; leaf < leaves; ++leaf) lane.history_in[leaf] = next_argument();
        for (int64_t leaf = leaves; leaf < all_leaves; ++leaf) lane.wall_history_in[leaf - leaves] = next_argument();
      };
      ReplicaArrays lane{};
      read_grains(lane);
      lane.parameters = source(in[kParameterRows]);
      lane.walls = source(in[kWallRows]);
      lane.steps = static_cast<int>(rows);
      argument = kHistoryIn;
      read_histories(lane);
      for (int f = 0; f < kFields; ++f) lane.grains_out[f] = next_result();
      if (of_results) lane.pressure = next_result();
      else lane.parameters_out = next_result(), lane.walls_out = next_result(), lane.offsets_out = next_result();
      for (int64_t leaf = 0; leaf < leaves; ++leaf) lane.history_out[leaf] = next_result();
      for (int64_t leaf = leaves; leaf < all_leaves; ++leaf) lane.wall_history_out[leaf - leaves] = next_result();
      const auto read_slope = [&] {
        ReplicaArrays slope = lane;
        read_grains(slope);
        slope.parameters = next_argument(), slope.walls = next_argument(), slope.offsets = next_argument();
        read_histories(slope);
        return slope;
      };
      const auto read_bar = [&] {
        ReplicaArrays bar = lane;
        read_grains(bar);
        bar.pressure = next_argument();
        read_histories(bar);
        return bar;
      };
      lanes[place.first->second].push_back(lane);
      if (has_slopes) slopes[place.first->second].push_back(read_slope());
      if (!of_results) bars[place.first->second].push_back(read_bar());
      if (!of_results && has_slopes) bar_slopes[place.first->second].push_back(read_bar());
    }
    for (int axis = static_cast<int>(batch.size()) - 1; axis >= 0 && ++index[axis] == batch[axis]; --axis)
      index[axis] = 0;
  }

  std::size_t most = 0;
  for (const auto& of_pack : lanes) most = std::max(most, of_pack.size());
  const InstructionSet& kernel = best_kernel(task, most);
  std::vector<Block> whole, packed;
  for (std::size_t i = 0; i < packs.size(); ++i) {
    const int count = static_cast<int>(lanes[i].size());
    int done = 0;
    const auto block_of = [&](int width, bool packed, bool wide = false) {
      const auto from = [&](const std::vector<ReplicaArrays>& all) { return all.empty() ? nullptr : &all[done]; };
      return Block{packs[i].get(),
                   &lanes[i][done],
                   from(slopes[i]),
                   from(bars[i]),
                   from(bar_slopes[i]),
                   std::min(width, count - done),
                   packed,
                   wide};
    };
    // Replicas side by side share much work: a vector that is half full is cheaper than its replicas one by one.
    for (; problem.mixed && done < count; done += 2 * kernel.width)
      whole.push_back(block_of(2 * kernel.width, false, count - done > kernel.width));
    for (; 2 * (count - done) >= kernel.width || (task != Task::forward && done < count); done += kernel.width)
      whole.push_back(block_of(kernel.width, false));
    for (; done < count; ++done) packed.push_back(block_of(1, true));
  }
  const Threads threads(thread_count());
  run_blocks(problem, kernel, whole, threads.count);
  run_blocks(problem, kernel, packed, threads.count);
  return ffi::Error::Success();
}

template <Task task>
ffi::Error handle(int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t leaves, int64_t mixed,
                  int64_t periodic, int64_t unequal, int64_t rubs, ffi::RemainingArgs args, ffi::RemainingRets rets) {
  return in_words(
      [&] { return call(task, law, variant, points, isotropic, leaves, mixed, periodic, unequal, rubs, args, rets); });
}

auto binding() { return with_arguments(ffi::Ffi::Bind()); }

}  // namespace
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_advance, gmem::handle<gmem::Task::forward>, gmem::binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_tangent, gmem::handle<gmem::Task::tangent>, gmem::binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_adjoint, gmem::handle<gmem::Task::adjoint>, gmem::binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_second_adjoint, gmem::handle<gmem::Task::second_adjoint>, gmem::binding());

// Of the sources and flags that this library was compiled from; see native/build.py.
extern "C" const char* gmem_source_hash() { return GMEM_SOURCE_HASH; }

// CPUs that this process may keep busy.
extern "C" int gmem_cpus() { return gmem::cpus(); }
