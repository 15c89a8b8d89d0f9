// XLA's custom call on a GPU: finds the arrays, and puts the kernels of all steps into XLA's stream without waiting.
//
// Arrays have one leading axis, of size one or of the full size. What is needed between steps comes as further results,
// so that XLA knows of all memory and may keep the launches as a graph.

#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

#include "call/signature.h"
#include "cuda/launch.h"

namespace gmem {
namespace cuda {

namespace {

namespace ffi = xla::ffi;

constexpr int kOfPack = 5;  // arguments that belong to a pack

// Beside the letters of call/signature.h: starts G = N + 1, sides M = 2 P, numbers of a cold grain C, of a history H,
// derivatives and values D, lanes L.
// gmem_jax/native/cuda.py: run, sides_of, between_steps
Wants arguments_of(Task task, Law law) {
  const Wants pack = {{"starts", "G", ffi::S32}, {"sides", "M3", ffi::S32}, {"places", "P", ffi::S32},
                      {"offsets", "K3"},         {"arms", ""}};
  const Wants arrays = fields_of_grains() + numbers_of_steps() + histories(law);
  const Wants all = fields_of_grains() + pack + numbers_of_steps() + histories(law);
  return task == Task::tangent ? all + arrays : all;
}

Wants results_of(Law law) {
  const Wants between = {{"hot", "2DN9L"},  {"spheres", "2DS3L"},  {"cold", "DNCL"},
                         {"sums", "DN3L"}, {"memories", "DMHL"}};
  const Wants layered = {{"segments", "DMQ3L"}, {"stored", "ML", ffi::S32}};
  const Wants all = fields_of_grains() + pressures() + histories(law) + between;
  return is_layered(law) ? all + layered : all;
}

int numbers_remembered(Law law) {
  return with_law(law, Variant::exact, [](auto law) { return static_cast<int>(decltype(law)::kHistory); });
}

template <class T>
Entries<T> entries(const Array& array) {
  return {reinterpret_cast<T*>(array.data), array.step[0]};
}

int threads_for(int64_t many) {
  require(many < (int64_t{1} << 31) - kBlock, "too many replicas at once for a GPU; use fewer");
  return static_cast<int>(many);
}

ffi::Error call(Task task, int64_t law, int64_t variant, int64_t points, int64_t isotropic, void* stream,
                ffi::RemainingArgs args, ffi::RemainingRets rets) {
  require_law(law, variant, points);
  const Which which{static_cast<Law>(law), static_cast<Variant>(variant), task};
  const Wants wanted = arguments_of(task, which.law), given = results_of(which.law);
  require(args.size() == wanted.size() && rets.size() == given.size(),
          "the number of arguments or results is not that of the friction law");
  std::vector<ffi::AnyBuffer> results;
  for (std::size_t i = 0; i < rets.size(); ++i) results.push_back(*rets.get<ffi::AnyBuffer>(i).value());
  const auto dims = results[0].dimensions();
  require(dims.size() == 4, "positions need four axes");
  Reader reader({dims[0]});
  reader.size('R') = kParameters;
  reader.size('W') = kWalls;
  reader.size('Q') = points;
  reader.size('C') = 4;
  reader.size('D') = task == Task::forward ? 1 : 2;
  reader.size('H') = numbers_remembered(which.law);
  std::vector<Array> in, out;
  for (std::size_t i = 0; i < args.size(); ++i)
    in.push_back(reader.read(args.get<ffi::AnyBuffer>(i).value(), wanted[i]));
  reader.size('L') = dims[0] * reader.size('B');
  for (std::size_t i = 0; i < results.size(); ++i) out.push_back(reader.read(results[i], given[i]));
  const std::size_t leaves = histories(which.law).size(), fresh = kFields + 1 + leaves;
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
  require(a.grains > 0 && a.spheres > 0, "there is no grain");
  require(reader.size('S') == reader.size('N') * reader.size('K') && reader.size('G') == reader.size('N') + 1 &&
              reader.size('M') == 2 * reader.size('P'),
          "spheres, sides or their starts are not as many as grains and candidates have");

  // Tables in the order of arguments and results.
  std::size_t argument = 0, slope = kFields + kOfPack + 2 + leaves, result = 0;
  const auto read = [&] {
    Table table{entries<double>(in[argument++]), {nullptr, 0}, a.replicas};
    if (task == Task::tangent) table.slope = entries<double>(in[slope++]);
    return table;
  };
  const auto write = [&] { return Table{entries<double>(out[result++]), {nullptr, 0}, a.replicas}; };
  for (Table& field : a.grains_in) field = read();
  a.start = entries<const int>(in[argument++]);
  a.side = entries<const Side>(in[argument++]);
  a.side.step /= 3;
  a.place = entries<const int>(in[argument++]);
  a.offsets = entries<const double>(in[argument++]);
  a.arm = entries<const double>(in[argument++]);
  a.parameters = read();
  a.walls = read();
  for (std::size_t leaf = 0; leaf < leaves; ++leaf) a.history_in[leaf] = read();
  for (Table& field : a.grains_out) field = write();
  a.pressure_out = write();
  for (std::size_t leaf = 0; leaf < leaves; ++leaf) a.history_out[leaf] = write();
  const auto between = [&](double* values, int64_t rows) {
    return Table{{values, a.replicas}, {values + rows * a.lanes, a.replicas}, a.lanes};
  };
  const auto next = [&] { return reinterpret_cast<double*>(out[result++].data); };
  const auto both = [&](Table (&tables)[2], int64_t rows) {
    double* values = next();
    tables[0] = between(values, rows);
    tables[1] = between(values + reader.size('D') * rows * a.lanes, rows);
  };
  both(a.hot, a.grains * int64_t{9});
  both(a.sphere, reader.size('S') * 3);
  a.cold = between(next(), a.grains * int64_t{4});
  a.pressure = between(next(), a.grains * int64_t{3});
  a.history = between(next(), reader.size('M') * reader.size('H'));
  if (is_layered(which.law)) {
    a.segments = between(next(), reader.size('M') * points * 3);
    a.stored = reinterpret_cast<int*>(next());
  }

  const int of_grains = threads_for(reader.size('N') * a.lanes);
  const int of_rows = threads_for(std::max<int64_t>(3, a.rows) * a.lanes);
  const Launcher launch(stream, which);
  launch(GpuKernel::enter, of_grains, a);
  for (int step = 0; step < a.steps; ++step) launch(GpuKernel::advance, of_grains, a, step);
  launch(GpuKernel::collect, threads_for((a.grains + kChunk - 1) / kChunk * int64_t{3} * a.lanes), a);
  launch(GpuKernel::leave, of_rows, a);
  return ffi::Error::Success();
}

template <Task task>
ffi::Error handle(void* stream, int64_t law, int64_t variant, int64_t points, int64_t isotropic, int64_t,
                  int64_t mixed, ffi::RemainingArgs args, ffi::RemainingRets rets) {
  return in_words([&] {
    require(mixed == 0, "there is no mixed precision on GPUs");
    return call(task, law, variant, points, isotropic, stream, args, rets);
  });
}

auto binding() { return with_arguments(ffi::Ffi::Bind().Ctx<ffi::PlatformStream<void*>>()); }

}  // namespace
}  // namespace cuda
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_advance, gmem::cuda::handle<gmem::Task::forward>, gmem::cuda::binding(),
                              {xla::ffi::Traits::kCmdBufferCompatible});
XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_cuda_tangent, gmem::cuda::handle<gmem::Task::tangent>, gmem::cuda::binding(),
                              {xla::ffi::Traits::kCmdBufferCompatible});
