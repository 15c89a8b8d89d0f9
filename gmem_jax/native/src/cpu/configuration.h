// One configuration of some replicas, as a call has it, and the rows of its census.

#pragma once

#include <cstddef>
#include <cstdint>

#include "physics/parameters.h"

namespace gmem {

// The rows of the result.
// gmem_jax/physics/census.py: Census
enum CensusRow {
  kSphereContacts,
  kGrainContacts,
  kWallContacts,
  kLargestOverlap,
  kLargestSpeed,
  kDeviation,
  kOutside,
  kFinite,
  kCensusRows
};

// Pointers to the first of the replicas; rows are `stride` apart.
struct Configuration {
  int grains, spheres_per_grain, candidates;
  int periodic;                                // a bit for each axis along which the box is periodic
  std::ptrdiff_t stride;                       // doubles between two rows: replicas B of the innermost axis
  bool common;                                 // whether all replicas have one reference, [S, 3]
  const int32_t *first, *second, *grain_pair;  // of each candidate; grain pairs are below `candidates`
  const bool* valid;
  const int8_t* image;    // [candidates, 3]; null without periodic axes
  const double* radii;    // of the spheres of a grain of size 1; null where all radii are 1
  const double* sizes;    // of the grains; null likewise
  const double* offsets;  // sphere centres of a grain, [K, 3]
  const double* fields[kFields];
  const double* walls;  // lower and upper ones, [6]
  const double* edges;  // of the periodic cell, [3]
  const double* reference;
  double* result;  // [kCensusRows]

  int spheres() const { return grains * spheres_per_grain; }
};

}  // namespace gmem
