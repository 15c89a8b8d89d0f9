// The arguments of the kernels: plain structures that the host and the device share.
//
// A lane is one replica: of B in each of the entries of the call's leading axis, L = entries times B in all. N grains
// of K spheres have P listed candidates; a sphere is named in up to C of them.

#pragma once

#include "physics/parameters.h"

namespace gmem {
namespace cuda {

constexpr int kChunk = 64;    // numbers that one thread sums up
constexpr int kItems = 32;    // grains that a block of `move` has
constexpr int kWorkers = 4;   // threads that sum up the forces on one of them
constexpr int kOfLayers = 6;  // numbers of Mindlin's `Layers`
constexpr int kLoad = 6;      // numbers of a contact: the force on its first sphere, and the point where it acts
// Of reverse mode (cuda/back.h): numbers of a grain at the beginning of a step, and midway; of `ContactInput`; those
// that every grain has of `GrainParameters`; and the parameters that contacts have derivatives by.
// At last, those that the contacts of a sphere give to it.
constexpr int kOfGrain = 19, kOfInput = 18, kOfConstants = 14, kOfContact = 7, kOfSphere = 12;

// Where the numbers of each entry begin; the step is zero where all share them.
template <class T>
struct Entries {
  T* at;
  long long step;

  T* of(int entry) const { return at + entry * step; }
};

// Number `row` of replica b in entry e is value.of(e)[row * stride + b], its derivative the same of `slope`.
struct Table {
  Entries<double> value, slope;
  int stride;
};

// Division by a number that is known when the kernels are launched; of numbers from 0 to 2^31 - 1.
struct Divisor {
  unsigned magic, shift;

  Divisor() = default;
  explicit Divisor(int by) : magic(0), shift(0) {
    while ((1ull << shift) < static_cast<unsigned long long>(by)) ++shift;
    magic = static_cast<unsigned>((((1ull << shift) - by) << 32) / by + 1);
  }

  int of(int number) const {
    const unsigned n = static_cast<unsigned>(number);
    return static_cast<int>((static_cast<unsigned>(static_cast<unsigned long long>(n) * magic >> 32) + n) >> shift);
  }
};

// Four numbers that a thread reads at once.
struct alignas(16) Four {
  int of[4];
};

// The histories of contacts between grains, or with walls that have friction.
struct Memories {
  Table history_in[kMaxHistory], history_out[kMaxHistory];
  // Between steps.
  Table history[kMaxHistory];  // as in the arrays of the call, but for Mindlin's rings, which these replace:
  Table layers;                // `Layers`, [rows, 6, L]
  Table segments;              // force and first ring, [rows, Q, 3, L]
  int* stored;                 // ... how many, [rows, L]
};

// The arrays of reverse mode beside those of the steps. "Bar" x is the derivative of the final results by x.
struct Backwards {
  // Bars of the results, and of the arguments but for fields and histories, which take the place of these in
  // `Arguments`.
  Table fields_in[kFields], pressure_in, history_in[kMaxHistory];
  Table parameters_out, walls_out, offsets_out;
  // Kept of every step:
  double* state;    // of the grains at its beginning, the fields in order, [T, N, kOfGrain, L]
  double* total;    // force and torque on them, [T, N, 6, L]
  double* history;  // of candidates that touch in it, at its beginning, [T, P, numbers of the law, L]
  // Of the step that is gone back through:
  double* middle;   // bars of the grains midway, with those of force and torque, [N, kOfGrain, L]
  double* input;    // bars of `ContactInput` of contacts that touch, [P, kOfInput, L]; forwards `load` lies here
  double* at_wall;  // bars of the walls by grains that touch them, [N, kWalls, L]
  // Sums over steps, in the end over all grains or candidates:
  double* of_grains;    // bars of their constants and of the spheres' places in them, [N, kOfConstants + 3 K, L]
  double* of_contacts;  // bars of parameters, [P, kOfContact, L]
  double* of_walls;     // bars of the walls by chunks of grains, [T, chunks, kWalls, L]
};

struct Arguments {
  int grains, spheres, rows, columns, points, steps;  // N, K, P, C, Q, T
  int replicas, lanes;                                // B, L
  Divisor by_replicas, by_lanes, by_spheres;
  int periodic;  // a bit for each axis along which the box is periodic
  bool isotropic, tangent;
  Entries<const int> first, second;     // spheres of a candidate, [P]
  Entries<const unsigned char> valid;   // [P]
  Entries<const Four> incidence;        // candidates of a sphere, plus P where it is the second one; [N K, C]
  Entries<const signed char> image;     // by how many edges of a periodic box the second sphere is moved, [P, 3]
  Entries<const double> offsets;        // sphere centres of a grain, [K, 3]
  Entries<const double> along_offsets;  // ... and their derivatives, where there are any, [K, 3, B]
  // Where spheres differ in radius: of those of a grain of size 1, and of grains; [K], [N].
  Entries<const double> radii, sizes;
  Table parameters, walls, grains_in[kFields];
  Table grains_out[kFields], pressure_out;  // values, or derivatives where they are wanted
  Memories contacts, at_walls;              // of the candidates, P; and of every sphere at `kPlanes` planes
  // Between steps.
  Table hot;     // position, velocity, spin, [N, 9, L]
  Table sphere;  // centres, [N K, 3, L]
  Table cold;    // orientation, [N, 4, L]
  Table wall;    // force of the walls, and their pressures summed over steps; if they have friction, its torque about
                 // the sphere's centre and its force; [N K, of_wall, L]
  int of_wall;   // 6; 12 if they have friction, or in reverse mode, which puts `Given` here on the way back
  Table load;    // of candidates that touch, [P, kLoad, L]
  unsigned char* touching;  // which candidates touch, and which spheres the walls (bits of planes that have friction),
                            // [P + N K, L]
  Backwards back;           // where that is wanted

  // How many chunks of kChunk hold `many` items.
  static int chunks(int many) { return (many + kChunk - 1) / kChunk; }
};

// Kernels from `take` on are of reverse mode, which has neither `collect` nor `leave`.
enum class GpuKernel {
  enter,
  remember,
  touch,
  move,
  move_alone,
  collect,
  leave,
  take,
  touch_back,
  gather_back,
  move_back,
  collect_walls,
  sum_up,
  leave_back
};
constexpr int kKernels = 14;
constexpr const char* kKernelNames[kKernels] = {"enter",     "remember",      "touch",  "move",       "move_alone",
                                                "collect",   "leave",         "take",   "touch_back", "gather_back",
                                                "move_back", "collect_walls", "sum_up", "leave_back"};
constexpr bool is_kernel_of(Task task, GpuKernel kernel) {
  if (task != Task::adjoint) return kernel < GpuKernel::take;
  return kernel != GpuKernel::collect && kernel != GpuKernel::leave;
}

}  // namespace cuda
}  // namespace gmem
