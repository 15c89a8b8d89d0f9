// The XLA custom call: finds the replicas in the arguments, shares them out to blocks and threads.
//
// Every argument and result may have further leading axes, from jax.vmap: all have the same number of them, each of
// size one or of the full size. Each index into them times each index of the innermost axis is a replica; replicas
// with the same candidate list may share a block.

#include "cpu/plan.h"
#include "cpu/problem.h"
#include "cpu/team.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <map>
#include <memory>
#include <mutex>
#include <new>
#include <string>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace gmem {

#define GMEM_DECLARE(name)                        \
  namespace name { extern const Kernel kernel; } \
  namespace name##_derivatives { extern const Kernel kernel; }
#if defined(__x86_64__)
GMEM_DECLARE(avx512)
GMEM_DECLARE(avx2)
#endif
GMEM_DECLARE(baseline)

namespace {

namespace ffi = xla::ffi;

const Kernel& best_kernel(Task task) {
  const auto of_task = [task](const Kernel& steps, const Kernel& derivatives) -> const Kernel& {
    return task == Task::forward ? steps : derivatives;
  };
  const char* wanted = std::getenv("GMEM_ISA");  // for tests: a lower instruction set than the best
  const std::string limit = wanted ? wanted : "";
#if defined(__x86_64__)
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
  if (avx512 && limit != "avx2" && limit != "baseline") return of_task(avx512::kernel, avx512_derivatives::kernel);
  if (avx2 && limit != "baseline") return of_task(avx2::kernel, avx2_derivatives::kernel);
#endif
  return of_task(baseline::kernel, baseline_derivatives::kernel);
}

// Memory that outlives a call, so that the next one does not fault its pages in again.
class ScratchPool {
 public:
  struct Piece {
    std::unique_ptr<char[]> memory;
    std::size_t bytes = 0;
    void* aligned() const {
      return reinterpret_cast<void*>((reinterpret_cast<std::uintptr_t>(memory.get()) + 63) / 64 * 64);
    }
  };

  Piece take(std::size_t bytes) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      for (auto piece = free_.begin(); piece != free_.end(); ++piece) {
        if (piece->bytes < bytes || piece->bytes > 2 * bytes) continue;
        Piece found = std::move(*piece);
        free_.erase(piece);
        return found;
      }
    }
    return {std::unique_ptr<char[]>(new char[bytes + 64]), bytes};
  }

  void give(Piece piece) {
    std::lock_guard<std::mutex> lock(mutex_);
    free_.push_back(std::move(piece));
    std::size_t total = 0;
    for (const Piece& kept : free_) total += kept.bytes;
    while (total > kKept && !free_.empty()) {
      total -= free_.front().bytes;
      free_.erase(free_.begin());
    }
  }

 private:
  static constexpr std::size_t kKept = std::size_t{512} << 20;
  std::mutex mutex_;
  std::vector<Piece> free_;
};

ScratchPool& scratch_pool() {
  static ScratchPool* pool = new ScratchPool;
  return *pool;
}

// One argument or result: its data, and how far apart the entries of each leading axis are.
struct Array {
  char* data = nullptr;
  std::vector<int64_t> shape;  // without the leading axes
  std::vector<int64_t> step;   // of the leading axes, in elements; 0 where the array has size one

  int64_t at(const std::vector<int64_t>& index) const {
    int64_t offset = 0;
    for (std::size_t axis = 0; axis < index.size(); ++axis) offset += index[axis] * step[axis];
    return offset;
  }
};

enum Argument { kFirst = kFields, kSecond, kValid, kReference, kSmallest, kOffsets, kParameterRows, kWallRows, kSteps,
                kHistoryIn };
constexpr int kRanks[kHistoryIn] = {3, 3, 3, 3, 3, 3, 1, 1, 1, 2, 1, 2, 2, 3, 1};
constexpr int kPressure = kFields, kHistoryOut = kFields + 1;  // results

Array view(const ffi::AnyBuffer& buffer, int leading) {
  Array array;
  array.data = static_cast<char*>(buffer.untyped_data());
  const auto dims = buffer.dimensions();
  array.shape.assign(dims.begin() + leading, dims.end());
  array.step.resize(leading);
  int64_t size = 1;
  for (const int64_t n : array.shape) size *= n;
  for (int axis = leading - 1; axis >= 0; --axis) {
    array.step[axis] = dims[axis] == 1 ? 0 : size;
    size *= dims[axis];
  }
  return array;
}

// Blocks one by one to single threads as long as that keeps all busy, then the rest to teams.
void run_blocks(const Problem& problem, const Kernel& kernel, const std::vector<Block>& blocks, int threads) {
  const int count = static_cast<int>(blocks.size());
  if (count == 0) return;
  const int alone = count / threads * threads, rest = count - alone;
  std::size_t bytes = 0;
  int domains = 0;
  for (const Block& block : blocks) {
    bytes = std::max(bytes, kernel.scratch_bytes(problem, block));
    domains = std::max(domains, block.pack->plan->domains);
  }
  if (alone > 0) {
    std::atomic<int> next{0};
    const int ranks = std::min(threads, alone);
    std::vector<ScratchPool::Piece> scratch;
    for (int rank = 0; rank < ranks; ++rank) scratch.push_back(scratch_pool().take(bytes));
    run_ranks(ranks, [&](int rank) {
      for (int i; (i = next.fetch_add(1)) < alone;) {
        Team team(1);
        kernel.run(problem, blocks[i], team, 0, scratch[rank].aligned());
      }
    });
    for (auto& piece : scratch) scratch_pool().give(std::move(piece));
  }
  if (rest > 0) {
    const int size = std::min({threads / rest, domains, Team::kMaxSize});
    std::vector<std::unique_ptr<Team>> teams;
    std::vector<ScratchPool::Piece> scratch;
    for (int i = 0; i < rest; ++i) {
      teams.emplace_back(new Team(size));
      scratch.push_back(scratch_pool().take(bytes));
    }
    run_ranks(rest * size, [&](int rank) {
      const int i = rank / size;
      kernel.run(problem, blocks[alone + i], *teams[i], rank % size, scratch[i].aligned());
    });
    for (auto& piece : scratch) scratch_pool().give(std::move(piece));
  }
}

ffi::Error invalid(const std::string& what) { return ffi::Error::InvalidArgument("gmem_jax native: " + what); }

// Arguments of the three tasks are those of the steps themselves, then, for derivatives, a number for each of the
// results' or arguments' own; see `Task`.
ffi::Error call(Task task, int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t leaves,
                ffi::RemainingArgs args, ffi::RemainingRets rets) {
  const std::vector<int> fields(kFields, 3);
  std::vector<int> histories(leaves, 3);
  if (law == static_cast<int64_t>(Law::mindlin) && leaves > 0) histories[0] = 4;
  const auto join = [&](std::vector<int> ranks, std::initializer_list<int> more) {
    ranks.insert(ranks.end(), more);
    ranks.insert(ranks.end(), histories.begin(), histories.end());
    return ranks;
  };
  const std::vector<int> inner = join(fields, {2}), outer = join(fields, {2, 3});
  std::vector<int> argument_ranks = join({std::begin(kRanks), std::end(kRanks)}, {});
  if (task != Task::forward) {
    const std::vector<int>& more = task == Task::tangent ? outer : inner;
    argument_ranks.insert(argument_ranks.end(), more.begin(), more.end());
  }
  const std::vector<int>& result_ranks = task == Task::adjoint ? outer : inner;
  if (args.size() != argument_ranks.size() || rets.size() != result_ranks.size() || leaves > kMaxHistory)
    return invalid("wrong number of arguments or results");
  std::vector<Array> in, out;
  std::vector<int64_t> batch;
  for (std::size_t i = 0; i < rets.size(); ++i) {
    auto buffer = rets.get<ffi::AnyBuffer>(i);
    if (!buffer.has_value()) return buffer.error();
    if (i == 0) {
      const auto dims = (*buffer)->dimensions();
      if (dims.size() < 3) return invalid("positions need three axes");
      batch.assign(dims.begin(), dims.end() - 3);
    }
    if ((*buffer)->element_type() != ffi::F64) return invalid("results must be float64");
    out.push_back(view(**buffer, static_cast<int>(batch.size())));
  }
  for (std::size_t i = 0; i < args.size(); ++i) {
    auto buffer = args.get<ffi::AnyBuffer>(i);
    if (!buffer.has_value()) return buffer.error();
    const bool integer = i == kFirst || i == kSecond || i == kSteps;
    const auto wanted = i == kValid ? ffi::PRED : integer ? ffi::S32 : ffi::F64;
    if (buffer->element_type() != wanted) return invalid("argument " + std::to_string(i) + " has the wrong type");
    if (buffer->dimensions().size() != argument_ranks[i] + batch.size())
      return invalid("argument " + std::to_string(i) + " has the wrong number of axes");
    in.push_back(view(*buffer, static_cast<int>(batch.size())));
  }

  const int64_t replicas = in[0].shape[2];
  Problem problem{};
  problem.task = task;
  problem.law = static_cast<Law>(law);
  problem.variant = static_cast<Variant>(variant);
  problem.isotropic = isotropic != 0;
  problem.points = static_cast<int>(points);
  problem.grains = static_cast<int>(in[0].shape[0]);
  problem.spheres_per_grain = static_cast<int>(in[kOffsets].shape[0]);
  problem.stride = replicas;
  const int64_t rows = in[kWallRows].shape[0];
  if (in[kParameterRows].shape[0] != kParameters || in[kWallRows].shape[1] != kWalls ||
      in[kReference].shape[0] != problem.spheres() || in[kSteps].shape[0] != replicas)
    return invalid("arguments do not fit each other");
  problem.history_aliased = task == Task::forward && leaves > 0;
  for (int64_t leaf = 0; leaf < leaves; ++leaf)
    problem.history_aliased &= in[kHistoryIn + leaf].data == out[kHistoryOut + leaf].data;

  // Collect the replicas by candidate list.
  constexpr int kOfPack = 6;  // arguments that belong to a pack
  std::map<std::array<int64_t, kOfPack>, std::size_t> known;
  std::vector<std::shared_ptr<const PlanStore>> plans;
  std::vector<std::unique_ptr<Pack>> packs;
  std::vector<std::vector<Lane>> lanes, slopes;
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
      plans.push_back(plan_for({problem.grains, problem.spheres_per_grain, static_cast<int>(in[kFirst].shape[0]),
                                integers(kFirst), integers(kSecond), valid, doubles(kReference), doubles(kSmallest)}));
      packs.emplace_back(new Pack{&plans.back()->plan, doubles(kOffsets)});
      lanes.emplace_back();
      slopes.emplace_back();
    }
    for (int64_t b = 0; b < replicas; ++b) {
      // Pointers to this replica in the next array of arguments, and of results.
      std::size_t argument = 0, result = 0;
      const auto source = [&](const Array& a) { return reinterpret_cast<double*>(a.data) + a.at(index) + b; };
      const auto next_argument = [&] { return source(in[argument++]); };
      const auto next_result = [&] { return source(out[result++]); };
      Lane lane{};
      for (int f = 0; f < kFields; ++f) lane.grains_in[f] = next_argument(), lane.grains_out[f] = next_result();
      lane.parameters = source(in[kParameterRows]);
      lane.walls = source(in[kWallRows]);
      const int32_t steps = (reinterpret_cast<const int32_t*>(in[kSteps].data) + in[kSteps].at(index))[b];
      lane.steps = static_cast<int>(task == Task::forward ? std::min<int64_t>(std::max(steps, 0), rows) : rows);
      argument = kHistoryIn;
      for (int64_t leaf = 0; leaf < leaves; ++leaf) lane.history_in[leaf] = next_argument();
      Lane slope = lane;
      if (task != Task::forward)
        for (int f = 0; f < kFields; ++f) slope.grains_in[f] = next_argument();
      if (task == Task::tangent) slope.parameters = next_argument(), slope.walls = next_argument();
      if (task == Task::adjoint) {
        slope.pressure = next_argument();
        slope.parameters_out = next_result(), slope.walls_out = next_result();
      } else {
        lane.pressure = slope.pressure = next_result();
      }
      for (int64_t leaf = 0; leaf < leaves; ++leaf) {
        lane.history_out[leaf] = slope.history_out[leaf] = next_result();
        if (task != Task::forward) slope.history_in[leaf] = next_argument();
      }
      lanes[place.first->second].push_back(lane);
      slopes[place.first->second].push_back(slope);
    }
    for (int axis = static_cast<int>(batch.size()) - 1; axis >= 0 && ++index[axis] == batch[axis]; --axis) index[axis] = 0;
  }

  const Kernel& kernel = best_kernel(task);
  std::vector<Block> whole, packed;
  for (std::size_t i = 0; i < packs.size(); ++i) {
    const int count = static_cast<int>(lanes[i].size());
    int done = 0;
    // Replicas side by side share much work: a vector that is half full is cheaper than they are one by one.
    for (; 2 * (count - done) >= kernel.width || (task != Task::forward && done < count); done += kernel.width)
      whole.push_back({packs[i].get(), &lanes[i][done], &slopes[i][done], std::min(kernel.width, count - done), false});
    for (; done < count; ++done) packed.push_back({packs[i].get(), &lanes[i][done], nullptr, 1, true});
  }
  const int threads = acquire_threads(thread_count());
  bool enough = true;
  try {
    run_blocks(problem, kernel, whole, threads);
    run_blocks(problem, kernel, packed, threads);
  } catch (const std::bad_alloc&) {
    enough = false;
  }
  if (threads > 1) release_threads();
  if (!enough) return ffi::Error(ffi::ErrorCode::kResourceExhausted, "gmem_jax native: out of memory; use fewer replicas");
  return ffi::Error::Success();
}

template <Task task>
ffi::Error handle(int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t leaves,
                  ffi::RemainingArgs args, ffi::RemainingRets rets) {
  return call(task, law, variant, points, isotropic, leaves, args, rets);
}

auto binding() {
  return ffi::Ffi::Bind()
      .Attr<int64_t>("law")
      .Attr<int64_t>("variant")
      .Attr<int64_t>("points")
      .Attr<int64_t>("isotropic")
      .Attr<int64_t>("leaves")
      .RemainingArgs()
      .RemainingRets();
}

}  // namespace
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_advance, gmem::handle<gmem::Task::forward>, gmem::binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_tangent, gmem::handle<gmem::Task::tangent>, gmem::binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_adjoint, gmem::handle<gmem::Task::adjoint>, gmem::binding());

// Of the sources and flags that this library was compiled from; see native/build.py.
extern "C" const char* gmem_source_hash() { return GMEM_SOURCE_HASH; }

// Name of the instruction set in use.
extern "C" const char* gmem_instruction_set() { return gmem::best_kernel(gmem::Task::forward).name; }
