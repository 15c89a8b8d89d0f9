// What the kernels are given: plain structures that the host and the device share.
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

// What a thread reads at once.
struct alignas(16) Four {
  int of[4];
};

// What is remembered of contacts between grains, or with walls that have friction.
struct Memories {
  Table history_in[kMaxHistory], history_out[kMaxHistory];
  // Between steps.
  Table history[kMaxHistory];  // as in the arrays of the call, but for Mindlin's rings, which these replace:
  Table layers;                // `Layers`, [rows, 6, L]
  Table segments;              // force and first ring, [rows, Q, 3, L]
  int* stored;                 // ... how many, [rows, L]
};

struct Arguments {
  int grains, spheres, rows, columns, points, steps;  // N, K, P, C, Q, T
  int replicas, lanes;                                // B, L
  Divisor by_replicas, by_lanes, by_spheres;
  int periodic;  // bit of each axis along which the box is
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
  int of_wall;   // 6, or 12
  Table load;    // of candidates that touch, [P, kLoad, L]
  unsigned char* touching;  // which candidates touch, and which spheres the walls (bits of planes that have friction),
                            // [P + N K, L]
};

enum class GpuKernel { enter, remember, touch, move, move_alone, collect, leave };

}  // namespace cuda
}  // namespace gmem
