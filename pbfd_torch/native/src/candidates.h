// The contact part of a plan: candidates, what they touch, and what they are. They come sorted by both, so that every kind of pair
// is a run of its own, with a loop of its own.
#pragma once
#include "vectors.h"

namespace pbfd {

// How many there are.
struct CandidateSizes {
  int candidates, planes;
};

template <class N, int D> struct Candidates {
  static constexpr int KINDS = 2;  // of pairs, see kinds.h

  const int* counts;                    // [KINDS] candidates of each kind of pair
  const int *carrier, *solid;           // node; which plane
  const N *position, *radius, *margin;  // [D] on the node, [1], [1]
  const N *firmness, *grip, *deep;      // C⊥, μ, from which depth on it is a hazard
  const N *release, *slip_speed;        // [m/s]
  const N* plane;                       // [D + 1] normal and offset in the world

  Candidates() = default;
  // Walks on over both arrays of a plan.
  Candidates(CandidateSizes s, const int*& ints, const N*& numbers) {
    auto whole = [&](int count) { const int* here = ints; ints += count; return here; };
    auto real = [&](int count) { const N* here = numbers; numbers += count; return here; };
    const int n = s.candidates;
    counts = whole(KINDS), carrier = whole(n), solid = whole(n);
    position = real(D * n), radius = real(n), margin = real(n);
    firmness = real(n), grip = real(n), deep = real(n), release = real(n), slip_speed = real(n);
    plane = real((D + 1) * s.planes);
  }

  static int whole_numbers(CandidateSizes s) { return KINDS + 2 * s.candidates; }
  static int real_numbers(CandidateSizes s) { return (7 + D) * s.candidates + (D + 1) * s.planes; }
};

}  // namespace pbfd
