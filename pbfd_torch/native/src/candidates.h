// The contact part of a plan: candidates, what they touch, and what they are. They come sorted by both, so that every kind of pair
// is a run of its own, with a loop of its own.
#pragma once
#include "vectors.h"

namespace pbfd {

// How many there are: of candidates, of what anchors remember, and of what several candidates share.
struct CandidateSizes {
  int candidates, anchors, planes, solids, samples, forms;
  int uncommon = 0;  // laws of contact, between bodies too
};

template <class N, int D> struct Candidates {
  static constexpr int KINDS = D == 3 ? 12 : 2;  // of pairs, see kinds.h

  const int* counts;                    // [KINDS] candidates of each kind of pair
  const int *carrier, *solid, *form;    // node; which plane, or which other solid; which ellipsoid
  const int* anchor;                    // its place among what anchors remember; −1: it has none
  const int* law;                       // which of the uncommon laws it has; −1: the usual one
  const N *position, *radius, *margin;  // [D] on the node, [1], [1]
  const N *firmness, *grip, *deep;      // C⊥, μ (see laws.h), from which depth on it is a hazard
  const N *per_release, *per_width;     // [s/m]; one over that of friction [s/m], or over the stretch of an anchor [1/m]
  const N* plane;                       // [D + 1] of a half-space: normal and offset in the world
  // of another solid: rotation and position in the world [12], its sizes [6], its thickness where it is convex; what is sampled
  // has its samples from the first number of `grid` [4] on, so many along each axis as the others say (polyhedron.h: its faces)
  const N *frame, *measure, *thickness;
  const typename Kind<N>::Scalar* sample;  // the same for all worlds
  const int* grid;
  const N *ellipsoid, *axis, *lying;  // M [9] on the node; of a rim [3] its axis, and what part in it this one has (terms/lying.py)

  Candidates() = default;
  // Walks on over both arrays of a plan; samples: of all grids.
  Candidates(CandidateSizes s, const int*& ints, const N*& numbers, const typename Kind<N>::Scalar* samples) : sample(samples) {
    auto whole = [&](int count) { const int* here = ints; ints += count; return here; };
    auto real = [&](int count) { const N* here = numbers; numbers += count; return here; };
    const int n = s.candidates;
    counts = whole(KINDS), carrier = whole(n), solid = whole(n), form = whole(n), anchor = whole(n), law = whole(n), grid = whole(4 * s.solids);
    position = real(D * n), radius = real(n), margin = real(n);
    firmness = real(n), grip = real(n), deep = real(n), per_release = real(n), per_width = real(n);
    plane = real((D + 1) * s.planes);
    frame = real(12 * s.solids), measure = real(6 * s.solids), thickness = real(s.solids);
    ellipsoid = real(9 * s.forms), axis = real(3 * s.forms), lying = real(s.forms);
  }

  static int whole_numbers(CandidateSizes s) { return KINDS + 5 * s.candidates + 4 * s.solids; }
  static int real_numbers(CandidateSizes s) {
    return (7 + D) * s.candidates + (D + 1) * s.planes + 19 * s.solids + 13 * s.forms;
  }
};

}  // namespace pbfd
