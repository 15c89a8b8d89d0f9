// The XLA custom call of a census: each index into the leading axes is a configuration of the innermost's replicas.

#include <cstdint>
#include <vector>

#include "call/signature.h"
#include "cpu/configuration.h"
#include "cpu/problem.h"
#include "cpu/team.h"

namespace gmem {

namespace {

namespace ffi = xla::ffi;

// gmem_jax/native/census.py: Listed, Seen
enum CensusArgument {
  kOne,
  kOther,
  kIsValid,
  kGrainPair,
  kTurns,
  kRadiiOfSpheres,
  kSizesOfGrains,
  kOffsetsOfSpheres,
  kCommonReference,
  kFieldsOfGrains,
  kPlanesOfBox = kFieldsOfGrains + kFields,
  kEdges,
  kOwnReference
};

Wants arguments_of_census() {
  const Wants listed = {{"first spheres", "P", ffi::S32},
                        {"second spheres", "P", ffi::S32},
                        {"validities", "P", ffi::PRED},
                        {"grain pairs", "P", ffi::S32},
                        {"images", "PI", ffi::S8},
                        {"radii", "KU"},
                        {"sizes", "NU"},
                        {"offsets", "K3"},
                        {"common reference", "S3C"}};
  return listed + fields_of_grains() + Wants{{"walls", "6B"}, {"edges", "3B"}, {"own reference", "O3B"}};
}

ffi::Error count(int64_t periodic, int64_t unequal, ffi::RemainingArgs args, ffi::RemainingRets rets) {
  require_axes(periodic);
  const Wants wanted = arguments_of_census();
  require(args.size() == wanted.size() && rets.size() == 1, "the number of arguments or results is not a census's");
  const ffi::AnyBuffer result = *rets.get<ffi::AnyBuffer>(0).value();
  const auto dims = result.dimensions();
  require(dims.size() >= 2, "a census needs two axes");
  const std::vector<int64_t> batch(dims.begin(), dims.end() - 2);
  Reader reader(batch);
  reader.size('I') = periodic ? 3 : 0;
  reader.size('U') = unequal ? 1 : 0;
  reader.size('R') = kCensusRows;
  std::vector<Array> in;
  for (std::size_t i = 0; i < args.size(); ++i)
    in.push_back(reader.read(args.get<ffi::AnyBuffer>(i).value(), wanted[i]));
  const Array out = reader.read(result, {"census", "RB"});
  for (std::size_t axis = 0; axis < batch.size(); ++axis)
    require(batch[axis] == dims[axis], "the census differs in its leading axes");
  const bool common = reader.size('C') == 1;
  require(reader.size('N') > 0 && reader.size('K') > 0, "there is no grain");
  require(reader.size('S') == reader.size('N') * reader.size('K'), "there are not as many spheres as the grains have");
  require(common || (reader.size('C') == 0 && reader.size('O') == reader.size('S')),
          "the reference is neither common nor of each replica");

  Configuration c{};
  c.grains = static_cast<int>(reader.size('N'));
  c.spheres_per_grain = static_cast<int>(reader.size('K'));
  c.candidates = static_cast<int>(reader.size('P'));
  c.periodic = static_cast<int>(periodic);
  c.stride = reader.size('B');
  c.common = common;
  std::vector<int64_t> index(batch.size(), 0);
  int64_t entries = 1;
  for (const int64_t n : batch) entries *= n;
  const Threads threads(thread_count());
  for (int64_t entry = 0; entry < entries; ++entry) {
    const auto data = [&](int i) { return in[i].data; };
    const auto doubles = [&](int i) { return reinterpret_cast<const double*>(data(i)) + in[i].at(index); };
    const auto integers = [&](int i) { return reinterpret_cast<const int32_t*>(data(i)) + in[i].at(index); };
    c.first = integers(kOne), c.second = integers(kOther), c.grain_pair = integers(kGrainPair);
    c.valid = reinterpret_cast<const bool*>(data(kIsValid)) + in[kIsValid].at(index);
    c.image = periodic ? reinterpret_cast<const int8_t*>(data(kTurns)) + in[kTurns].at(index) : nullptr;
    c.radii = unequal ? doubles(kRadiiOfSpheres) : nullptr;
    c.sizes = unequal ? doubles(kSizesOfGrains) : nullptr;
    c.offsets = doubles(kOffsetsOfSpheres);
    for (int f = 0; f < kFields; ++f) c.fields[f] = doubles(kFieldsOfGrains + f);
    c.walls = doubles(kPlanesOfBox), c.edges = doubles(kEdges);
    c.reference = doubles(common ? kCommonReference : kOwnReference);
    c.result = reinterpret_cast<double*>(out.data) + out.at(index);
    best_kernel(Task::forward, static_cast<std::size_t>(c.stride)).census(c, threads.count);
    for (int axis = static_cast<int>(batch.size()) - 1; axis >= 0 && ++index[axis] == batch[axis]; --axis)
      index[axis] = 0;
  }
  return ffi::Error::Success();
}

ffi::Error handle_census(int64_t periodic, int64_t unequal, ffi::RemainingArgs args, ffi::RemainingRets rets) {
  return in_words([&] { return count(periodic, unequal, args, rets); });
}

auto binding() {
  return ffi::Ffi::Bind().Attr<int64_t>("periodic").Attr<int64_t>("unequal").RemainingArgs().RemainingRets();
}

}  // namespace
}  // namespace gmem

XLA_FFI_DEFINE_HANDLER_SYMBOL(gmem_census, gmem::handle_census, gmem::binding());
