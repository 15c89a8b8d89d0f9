// How the contacts of a candidate list are ordered and shared out. A plan depends on the list alone - not on threads,
// replicas or instruction sets - and fixes the order in which forces are summed.
//
// Grains are renumbered so that neighbours in space are neighbours in memory. They are divided into domains of about
// equal numbers of candidates. A candidate belongs to the domain of its lower-numbered grain; one thread computes a
// domain's contacts in order and adds the forces to that domain's grains at once. The forces of these contacts on a
// grain of another domain ("remote" forces) are summed up apart, and added when that grain is moved.

#pragma once

#include "cpu/problem.h"

#include <memory>
#include <vector>

namespace gmem {

// The arrays of gmem_jax.physics.pairs.Pairs that a plan is made from.
struct List {
  int grains, spheres_per_grain, rows;
  const int32_t* first;
  const int32_t* second;
  const bool* valid;
  const double* reference;  // sphere centres in box coordinates, [S, 3]
  const double* smallest;   // edge lengths of the box, [3]
  const int8_t* image;      // see `Image`, [rows, 3]; null without periodic axes
  const double* radii;      // of the spheres of a grain of size 1, [spheres_per_grain]; null where all radii are 1
  const double* sizes;      // of the grains; null where all radii are 1
};

// A plan and the memory it points to.
struct PlanStore {
  Plan plan;
  std::vector<int32_t> grain, domain_candidate, padding_row;
  std::vector<int32_t> remote_start, remote_contact_start, remote_contact_sphere;
  std::vector<Candidate> candidate;
  std::vector<int32_t> image;
  std::vector<Image> images;
  std::vector<Radii> radii;
  std::vector<Size> size;
};

// The plan of a list; plans of lists seen lately are kept. Throws std::invalid_argument if a candidate is not a pair of
// spheres of different grains.
std::shared_ptr<const PlanStore> plan_for(const List& list);

}  // namespace gmem
