// A driver without a GPU: the functions that cuda/launch.cc calls. It keeps the protocol of contexts, streams, capture and
// arguments, reads from each module what its kernels are given, and runs their CPU build (emulated.cc) on bytes that it
// copied at the launch. `gmem_mock_advance`, `gmem_mock_tangent` and `gmem_mock_adjoint` give calls of XLA's CPU a stream of
// this driver.

#include <elf.h>

#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <mutex>
#include <string>
#include <vector>

#include "emulated.h"
#include "xla/ffi/api/c_api.h"

namespace {

using gmem::cuda::Arguments;
using gmem::cuda::GpuKernel;
using gmem::cuda::Which;

enum {
  kOk = 0,
  kInvalidValue = 1,
  kOutOfMemory = 2,
  kInvalidImage = 200,
  kInvalidContext = 201,
  kNoBinary = 209,
  kNotFound = 500,
  kCaptureUnsupported = 900
};
enum { kRelaxed = 2, kMostThreads = 0, kMajor = 75, kMinor = 76 };

struct Context {
  int device;
};
struct Parameter {
  unsigned offset, size;
};
struct Function {
  Context* context;
  Which which;
  GpuKernel kernel;
  std::vector<Parameter> parameters;
  int most_threads;
};
using Module = std::map<std::string, Function>;
struct Launch {
  const Function* function;
  unsigned blocks, threads;
  std::vector<char> bytes;
};
struct Stream {
  Context* context;
  bool capturing;
  std::vector<Launch> graph;
};

std::recursive_mutex mutex;
std::map<int, Context> contexts;
std::map<int, Stream> streams;
std::map<std::string, int> counts, failures;
std::string complaints, folder;
int device = 0, replays = 0, architecture = 90;
bool initializes = true;
thread_local std::vector<Context*> stack;
thread_local int capture_mode = 0;
thread_local bool captures = false;

void complain(const std::string& what) { complaints += what + "\n"; }

// Counts a call, and fails it where that was asked for.
int called(const std::string& function) {
  const std::lock_guard<std::recursive_mutex> lock(mutex);
  const auto fails = failures.find(function);
  return ++counts[function], fails != failures.end() && fails->second <= counts[function] ? kOutOfMemory : kOk;
}

template <class T>
T number_at(const char* place) {
  T number;
  std::memcpy(&number, place, sizeof number);
  return number;
}

// What the kernels of a cubin are given, and in blocks of how many threads; see the attributes EIATTR_KPARAM_INFO and
// EIATTR_MAX_THREADS that `cuobjdump -elf` prints.
Module kernels_of(const char* image) {
  Module found;
  const auto header = number_at<Elf64_Ehdr>(image);
  const auto section = [&](int n) { return number_at<Elf64_Shdr>(image + header.e_shoff + n * sizeof(Elf64_Shdr)); };
  const char* names = image + section(header.e_shstrndx).sh_offset;
  for (int s = 0; s < header.e_shnum; ++s) {
    const std::string name = names + section(s).sh_name, prefix = ".nv.info.";
    if (name.rfind(prefix, 0) != 0) continue;
    Function& kernel = found[name.substr(prefix.size())];
    const char* at = image + section(s).sh_offset;
    for (const char* end = at + section(s).sh_size; at < end; at += 4) {
      const int format = at[0], attribute = at[1], size = number_at<std::uint16_t>(at + 2);
      if (format != 4) continue;
      if (attribute == 0x05) kernel.most_threads = number_at<int>(at + 4);
      if (attribute == 0x17) {
        const std::size_t ordinal = number_at<std::uint16_t>(at + 8);
        if (kernel.parameters.size() <= ordinal) kernel.parameters.resize(ordinal + 1);
        kernel.parameters[ordinal] = {number_at<std::uint16_t>(at + 10), number_at<unsigned>(at + 12) >> 18};
      }
      at += size;
    }
  }
  return found;
}

// The same of PTX, where arguments lie one after another.
Module kernels_of_text(const std::string& text) {
  Module found;
  const std::string begin = ".entry ", threads = ".maxntid ";
  for (std::size_t at = 0; (at = text.find(begin, at)) != std::string::npos; ++at) {
    const std::size_t name = at + begin.size();
    const auto size = static_cast<unsigned>(std::stoi(text.substr(text.find('[', at) + 1)));
    const int most = std::stoi(text.substr(text.find(threads, at) + threads.size()));
    found[text.substr(name, text.find('(', at) - name)] = {nullptr, {}, {}, {{0, size}, {size, sizeof(int)}}, most};
  }
  return found;
}

// The kept file that has the same bytes (and a checksum after them) says of which law they are.
bool identify(const char* image, Which& which) {
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    std::ifstream file(entry.path(), std::ios::binary);
    const std::string bytes{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
    const std::string name = entry.path().filename();
    const std::size_t law = name.find("-law");
    if (law == std::string::npos || bytes.size() < 1000) continue;
    if (std::memcmp(bytes.data(), image, bytes.size() - 16) != 0) continue;
    const auto says = [&](const char* word) { return name.find(word) != std::string::npos; };
    which = {static_cast<gmem::Law>(name[law + 4] - '0'),
             static_cast<gmem::Variant>(name[law + 5] - '0'),
             says("-tangent")   ? gmem::Task::tangent
             : says("-adjoint") ? gmem::Task::adjoint
                                : gmem::Task::forward,
             says("-periodic"),
             says("-unequal"),
             says("-rubs")};
    return true;
  }
  return false;
}

// Of a cubin, as 90.
int architecture_of(const char* image) {
  const auto header = number_at<Elf64_Ehdr>(image);
  return header.e_ident[EI_OSABI] == 0x33 ? header.e_flags & 0xff : header.e_flags >> 8 & 0xff;
}

void execute(const Launch& launch) {
  const Function& f = *launch.function;
  if (f.parameters.size() != 2 || f.parameters[0].size != sizeof(Arguments) || f.parameters[1].size != sizeof(int))
    return complain("a kernel's arguments are not those of this side");
  Arguments a;
  std::memcpy(static_cast<void*>(&a), launch.bytes.data() + f.parameters[0].offset, sizeof a);
  const int step = number_at<int>(launch.bytes.data() + f.parameters[1].offset);
  const bool shared_out = f.kernel == GpuKernel::move;  // where some threads do the work of one
  const unsigned threads = launch.blocks * (shared_out ? gmem::cuda::kItems : launch.threads);
  const auto run = gmem::cuda::run_of(f.which);
  for (unsigned thread = 0; thread < threads; ++thread) run(f.kernel, a, step, static_cast<int>(thread));
}

Stream& stream_of(int number) {
  contexts.emplace(number, Context{number});
  return streams.emplace(number, Stream{&contexts[number], false, {}}).first->second;
}

XLA_FFI_Error* stream_for_call(XLA_FFI_Stream_Get_Args* args) {
  args->stream = &stream_of(device);
  return nullptr;
}

using Handler = XLA_FFI_Error* (*)(XLA_FFI_CallFrame*);

struct Handlers {
  Handler initialize, execute;
};

// As XLA runs a call on a GPU, while another context is current.
XLA_FFI_Error* call(XLA_FFI_CallFrame* frame, const Handlers& handlers) {
  if (frame->extension_start) return handlers.execute(frame);  // what the handler is
  const std::lock_guard<std::recursive_mutex> lock(mutex);
  std::vector<char> room(frame->api->struct_size);
  std::memcpy(room.data(), frame->api, room.size());
  auto& api = *reinterpret_cast<XLA_FFI_Api*>(room.data());
  api.XLA_FFI_Stream_Get = stream_for_call;
  XLA_FFI_CallFrame own = *frame;
  own.api = &api;
  Context other{-1};
  stack = {&other};
  Stream& stream = stream_of(device);
  stream.graph.clear();
  XLA_FFI_Error* error = nullptr;
  own.stage = XLA_FFI_ExecutionStage_INITIALIZE;
  if (initializes) error = handlers.initialize(&own);
  own.stage = XLA_FFI_ExecutionStage_EXECUTE;
  stream.capturing = captures = replays > 0;
  if (!error) error = handlers.execute(&own);
  stream.capturing = captures = false;
  if (stack != std::vector<Context*>{&other}) complain("the stack of contexts is another one after the call");
  if (capture_mode != 0) complain("the mode of capture is another one after the call");
  for (int n = 0; !error && n < replays; ++n)
    for (const Launch& launch : stream.graph) execute(launch);
  return error;
}

Handlers advance, tangent, adjoint;

}  // namespace

extern "C" {

int cuDriverGetVersion(int* version) { return *version = 99000, kOk; }
int cuStreamGetCtx(Stream* stream, Context** context) {
  if (const int failed = called(__func__)) return failed;
  return *context = stream->context, kOk;
}
int cuCtxPushCurrent_v2(Context* context) {
  if (const int failed = called(__func__)) return failed;
  return stack.push_back(context), kOk;
}
int cuCtxPopCurrent_v2(Context** context) {
  called(__func__);
  if (stack.empty()) return complain("there is no context to pop"), kInvalidContext;
  *context = stack.back();
  return stack.pop_back(), kOk;
}
int cuCtxGetDevice(int* number) {
  if (const int failed = called(__func__)) return failed;
  return *number = stack.back()->device, kOk;
}
int cuDeviceGetAttribute(int* value, int attribute, int) {
  if (const int failed = called(__func__)) return failed;
  return *value = attribute == kMajor ? architecture / 10 : architecture % 10,
         attribute == kMajor || attribute == kMinor ? kOk : kInvalidValue;
}
int cuThreadExchangeStreamCaptureMode(int* mode) {
  if (const int failed = called(__func__)) return failed;
  return std::swap(*mode, capture_mode), kOk;
}
int cuModuleLoadData(Module** module, const void* code) {
  if (const int failed = called(__func__)) return failed;
  if (captures) ++counts["loads while capturing"];
  if (captures && capture_mode != kRelaxed) return kCaptureUnsupported;
  const char* image = static_cast<const char*>(code);
  Which which{};
  if (!identify(image, which)) return kInvalidImage;
  const bool is_cubin = std::memcmp(image, ELFMAG, SELFMAG) == 0;
  if (is_cubin && architecture_of(image) != architecture) return kNoBinary;
  *module = new Module(is_cubin ? kernels_of(image) : kernels_of_text(image));
  for (std::size_t n = 0; n < std::size(gmem::cuda::kKernelNames); ++n) {
    const auto found = (*module)->find(gmem::cuda::kKernelNames[n]);
    if (found == (*module)->end()) continue;
    Function& kernel = found->second;
    kernel.context = stack.back(), kernel.which = which, kernel.kernel = static_cast<GpuKernel>(n);
  }
  return kOk;
}
int cuModuleGetFunction(Function** function, Module* module, const char* name) {
  if (const int failed = called(__func__)) return failed;
  const auto found = module->find(name);
  return found == module->end() ? kNotFound : (*function = &found->second, kOk);
}
int cuFuncGetAttribute(int* value, int attribute, Function* function) {
  if (const int failed = called(__func__)) return failed;
  return *value = function->most_threads, attribute == kMostThreads ? kOk : kInvalidValue;
}
int cuLaunchKernel(Function* f, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned also, unsigned too,
                   unsigned shared, Stream* stream, void** parameters, void** extra) {
  if (const int failed = called(__func__)) return failed;
  if (stack.back() != f->context || stream->context != f->context) return kInvalidContext;
  if (!x || y != 1 || z != 1 || !threads || threads > static_cast<unsigned>(f->most_threads) || also != 1 || too != 1 ||
      shared || extra)
    return kInvalidValue;
  Launch launch{f, x, threads, {}};
  for (std::size_t n = 0; n < f->parameters.size(); ++n) {
    const Parameter& one = f->parameters[n];
    launch.bytes.resize(std::max<std::size_t>(launch.bytes.size(), one.offset + one.size));
    std::memcpy(launch.bytes.data() + one.offset, parameters[n], one.size);
  }
  if (stream->capturing) {
    stream->graph.push_back(std::move(launch));
  } else {
    execute(launch);
  }
  return kOk;
}
int cuGetErrorString(int code, const char** text) {
  if (const int failed = called(__func__)) return failed;
  static const std::string out = "out of memory", other = "another error";
  return *text = (code == kOutOfMemory ? out : other).c_str(), kOk;
}

// For the test. The library's handlers, and the folder of compiled kernels.
void mock_handlers(Handler load_advance, Handler run_advance, Handler load_tangent, Handler run_tangent,
                   Handler load_adjoint, Handler run_adjoint, const char* kept) {
  advance = {load_advance, run_advance}, tangent = {load_tangent, run_tangent}, adjoint = {load_adjoint, run_adjoint};
  folder = kept;
}
// Calls run on this device from now on, captured and then replayed so often, or (0) at once; and before that they are
// initialized, or not. Counts begin anew.
void mock_begin(int on, int so_often, int before) {
  device = on, replays = so_often, initializes = before, architecture = 90;
  counts.clear(), failures.clear(), complaints.clear();
}
// From the n-th call on, counted from one, a function of the driver shall fail.
void mock_fail(const char* function, int n) { failures[function] = n; }
// GPUs are of another architecture, as 120 for sm_120.
void mock_architecture(int number) { architecture = number; }
int mock_count(const char* function) { return counts[function]; }
const char* mock_complaints() { return complaints.c_str(); }

XLA_FFI_Error* gmem_mock_advance(XLA_FFI_CallFrame* frame) { return call(frame, advance); }
XLA_FFI_Error* gmem_mock_tangent(XLA_FFI_CallFrame* frame) { return call(frame, tangent); }
XLA_FFI_Error* gmem_mock_adjoint(XLA_FFI_CallFrame* frame) { return call(frame, adjoint); }

}  // extern "C"
