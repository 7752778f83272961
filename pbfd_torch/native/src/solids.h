// Solids put somewhere in the world, by their signed distances in their own frames (contact/primitives.py).
//
// Each has `field`, φ and ∇φ at a point, and `curvature`, ∇∇φ [9]; `convex` ones are kept between a body and where it came from.
#pragma once
#include "surfaces.h"

namespace pbfd {

// The direction of a vector, or that of `fallback` where there is next to none, and the inverse of its length, 0 there.
template <int K, class V> inline V unit(const V* vector, const V* fallback, V* out) {
  V square(0), whole(0);
  for (int j = 0; j < K; j++) square = fma(vector[j], vector[j], square);
  const auto none = square <= V(1e-30);
  for (int j = 0; j < K; j++) out[j] = select(none, fallback[j], vector[j]), whole = fma(out[j], out[j], whole);
  const V inverse = V(1) / sqrt(whole);
  for (int j = 0; j < K; j++) out[j] = out[j] * inverse;
  return select(none, V(0), inverse);
}

// The signed distance of q [K] from where all coordinates are ≤ 0, its gradient, and of its Hessian c (D − g gᵀ) the diagonal D and
// the scale c. Within, the first of the nearest faces counts.
template <int K, class V> inline V from_orthant(const V* q, V* gradient, V* across, V& scale) {
  const V zero(0), one(1);
  V beyond[K], nearest[K], most = q[0], distance(0);
  for (int j = 1; j < K; j++) most = max(most, q[j]);
  auto free = most <= most;  // no face has been taken yet
  for (int j = 0; j < K; j++) {
    beyond[j] = max(q[j], zero), across[j] = select(q[j] > zero, one, zero);
    nearest[j] = select(free & (q[j] >= most), one, zero);
    free = free & !(q[j] >= most);
  }
  scale = unit<K>(beyond, nearest, gradient);
  for (int j = 0; j < K; j++) distance = fma(q[j], gradient[j], distance);
  return distance;
}

// out = c (1 − n nᵀ − D), D of the axis z
template <class V> inline void around(const V* n, V scale, V straight, V* out) {
  for (int j = 0; j < 3; j++)
    for (int k = 0; k < 3; k++) out[3 * j + k] = scale * fma(-n[j], n[k], V(j == k) - (j == 2 && k == 2 ? straight : V(0)));
}

// Radius.
struct Globe {
  static constexpr bool exact = true, convex = true;
  template <class V> static V direction(const V* p, V* n) {
    const V up[3] = {V(0), V(0), V(1)};
    return unit<3>(p, up, n);
  }
  template <class V, class C> static V field(const C& c, int solid, const V* p, V* n) {
    direction(p, n);
    return dot(p, n) - V(c.measure[6 * solid]);
  }
  template <class V, class C> static void curvature(const C&, int, const V* p, V* out) {
    V n[3];
    const V inverse = direction(p, n);
    around(n, inverse, V(0), out);
  }
};

// Along z: radius, half length.
struct Pill {
  static constexpr bool exact = true, convex = true;
  template <class V, class C> static V direction(const C& c, int solid, const V* p, V* n, V& distance, V& beside) {
    const V half = V(c.measure[6 * solid + 1]), over = max(p[2] - half, V(0)), under = min(p[2] + half, V(0));
    const V offset[3] = {p[0], p[1], over + under}, across[3] = {V(0), V(1), V(0)};
    const V inverse = unit<3>(offset, across, n);
    distance = dot(offset, n), beside = select(abs(p[2]) < half, V(1), V(0));
    return inverse;
  }
  template <class V, class C> static V field(const C& c, int solid, const V* p, V* n) {
    V distance, beside;
    direction(c, solid, p, n, distance, beside);
    return distance - V(c.measure[6 * solid]);
  }
  template <class V, class C> static void curvature(const C& c, int solid, const V* p, V* out) {
    V n[3], distance, beside;
    const V inverse = direction(c, solid, p, n, distance, beside);
    around(n, inverse, beside, out);
  }
};

// Half extents.
struct Block {
  static constexpr bool exact = true, convex = true;
  template <class V, class C> static V direction(const C& c, int solid, const V* p, V* n, V* across, V& scale) {
    V q[3];
    for (int j = 0; j < 3; j++) q[j] = abs(p[j]) - V(c.measure[6 * solid + j]);
    const V distance = from_orthant<3>(q, n, across, scale);
    for (int j = 0; j < 3; j++) n[j] = select(p[j] < V(0), -n[j], n[j]);
    return distance;
  }
  template <class V, class C> static V field(const C& c, int solid, const V* p, V* n) {
    V across[3], scale;
    return direction(c, solid, p, n, across, scale);
  }
  template <class V, class C> static void curvature(const C& c, int solid, const V* p, V* out) {
    V n[3], across[3], scale;
    direction(c, solid, p, n, across, scale);
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) out[3 * j + k] = scale * fma(-n[j], n[k], j == k ? across[j] : V(0));
  }
};

// Along z: radius, half length.
struct Drum {
  static constexpr bool exact = true, convex = true;
  template <class V> struct Around {
    V outward[2], turn, g[2], across[2], scale;  // away from the axis, and 1/distance to it; of the profile
  };
  template <class V, class C> static V direction(const C& c, int solid, const V* p, V* n, Around<V>& at) {
    const V aside[2] = {V(1), V(0)};
    at.turn = unit<2>(p, aside, at.outward);
    const V q[2] = {
        fma(p[0], at.outward[0], p[1] * at.outward[1]) - V(c.measure[6 * solid]), abs(p[2]) - V(c.measure[6 * solid + 1])};
    const V distance = from_orthant<2>(q, at.g, at.across, at.scale);
    n[0] = at.g[0] * at.outward[0], n[1] = at.g[0] * at.outward[1], n[2] = select(p[2] < V(0), -at.g[1], at.g[1]);
    return distance;
  }
  template <class V, class C> static V field(const C& c, int solid, const V* p, V* n) {
    Around<V> at;
    return direction(c, solid, p, n, at);
  }
  template <class V, class C> static void curvature(const C& c, int solid, const V* p, V* out) {
    V n[3];
    Around<V> at;
    direction(c, solid, p, n, at);
    const V o[3] = {at.outward[0], at.outward[1], V(0)}, t[3] = {-o[1], o[0], V(0)}, round = at.turn * at.g[0];
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) {
        const V kept = fma(at.across[0], o[j] * o[k], j == 2 && k == 2 ? at.across[1] : V(0));
        out[3 * j + k] = fma(round, t[j] * t[k], at.scale * fma(-n[j], n[k], kept));
      }
  }
};

// A solid in its frame. Out of line: there are many, and several that ask.
template <class Solid> struct Placed {
  static constexpr bool flat = false, exact = Solid::exact, convex = Solid::convex;

  template <class V, class N>
  [[gnu::noinline]] static void beside(const Candidates<N, 3>& c, int i, const V* point, Beside<V, 3>& out) {
    const N* frame = c.frame + 12 * c.solid[i];
    V p[3], n[3];
    seen(frame, point, p);
    out.distance = Solid::field(c, c.solid[i], p, n);
    out.steepness = V(1);
    if constexpr (!exact) {
      out.steepness = sqrt(dot(n, n));
      for (V& x : n) x = x / out.steepness;
    }
    turned(frame, n, out.normal);
  }

  // Of ∇φ/‖∇φ‖: (1 − n nᵀ) ∇∇φ/‖∇φ‖.
  template <class V, class N>
  [[gnu::noinline]] static void bend(const Candidates<N, 3>& c, int i, const V* point, const Beside<V, 3>& at, V* out) {
    const N* frame = c.frame + 12 * c.solid[i];
    V p[3], R[9], own[9], half[9];
    seen(frame, point, p);
    Solid::curvature(c, c.solid[i], p, own);
    for (int j = 0; j < 9; j++) R[j] = V(frame[j]);
    product(R, own, half);
    product_transposed(half, R, out);
    if constexpr (!exact)
      for (int k = 0; k < 3; k++) {
        const V along = fma(at.normal[0], out[k], fma(at.normal[1], out[3 + k], at.normal[2] * out[6 + k]));
        for (int j = 0; j < 3; j++) out[3 * j + k] = fma(-along, at.normal[j], out[3 * j + k]) / at.steepness;
      }
  }

  template <class V, class N> static void to_world(const Candidates<N, 3>& c, int i, const V* x, V* out) {
    turned(c.frame + 12 * c.solid[i], x, out);
  }
  template <class V, class N> static void to_own(const Candidates<N, 3>& c, int i, const V* x, V* out) {
    turned_back(c.frame + 12 * c.solid[i], x, out);
  }

 private:
  template <class V, class N> static void seen(const N* frame, const V* point, V* out) {
    const V off[3] = {point[0] - V(frame[9]), point[1] - V(frame[10]), point[2] - V(frame[11])};
    turned_back(frame, off, out);
  }
  template <class V, class N> static void turned_back(const N* frame, const V* x, V* out) {
    for (int j = 0; j < 3; j++) out[j] = fma(V(frame[j]), x[0], fma(V(frame[3 + j]), x[1], V(frame[6 + j]) * x[2]));
  }
  template <class V, class N> static void turned(const N* frame, const V* n, V* out) {
    for (int j = 0; j < 3; j++) out[j] = fma(V(frame[3 * j]), n[0], fma(V(frame[3 * j + 1]), n[1], V(frame[3 * j + 2]) * n[2]));
  }
};

}  // namespace pbfd
