// Convex hulls as obstacles, by their exact signed distance (contact/convex.py). For `Placed`.
#pragma once
#include <cfloat>
#include "solids.h"

namespace pbfd {

// All points p with n · p ≤ b: in place of samples, n and b [4] of its faces, then the ends [6] of its edges, so many of each as the
// grid's second and third number say. Size: the largest coordinate of a corner.
//
// The face that a point is highest above decides: its foot there belongs to the hull for every point inside and for those nearest to
// a face; others are nearest to an edge, its ends included. Of faces and edges alike the first counts.
struct Polyhedron {
  static constexpr bool exact = true, convex = true;

  template <class V> struct Nearest {
    V distance, normal[3], edge[3], inverse, beside;  // 1/distance, 0 on a face; 1 beside the edge, 0 beyond its ends
  };

  template <class V, class N> static void nearest(const Candidates<N, 3>& c, int solid, const V* p, Nearest<V>& out) {
    using T = typename Kind<V>::Scalar;
    const int* grid = c.grid + 4 * solid;
    const T *faces = c.sample + grid[0], *edges = faces + 4 * grid[1];
    V face[3] = {V(0), V(0), V(0)}, height = -infinite<V>(), foot[3], overhang = -infinite<V>();
    for (int f = 0; f < grid[1]; f++) {
      const T* n = faces + 4 * f;
      const V above = over(n, p);
      const auto higher = above > height;
      height = select(higher, above, height);
      for (int j = 0; j < 3; j++) face[j] = select(higher, V(n[j]), face[j]);
    }
    for (int j = 0; j < 3; j++) foot[j] = fma(-height, face[j], p[j]);
    for (int f = 0; f < grid[1]; f++) overhang = max(overhang, over(faces + 4 * f, foot));

    V least = infinite<V>(), offset[3] = {p[0], p[1], p[2]};
    for (int j = 0; j < 3; j++) out.edge[j] = V(j == 2);
    out.beside = V(0);
    for (int e = 0; e < grid[2]; e++) {
      const T *start = edges + 6 * e, *end = start + 3;
      T along[3] = {end[0] - start[0], end[1] - start[1], end[2] - start[2]};
      const T length = sqrt(dot<3>(along, along));
      V ahead(0), off[3];
      for (int j = 0; j < 3; j++) along[j] = along[j] / length, ahead = fma(p[j] - V(start[j]), V(along[j]), ahead);
      const V taken = clamped(ahead, V(0), V(length));
      for (int j = 0; j < 3; j++) off[j] = p[j] - fma(taken, V(along[j]), V(start[j]));
      const V square = dot<3>(off, off);
      const auto nearer = square < least;
      least = select(nearer, square, least);
      out.beside = select(nearer, select((ahead > V(0)) & (ahead < V(length)), V(1), V(0)), out.beside);
      for (int j = 0; j < 3; j++) {
        offset[j] = select(nearer, off[j], offset[j]);
        out.edge[j] = select(nearer, V(along[j]), out.edge[j]);
      }
    }
    constexpr T EPSILON = sizeof(T) == 8 ? T(DBL_EPSILON) : T(FLT_EPSILON);
    const auto on_face = overhang <= V(8 * EPSILON) * (V(c.measure[6 * solid]) + abs(height));
    const V inverse = unit<3>(offset, face, out.normal), far = dot<3>(offset, out.normal);
    out.distance = select(on_face, height, far), out.inverse = select(on_face, V(0), inverse);
    for (int j = 0; j < 3; j++) out.normal[j] = select(on_face, face[j], out.normal[j]);
  }

  template <class V, class N> static V field(const Candidates<N, 3>& c, int solid, const V* p, V* n) {
    Nearest<V> at;
    nearest(c, solid, p, at);
    for (int j = 0; j < 3; j++) n[j] = at.normal[j];
    return at.distance;
  }
  template <class V, class N> static void curvature(const Candidates<N, 3>& c, int solid, const V* p, V* out) {
    Nearest<V> at;
    nearest(c, solid, p, at);
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) {
        const V along = at.beside * at.edge[j] * at.edge[k];
        out[3 * j + k] = at.inverse * (fma(-at.normal[j], at.normal[k], V(j == k)) - along);
      }
  }

 private:
  template <class T, class V> static V over(const T* plane, const V* p) {
    return fma(V(plane[0]), p[0], fma(V(plane[1]), p[1], fma(V(plane[2]), p[2], V(-plane[3]))));
  }
};

}  // namespace pbfd
