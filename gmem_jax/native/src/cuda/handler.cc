// XLA's custom call on a GPU: finds the arrays, and puts the kernels of all steps into XLA's stream without waiting.
//
// Arrays have one leading axis, of size one or of the full size. Arrays that are needed between steps are further
// results, so that XLA knows of all memory and may keep the launches as a graph.

#include <algorithm>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "call/signature.h"
#include "cuda/launch.h"

namespace gmem {
namespace cuda {

namespace {

namespace ffi = xla::ffi;

// Grains times lanes from which on one thread a grain keeps a GPU busy (an H200, measured).
constexpr int kFew = 1 << 17;
constexpr int kOfPack = 8;  // arguments that belong to a pack

// Beside the letters of call/signature.h: columns of the incidence C, candidates and spheres A, numbers of a cold grain
// O, of a load E, of a sphere at the walls X, of `Layers` Y, derivatives and values D, lanes L. Of reverse mode:
// numbers that are kept of a grain M, of a history H, sums of a grain J, chunks of grains G.
// gmem_jax/native/cuda.py: call_kernels, between_steps
Wants arguments_of(Task task, Law law, bool rubs) {
  const Wants pack = {{"first spheres", "P", ffi::S32},
                      {"second spheres", "P", ffi::S32},
                      {"validity", "P", ffi::PRED},
                      {"incidence", "SC", ffi::S32},
                      {"images", "PI", ffi::S8},
                      {"offsets", "K3"},
                      {"radii", "KU"},
                      {"sizes", "NU"}};
  const Wants walls = wall_histories(law, rubs),
              all = fields_of_grains() + pack + numbers_of_steps() + histories(law) + walls;
  if (task == Task::adjoint) return all + fields_of_grains() + pressures() + histories(law);
  return task == Task::tangent ? all + arrays_of_steps(law) + walls : all;
}

// Histories of derivatives are kept with their values.
Wants results_of(Task task, Law law, bool rubs) {
  const Wants remembered = histories(law) + wall_histories(law, rubs);
  Wants all = task == Task::adjoint ? arrays_of_steps(law) : fields_of_grains() + pressures() + remembered;
  all = all + Wants{{"hot", "DN9L"},   {"spheres", "DS3L"}, {"cold", "DNOL"},
                    {"walls", "DSXL"}, {"loads", "DPEL"},   {"touching", "AL", ffi::U8}};
  if (task != Task::forward)
    for (const Wanted& leaf : remembered)
      if (leaf.axes.size() == 3) all.push_back({leaf.name, std::string("D") + leaf.axes.substr(0, 2) + "L"});
  if (task == Task::adjoint)
    all = all + Wants{{"kept grains", "TNML"},     {"kept loads", "TN6L"},   {"kept histories", "TPHL"},
                      {"middles", "NML"},          {"bars of walls", "NWL"}, {"sums of grains", "NJL"},
                      {"sums of contacts", "P7L"}, {"sums of walls", "TGWL"}};
  if (!is_layered(law)) return all;
  all = all + Wants{{"layers", "DPYL"}, {"segments", "DPQ3L"}, {"stored", "PL", ffi::S32}};
  if (rubs)
    all = all + Wants{{"walls' layers", "DFYL"}, {"walls' segments", "DFQ3L"}, {"walls' stored", "FL", ffi::S32}};
  return all;
}

template <class T>
Entries<T> entries(const Array& array) {
  return {reinterpret_cast<T*>(array.data), array.step[0]};
}

int threads_for(int64_t many) {
  require(many < (int64_t{1} << 31) - 1024, "too many replicas at once for a GPU; use fewer");
  return static_cast<int>(many);
}

Which which_of(Task task, int64_t law, int64_t variant, int64_t points, int64_t periodic, int64_t unequal,
               int64_t rubs) {
  require_law(law, variant, points);
  require_axes(periodic);
  require(task != Task::adjoint || !(is_layered(static_cast<Law>(law)) || periodic || unequal || rubs),
          "reverse mode on GPUs is for equal spheres between smooth walls, and not for the Mindlin law");
  return {static_cast<Law>(law), static_cast<Variant>(variant), task, periodic != 0, unequal != 0, rubs != 0};
}

// Launches the steps; in reverse mode their kernels keep the numbers that the way back needs.
void launch_steps(const Launcher& launch, const Arguments& a, bool rubs) {
  const int spheres = a.grains * a.spheres;
  launch(GpuKernel::enter, a.grains, a);
  launch(GpuKernel::remember, rubs ? a.rows + spheres : a.rows, a);
  const GpuKernel move = a.grains * int64_t{a.lanes} < kFew ? GpuKernel::move : GpuKernel::move_alone;
  for (int step = 0; step < a.steps; ++step) {
    launch(GpuKernel::touch, a.rows + spheres, a, step);
    launch(move, a.grains, a, step);
  }
}

void go_forward(const Launcher& launch, const Arguments& a, bool rubs, bool layered) {
  const int spheres = a.grains * a.spheres;
  launch_steps(launch, a, rubs);
  for (int stride = 1; stride < spheres; stride *= kChunk)
    launch(GpuKernel::collect, (spheres + kChunk * stride - 1) / (kChunk * stride) * 3, a, stride);
  launch(GpuKernel::leave, !layered && !a.tangent ? 3 : rubs ? a.rows + spheres : std::max(a.rows, 3), a);
}

void go_back(const Launcher& launch, const Arguments& a) {
  const int sums = kOfConstants + 3 * a.spheres, most = std::max(a.rows, a.grains);
  const int64_t kept = int64_t{a.steps} * std::max<int64_t>({kOfGrain * int64_t{a.grains}, 4 * int64_t{a.rows}});
  threads_for(std::max<int64_t>({kept, kOfInput * int64_t{a.rows}, sums * int64_t{a.grains}}));  // rows of arrays
  threads_for(std::max<int64_t>({sums * int64_t{a.grains}, 1 + kWalls * int64_t{a.steps}}) * a.lanes);
  launch_steps(launch, a, false);
  launch(GpuKernel::take, most, a);
  launch(GpuKernel::move_back, a.grains, a, a.steps);
  for (int step = a.steps - 1; step >= 0; --step) {
    launch(GpuKernel::touch_back, a.rows, a, step);
    launch(GpuKernel::gather_back, a.grains * a.spheres, a, step);
    launch(GpuKernel::move_back, a.grains, a, step);
    launch(GpuKernel::collect_walls, Arguments::chunks(a.grains) * kWalls, a, step);
  }
  const auto chunks = [](int many, int stride) { return Arguments::chunks((many + stride - 1) / stride); };
  for (int stride = 1; stride < most; stride *= kChunk)
    launch(GpuKernel::sum_up, sums * chunks(a.grains, stride) + kOfContact * chunks(a.rows, stride), a, stride);
  launch(GpuKernel::leave_back, 1 + 3 * a.spheres + kWalls * a.steps, a);
}

ffi::Error call(Task task, int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t periodic,
                int64_t unequal, int64_t rubs, void* stream, ffi::RemainingArgs args, ffi::RemainingRets rets) {
  const Which which = which_of(task, law, variant, points, periodic, unequal, rubs);
  const Wants wanted = arguments_of(task, which.law, which.rubs), given = results_of(task, which.law, which.rubs);
  require(args.size() == wanted.size() && rets.size() == given.size(),
          "the number of arguments or results is not that of the friction law");
  std::vector<ffi::AnyBuffer> results;
  for (std::size_t i = 0; i < rets.size(); ++i) results.push_back(*rets.get<ffi::AnyBuffer>(i).value());
  const auto dims = results[0].dimensions();
  require(dims.size() == 4, "positions need four axes");
  Reader reader({dims[0]});
  reader.size('R') = kRows;
  reader.size('I') = periodic ? 3 : 0;
  reader.size('U') = unequal ? 1 : 0;
  reader.size('W') = kWalls;
  reader.size('Q') = points;
  reader.size('O') = 4;
  reader.size('E') = task == Task::adjoint ? kOfInput : kLoad;
  reader.size('X') = rubs || task == Task::adjoint ? kOfSphere : 6;
  reader.size('Y') = kOfLayers;
  reader.size('D') = task == Task::tangent ? 2 : 1;
  reader.size('M') = kOfGrain;
  reader.size('H') = with_law(which.law, which.variant, [](auto law) { return decltype(law)::kHistory; });
  std::vector<Array> in, out;
  for (std::size_t i = 0; i < args.size(); ++i)
    in.push_back(reader.read(args.get<ffi::AnyBuffer>(i).value(), wanted[i]));
  reader.size('L') = dims[0] * reader.size('B');
  reader.size('A') = reader.size('P') + reader.size('S');
  reader.size('J') = kOfConstants + 3 * reader.size('K');
  reader.size('G') = Arguments::chunks(static_cast<int>(reader.size('N')));
  for (std::size_t i = 0; i < results.size(); ++i) out.push_back(reader.read(results[i], given[i]));
  const std::size_t leaves = histories(which.law).size(), all_leaves = rubs ? 2 * leaves : leaves;
  const std::size_t fresh = kFields + (task == Task::adjoint ? 3 : 1) + all_leaves;
  for (std::size_t i = 0; i < fresh; ++i)
    require(results[i].dimensions()[0] == dims[0], "results differ in their leading axes");

  Arguments a{};
  a.grains = static_cast<int>(reader.size('N'));
  a.spheres = static_cast<int>(reader.size('K'));
  a.rows = static_cast<int>(reader.size('P'));
  a.points = static_cast<int>(points);
  a.steps = static_cast<int>(reader.size('T'));
  a.replicas = static_cast<int>(reader.size('B'));
  a.lanes = static_cast<int>(reader.size('L'));
  a.isotropic = isotropic != 0;
  a.periodic = static_cast<int>(periodic);
  a.columns = static_cast<int>(reader.size('C'));
  a.tangent = task == Task::tangent;
  require(a.grains > 0 && a.spheres > 0, "there is no grain");
  require(a.lanes > 0, "there is no replica");
  require(!rubs || leaves == 0 || reader.size('F') == kPlanes * reader.size('S'),
          "walls' histories are not those of all spheres");
  require(a.columns % 4 == 0, "columns of the incidence should come in fours");
  require(reader.size('S') == reader.size('N') * reader.size('K'), "spheres are not as many as grains have");
  a.by_replicas = Divisor(a.replicas), a.by_lanes = Divisor(a.lanes), a.by_spheres = Divisor(a.spheres);

  // Tables in the order of arguments and results.
  std::size_t argument = 0, slope = kFields + kOfPack + 2 + all_leaves, result = 0;
  const auto read = [&] {
    Table table{entries<double>(in[argument++]), {nullptr, 0}, a.replicas};
    if (task == Task::tangent) table.slope = entries<double>(in[slope++]);
    return table;
  };
  const auto write = [&] { return Table{entries<double>(out[result++]), {nullptr, 0}, a.replicas}; };
  for (Table& field : a.grains_in) field = read();
  a.first = entries<const int>(in[argument++]);
  a.second = entries<const int>(in[argument++]);
  a.valid = entries<const unsigned char>(in[argument++]);
  a.incidence = entries<const Four>(in[argument++]);
  a.incidence.step /= 4;
  a.image = entries<const signed char>(in[argument++]);
  a.offsets = entries<const double>(in[argument++]);
  a.radii = entries<const double>(in[argument++]);
  a.sizes = entries<const double>(in[argument++]);
  a.parameters = read();
  a.walls = read();
  if (task == Task::tangent) a.along_offsets = entries<const double>(in[slope++]);
  a.of_wall = static_cast<int>(reader.size('X'));
  const int64_t wall_rows = rubs ? kPlanes * reader.size('S') : 0;
  std::vector<std::pair<Memories*, int64_t>> kept{{&a.contacts, a.rows}};  // with their rows
  if (rubs) kept.emplace_back(&a.at_walls, wall_rows);
  for (const auto& [of, rows] : kept)
    for (std::size_t leaf = 0; leaf < leaves; ++leaf) of->history_in[leaf] = read();
  for (Table& field : a.grains_out) field = write();
  if (task == Task::adjoint) {
    for (Table& field : a.back.fields_in) field = read();
    a.back.pressure_in = read();
    for (std::size_t leaf = 0; leaf < leaves; ++leaf) a.back.history_in[leaf] = read();
    for (Table* table : {&a.back.parameters_out, &a.back.walls_out, &a.back.offsets_out}) *table = write();
  } else {
    a.pressure_out = write();
  }
  for (const auto& [of, rows] : kept)
    for (std::size_t leaf = 0; leaf < leaves; ++leaf) of->history_out[leaf] = write();
  const auto between = [&](int64_t rows) {
    double* values = reinterpret_cast<double*>(out[result++].data);
    return Table{{values, a.replicas}, {values + rows * a.lanes, a.replicas}, a.lanes};
  };
  a.hot = between(a.grains * int64_t{9});
  a.sphere = between(reader.size('S') * 3);
  a.cold = between(a.grains * int64_t{4});
  a.wall = between(reader.size('S') * a.of_wall);
  a.load = between(a.rows * int64_t{kLoad});
  a.touching = reinterpret_cast<unsigned char*>(out[result++].data);
  const bool layered = is_layered(which.law);
  for (const auto& [of, rows] : kept)
    for (std::size_t leaf = 0; leaf < leaves; ++leaf) {
      const std::string axes = histories(which.law)[leaf].axes;  // "P3B", "P1B"; of the rings "PQ2B"
      const bool apart = task != Task::forward && axes.size() == 3;
      of->history[leaf] = apart ? between(rows * int64_t{axes[1] - '0'}) : of->history_out[leaf];
    }
  for (const auto& [of, rows] : kept) {
    if (!layered) continue;
    of->layers = between(rows * int64_t{kOfLayers});
    of->segments = between(rows * points * 3);
    of->stored = reinterpret_cast<int*>(out[result++].data);
  }

  if (task == Task::adjoint) {
    a.back.input = a.load.value.at;
    for (double** array : {&a.back.state, &a.back.total, &a.back.history, &a.back.middle, &a.back.at_wall,
                           &a.back.of_grains, &a.back.of_contacts, &a.back.of_walls})
      *array = reinterpret_cast<double*>(out[result++].data);
  }

  const int spheres = a.grains * a.spheres;
  const int64_t most_rows = std::max<int64_t>(a.rows + int64_t{spheres}, wall_rows);
  threads_for(most_rows * std::max<int64_t>({12, 3 * points, a.lanes}));  // rows of tables; threads
  const Launcher launch(stream, which);
  if (task == Task::adjoint) go_back(launch, a);
  else go_forward(launch, a, rubs != 0, layered);
  return ffi::Error::Success();
}

template <Task task>
ffi::Error handle(void* stream, int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t, int64_t mixed,
                  int64_t periodic, int64_t unequal, int64_t rubs, ffi::RemainingArgs args, ffi::RemainingRets rets) {
  return in_words([&] {
    require(mixed == 0, "there is no mixed precision on GPUs");
    return call(task, law, variant, points, isotropic, periodic, unequal, rubs, stream, args, rets);
  });
}

// Before a program runs: a stream may be on its way into a graph when a call is made, and loading is no part of that.
template <Task task>
ffi::Error load(void* stream, int64_t law, int64_t variant, int64_t points, int64_t, int64_t, int64_t, int64_t periodic,
                int64_t unequal, int64_t rubs, ffi::RemainingArgs, ffi::RemainingRets) {
  return in_words([&] {
    const Launcher loads(stream, which_of(task, law, variant, points, periodic, unequal, rubs));
    return ffi::Error::Success();
  });
}

template <ffi::ExecutionStage stage = ffi::ExecutionStage::kExecute>
auto binding() {
  return with_arguments(ffi::Ffi::Bind<stage>().template Ctx<ffi::PlatformStream<void*>>());
}
constexpr auto kInitialize = ffi::ExecutionStage::kInitialize;

}  // namespace
}  // namespace cuda
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_advance, gmem::cuda::handle<gmem::Task::forward>, gmem::cuda::binding<>(),
                              {xla::ffi::Traits::kCmdBufferCompatible});
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_tangent, gmem::cuda::handle<gmem::Task::tangent>, gmem::cuda::binding<>(),
                              {xla::ffi::Traits::kCmdBufferCompatible});
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_adjoint, gmem::cuda::handle<gmem::Task::adjoint>, gmem::cuda::binding<>(),
                              {xla::ffi::Traits::kCmdBufferCompatible});
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_advance_load, gmem::cuda::load<gmem::Task::forward>,
                              gmem::cuda::binding<gmem::cuda::kInitialize>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_tangent_load, gmem::cuda::load<gmem::Task::tangent>,
                              gmem::cuda::binding<gmem::cuda::kInitialize>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_adjoint_load, gmem::cuda::load<gmem::Task::adjoint>,
                              gmem::cuda::binding<gmem::cuda::kInitialize>());
