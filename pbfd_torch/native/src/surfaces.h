// Solids at rest, as contact sees them: how far a point of the world is from them, which way, and how that way turns
// (contact/surface.py). Each has
//   beside: the distance and the direction at a point;   bend: how the direction turns there, ∂n/∂p [D × D], unless it is `flat`;
//   to_world, to_own: a vector of its own frame in the world's, and back.
// `exact`: φ is the distance itself. `convex`: it has an end, and what moves fast might pass through it.
#pragma once
#include "candidates.h"

namespace pbfd {

// A point beside a solid: its signed distance φ, > 0 outside, the direction n of ∇φ, and ‖∇φ‖ where φ is not the distance itself; how
// far along its axis the nearest point of a swept body lies [m] (curved.h).
template <class V, int D> struct Beside {
  V distance, normal[D], steepness, slide;
};

// A half-space.
struct Plane {
  static constexpr bool flat = true, exact = true, convex = false;

  template <class V, class N, int D> static void beside(const Candidates<N, D>& c, int i, const V* point, Beside<V, D>& out) {
    const N* plane = c.plane + (D + 1) * c.solid[i];
    for (int j = 0; j < D; j++) out.normal[j] = V(plane[j]);
    out.distance = dot<D>(out.normal, point) - V(plane[D]), out.steepness = V(1);
  }
  template <class V, class N, int D> static void bend(const Candidates<N, D>&, int, const V*, const Beside<V, D>&, V*) {}
  template <class V, class N> static void to_world(const Candidates<N, 3>&, int, const V* x, V* out) {
    for (int j = 0; j < 3; j++) out[j] = x[j];
  }
  template <class V, class N> static void to_own(const Candidates<N, 3>&, int, const V* x, V* out) {
    for (int j = 0; j < 3; j++) out[j] = x[j];
  }
};

}  // namespace pbfd
