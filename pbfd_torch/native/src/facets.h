// What points of one body meet on another one, in that one's frame: planes, and solids that nothing jumps (contact/surface.py).
#pragma once
#include "solids.h"

namespace pbfd {

// A candidate between bodies, as every lane has its own. There the plane is on the body, or beside a solid in that solid's frame.
template <class V> struct Spot {
  V there;                // 1, or 0 where the lane has no such candidate
  V position[3];          // on the node that gives the point
  V normal[3], offset;    // of the plane
  V passed, near;         // 1 or 0, see finder.h
  V slot;                 // its place among the candidates of its lane
  V anchor[3];            // what its anchor is behind by as the solid's node sees it
  V start[3], began;      // where the solid's body sees the point at the start, less what its belt runs; and how deep it is there
  V bounce;               // how far the solid is moved out for the step to throw the point back
  // of curved bodies, see curved.h
  V rim, lying, share;                    // 1 where it is an ellipsoid's, else 0; see terms/lying.py, and what follows for this step
  V follows, swept[2], other[3];          // 1 or 0; where round bodies come closest, on the node of the other one

  void clear() {
    there = slot = offset = passed = near = began = bounce = rim = lying = share = follows = swept[0] = swept[1] = V(0);
    for (int j = 0; j < 3; j++) position[j] = normal[j] = anchor[j] = start[j] = other[j] = V(0);
  }
};

// The plane itself.
struct Face {
  static constexpr bool flat = true;
  template <class V, class T> static void beside(const Spot<V>& spot, const T*, const V* p, Beside<V, 3>& out) {
    for (int j = 0; j < 3; j++) out.normal[j] = spot.normal[j];
    out.distance = dot(p, spot.normal) - spot.offset, out.steepness = V(1);
  }
  template <class V, class T> static void bend(const Spot<V>&, const T*, const V*, const Beside<V, 3>&, V*) {}
};

// The same, near which the direction is between round bodies that come closest: it turns with both.
struct Near : Face {
  static constexpr bool flat = false;
};

// The numbers of a solid as lanes see them.
template <class V> struct Wide {
  V measure[3];
};

// A convex solid, over which the distance from the plane goes deep below it. `solid`: frame, sizes and thickness (bodies.h).
template <class Solid> struct Guarded {
  static constexpr bool flat = false;

  template <class V, class T> [[gnu::noinline]] static void beside(const Spot<V>& spot, const T* solid, const V* p, Beside<V, 3>& out) {
    At<V> at;
    look(spot, solid, p, at);
    const V along = fma(at.slope, at.above, V(1) - at.share);
    V n[3];
    for (int j = 0; j < 3; j++) n[j] = fma(at.share, at.normal[j], along * spot.normal[j]);
    out.steepness = sqrt(dot(n, n));
    for (V& x : n) x = x / out.steepness;
    out.distance = at.distance - (V(1) - at.share) * at.above;
    turned(solid, n, out.normal);
  }

  // Of ∇φ/‖∇φ‖, on the body.
  template <class V, class T>
  [[gnu::noinline]] static void bend(const Spot<V>& spot, const T* solid, const V* p, const Beside<V, 3>& found, V* out) {
    At<V> at;
    V q[3], own[9], R[9], half[9];
    look(spot, solid, p, at, q);
    Solid::curvature(wide<V>(solid), 0, q, own);
    V turning[3];
    for (int j = 0; j < 3; j++)
      turning[j] = fma(at.slope, at.normal[j] - spot.normal[j], V(0.5) * at.bends * spot.normal[j]);
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++)
        own[3 * j + k] = fma(at.share, own[3 * j + k], fma(spot.normal[j], turning[k], spot.normal[k] * turning[j]));
    for (int j = 0; j < 9; j++) R[j] = V(solid[j]);
    product(R, own, half), product_transposed(half, R, out);
    for (int k = 0; k < 3; k++) {
      const V along = fma(found.normal[0], out[k], fma(found.normal[1], out[3 + k], found.normal[2] * out[6 + k]));
      for (int j = 0; j < 3; j++) out[3 * j + k] = fma(-along, found.normal[j], out[3 * j + k]) / found.steepness;
    }
  }

 private:
  // φ and ∇φ of the solid; how much of it counts, how that grows with the height over the plane and bends; φ over that height.
  template <class V> struct At {
    V distance, normal[3], share, slope, bends, above;
  };
  template <class V, class T> static Wide<V> wide(const T* solid) { return {{V(solid[12]), V(solid[13]), V(solid[14])}}; }

  template <class V, class T> static void look(const Spot<V>& spot, const T* solid, const V* p, At<V>& at) {
    V q[3];
    look(spot, solid, p, at, q);
  }
  template <class V, class T> static void look(const Spot<V>& spot, const T* solid, const V* p, At<V>& at, V* q) {
    const V zero(0), one(1), off[3] = {p[0] - V(solid[9]), p[1] - V(solid[10]), p[2] - V(solid[11])};
    for (int j = 0; j < 3; j++) q[j] = fma(V(solid[j]), off[0], fma(V(solid[3 + j]), off[1], V(solid[6 + j]) * off[2]));
    at.distance = Solid::field(wide<V>(solid), 0, q, at.normal);
    const V height = dot(q, spot.normal) - spot.offset;
    const V per_layer = V(1) / max(V(0.25) * V(solid[15]), V(sizeof(T) == 8 ? 2.220446049250313e-16 : 1.1920929e-07));
    const auto passed = spot.passed > zero;
    const V x = select(passed, select(spot.near > zero, clamped(fma(height, per_layer, V(2)), zero, one), zero), one);
    at.share = x * x * x * (V(10) - x * (V(15) - V(6) * x));
    at.slope = V(30) * (x * (one - x)) * (x * (one - x)) * per_layer;
    at.above = at.distance - height;
    at.bends = V(60) * x * (one - x) * (one - V(2) * x) * per_layer * per_layer * at.above;
  }
  template <class V, class T> static void turned(const T* R, const V* n, V* out) {
    for (int j = 0; j < 3; j++) out[j] = fma(V(R[3 * j]), n[0], fma(V(R[3 * j + 1]), n[1], V(R[3 * j + 2]) * n[2]));
  }
};

}  // namespace pbfd
