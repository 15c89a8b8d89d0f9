// What a call is asked to do, in plain structures shared by the handler and the kernels of every instruction set.
//
// One call runs all steps of one bin for all replicas. Its words:
//
//   pack    a candidate list (as a plan) and the shape of a grain, which replicas may share.
//   plan    the candidates sorted for memory and threads, with grains and spheres numbered anew (plan.h).
//   lane    one of the W doubles of a vector of the CPU. In most blocks a lane has a replica (`ReplicaArrays`).
//   block   the work of a team of threads at once: W replicas of one pack, each in a lane (replicas.h), or one replica
//           whose grains and contacts fill the lanes (packed.h). These two are the modes of an `Engine` (block.h).
//   unit    the grains of one vector: one grain of W replicas, or W grains of one replica.
//   chunk   16 grains, which a thread takes at once. Wall forces are summed over each chunk, then over the chunks.
//   domain  the contacts that a thread takes at once: those whose lower-numbered grain is in one part of the pack.
//   remote  the forces of a domain's contacts on a grain of another domain; their sum waits until that grain is moved.
//
// Most candidates are apart for many steps. `Engine::travel` is how much closer any two spheres can have come since the
// call began: twice what the fastest grain can have moved and turned, summed over the steps. When a candidate is found
// apart by some gap it cannot touch before `travel` has grown by that gap; that travel is its `next_check`, and until
// then a step reads this one number of it and no more. Both are upper bounds, so that no contact is missed.

#pragma once

#include <cstddef>
#include <cstdint>

#include "physics/parameters.h"

namespace gmem {

constexpr int kMaxWidth = 8;

// Sizes common to all replicas, and what they run.
struct Problem {
  Task task;
  Law law;
  Variant variant;
  bool isotropic;
  bool history_aliased;   // the histories' results already hold the arguments
  int points;             // Q of the Mindlin law
  int grains;             // N
  int spheres_per_grain;  // K
  std::ptrdiff_t stride;  // doubles between two rows of an array: replicas B of the innermost axis
  bool mixed = false;     // contacts in single precision; forward only
  int periodic = 0;       // a bit for each axis along which the box is periodic
  bool rubs = false;      // walls have friction; not in mixed precision

  int spheres() const { return grains * spheres_per_grain; }
  int wall_rows() const { return kPlanes * spheres_per_grain; }  // of a grain in the histories of walls
};

// A candidate contact, in the numbering of its plan. The force goes from sphere `one` to sphere `other`, as listed.
struct Candidate {
  int32_t one, other;              // spheres
  int32_t grain_one, grain_other;  // their grains
  int32_t remote;                  // where its domain sums up the forces on the grain of another domain, or -1
  int32_t remote_contact;          // its number among the contacts that have such a sum, or -1
  int32_t row;                     // in the arrays of the call

  // Of two grains in different domains that of the lower number is at home, the other away.
  bool away_is_one() const { return grain_one > grain_other; }
  int32_t home() const { return away_is_one() ? grain_other : grain_one; }
  int32_t away() const { return away_is_one() ? grain_one : grain_other; }
};

// By how many edges of a periodic box the second sphere of a candidate is moved along each axis.
struct alignas(32) Image {
  double x, y, z, unused = 0.0;
};

// Of a candidate between spheres i and j, where spheres differ in radius R.
struct alignas(32) Radii {
  double reach;   // R_i + R_j
  double lean;    // (R_i - R_j) / 2: by how much the contact is beyond the place halfway between the spheres, towards j
  double root;    // the root of the harmonic mean, 2 R_i R_j / reach
  double square;  // the square of reach
};

// Powers of the size of a grain.
struct Size {
  double one, cube, inverse_cube, inverse_fifth;
};

// The candidate list, sorted for memory and threads; see plan.h. Grains and spheres are numbered anew.
struct Plan {
  int candidates;
  int domains;
  int remotes;
  int remote_contacts;
  int padding;                      // rows of the list without a candidate
  const int32_t* grain;             // number in the call of each grain, [N]
  const Candidate* candidate;       // by domain
  const int32_t* image;             // place in `images` for each candidate and a dummy; null without periodic axes
  const Image* images;              // the different images; the first moves nothing
  const Radii* radii;               // of each candidate and of a dummy; null where all radii are 1
  const Size* size;                 // of each grain, [N]; null where all radii are 1
  double largest;                   // the largest size of a grain
  double far;                       // a larger distance of spheres counts as this one: see `next_check`
  const int32_t* domain_candidate;  // first candidate of each domain, [domains + 1]
  const int32_t* remote_start;      // the remotes of each grain: remote_start[g] to remote_start[g + 1], [N + 1]
  // The contacts in the remotes of each grain, likewise; and the sphere of that grain in each, [remote_contacts].
  const int32_t* remote_contact_start;
  const int32_t* remote_contact_sphere;
  const int32_t* padding_row;  // [padding]

  const Image& image_of(std::size_t c) const { return images[image[c]]; }
};

struct Pack {
  const Plan* plan;
  const double* offsets;  // sphere centres in a grain, [K, 3]
  const double* radii;    // of these spheres, or null where all radii of the pack are 1, [K]
};

// One replica: pointers to its first element; rows are `stride` apart.
struct ReplicaArrays {
  const double* grains_in[kFields];
  double* grains_out[kFields];
  const double* history_in[kMaxHistory];
  double* history_out[kMaxHistory];
  const double* wall_history_in[kMaxHistory];  // null where walls have no friction
  double* wall_history_out[kMaxHistory];
  const double* parameters;
  const double* walls;
  double* pressure;
  int steps;
  const double* offsets;  // only in `Block::slopes`, [K, 3]
  // Only in `Block::bars`, where "in" are derivatives by the results, and "out" are derivatives by the arguments:
  double* parameters_out;
  double* walls_out;
  double* offsets_out;
};

struct Block {
  const Pack* pack;
  const ReplicaArrays* lanes;
  const ReplicaArrays* slopes;      // derivatives of the arguments along a direction, and of results that are tangents
  const ReplicaArrays* bars;        // in reverse mode, derivatives by the results and by the arguments
  const ReplicaArrays* bar_slopes;  // derivatives of `bars` along the direction
  int count;                        // 1 to W, or to 2 W where it is wide
  bool packed;                      // the lanes of the CPU are grains and contacts of one replica
  bool wide = false;                // in mixed precision: two vectors of doubles to one of floats
};

// The threads that share one block; see team.h.
class Team;

// Hands out aligned pieces of the scratch memory; every thread of a team repeats the same sequence. With `base` null it
// only counts.
struct Arena {
  char* base;
  std::size_t used = 0;

  template <class T>
  T* take(std::size_t count) {
    T* piece = reinterpret_cast<T*>(base + used);
    used += (count * sizeof(T) + 63) / 64 * 64;
    return piece;
  }
};

struct Configuration;  // see configuration.h

// The functions compiled for an instruction set. `census` is null where they are compiled for derivatives.
struct InstructionSet {
  const char* name;
  int width;
  std::size_t (*scratch_bytes)(const Problem&, const Block&);
  void (*run)(const Problem&, const Block&, Team&, int rank, void* scratch);
  void (*census)(const Configuration&, int threads);
};

// The best instruction set of this CPU. In derivatives the lanes are replicas, and few replicas are done sooner in
// narrow vectors. Second derivatives always have narrow vectors: native/build.py says why.
const InstructionSet& best_kernel(Task task, std::size_t replicas);

}  // namespace gmem
