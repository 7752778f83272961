// Solids at rest, as contact sees them: how far a point of the world is from them, which way, and how that way turns
// (contact/surface.py). Each has
//   beside: the distance and the direction at a point;   bend: how the direction turns there, ∂n/∂p [9], unless it is `flat`.
// `exact`: φ is the distance itself. `convex`: it has an end, and what moves fast might pass through it.
#pragma once
#include "candidates.h"

namespace pbfd {

// A point beside a solid: its signed distance φ, > 0 outside, the direction n of ∇φ, and ‖∇φ‖ where φ is not the distance itself.
template <class V> struct Beside {
  V distance, normal[3], steepness;
};

// A half-space.
struct Plane {
  static constexpr bool flat = true, exact = true, convex = false;

  template <class V, class N> static void beside(const Candidates<N>& c, int i, const V* point, Beside<V>& out) {
    const N* plane = c.plane + 4 * c.solid[i];
    for (int j = 0; j < 3; j++) out.normal[j] = V(plane[j]);
    out.distance = dot(out.normal, point) - V(plane[3]), out.steepness = V(1);
  }
  template <class V, class N> static void bend(const Candidates<N>&, int, const V*, const Beside<V>&, V*) {}
};

}  // namespace pbfd
