// What the kernels are given: plain structures that the host and the device share.
//
// A lane is one replica: of B in each of the entries of the call's leading axis, L = entries times B in all. N grains
// of K spheres have P listed candidates. A candidate has two sides, its two grains, and each has a copy of the history.

#pragma once

#include "physics/parameters.h"

namespace gmem {
namespace cuda {

constexpr int kChunk = 64;  // grains whose pressures are summed by one thread

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
  long long stride;
};

// A candidate seen from one of its grains.
// gmem_jax/native/cuda.py: sides_of
struct Side {
  int mine, other;  // spheres; the latter as ~s where it is the one listed first
  int row;          // in the list
};

struct Arguments {
  int grains, spheres, rows, points, steps;  // N, K, P, Q, T
  int replicas, lanes;                       // B, L
  bool isotropic;
  Entries<const int> start;  // the sides of each grain: start[g] to start[g + 1], [N + 1]
  Entries<const Side> side;  // [2 P]
  Entries<const int> place;  // number of each candidate's side that is listed first; -1 for padding, [P]
  Entries<const double> offsets, arm;
  Table parameters, walls, grains_in[kFields], history_in[kMaxHistory];
  Table grains_out[kFields], history_out[kMaxHistory], pressure_out;  // values, or derivatives where they are wanted
  // Between steps: a grain reads its neighbours' numbers of this step while they write those of the next.
  Table hot[2];     // position, velocity, spin, [N, 9, L]
  Table sphere[2];  // centres, [N K, 3, L]
  Table cold;       // orientation, [N, 4, L]
  Table pressure;   // summed over steps, [N, 3, L]
  Table history;    // beside rings, [2 P, kHistory, L]
  Table segments;   // of rings of the Mindlin law: force and first ring, [2 P, Q, 3, L]
  int* stored;      // ... how many, [2 P, L]
};

enum class GpuKernel { enter, advance, collect, leave };

}  // namespace cuda
}  // namespace gmem
