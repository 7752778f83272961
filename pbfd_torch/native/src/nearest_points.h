// The direction between nearest points of two convex polytopes by the algorithm of Gilbert, Johnson and Keerthi: what FCL is
// asked for in contact/separation.py. It works on the difference of both, the points x − y with x of a and y of b, in the frame
// of b.
//
// Robust by what it is used for: every direction gives a lower bound of the distance, so that it may stop anywhere.
#pragma once
#include <cfloat>

#include "hulls.h"

namespace pbfd {

template <class T> constexpr T rounding() { return sizeof(T) == 8 ? T(DBL_EPSILON) : T(FLT_EPSILON); }

// Two shapes, all in the frame of b: `a_in_b` is where a is there.
template <class T> struct Couple {
  Hull<T> a, b;
  Pose<T> a_in_b;

  // How far a is before b along d [times its length], and the point of a less the point of b that say so.
  T apart(const T* d, T* difference) const {
    T own[3], least, most, x[3];
    transposed_times(a_in_b.rotation, d, own);
    placed(a_in_b, a.vertex + 3 * a.lowest(own, least), x);
    const T* y = b.vertex + 3 * b.highest(d, most);
    for (int i = 0; i < 3; i++) difference[i] = x[i] - y[i];
    return dot(d, difference);
  }
};

// The convex hull of up to four points, reduced to those that its point nearest to the origin lies between.
template <class T> struct Simplex {
  T at[4][3];
  int count = 0;

  bool has(const T* x) const {
    for (int i = 0; i < count; i++)
      if (at[i][0] == x[0] && at[i][1] == x[1] && at[i][2] == x[2]) return true;
    return false;
  }

  void add(const T* x) {
    for (int i = 0; i < 3; i++) at[count][i] = x[i];
    count++;
  }

  // Nearest point and its square; four points are left where the origin is between them.
  T nearest(T* v) {
    int kept[4] = {0, -1, -1, -1};
    T square = 0;
    if (count == 1) {
      for (int i = 0; i < 3; i++) v[i] = at[0][i];
      square = dot(v, v);
    } else if (count == 2) {
      square = of_two(0, 1, v, kept);
    } else if (count == 3) {
      square = of_three(0, 1, 2, v, kept);
    } else {
      square = of_four(v, kept);
    }
    T old[4][3];
    for (int i = 0; i < 4; i++)
      for (int j = 0; j < 3; j++) old[i][j] = i < count ? at[i][j] : T(0);
    count = 0;
    for (int i = 0; i < 4; i++)
      if (kept[i] >= 0) add(old[kept[i]]);
    return square;
  }

 private:
  static void only(int i, int j, int k, int* kept) { kept[0] = i, kept[1] = j, kept[2] = k, kept[3] = -1; }

  T of_two(int i, int j, T* v, int* kept) const {
    const T *p = at[i], *q = at[j], e[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
    const T along = -dot(p, e), square = dot(e, e);
    if (!(along > 0)) {
      for (int k = 0; k < 3; k++) v[k] = p[k];
      only(i, -1, -1, kept);
    } else if (!(along < square)) {
      for (int k = 0; k < 3; k++) v[k] = q[k];
      only(j, -1, -1, kept);
    } else {
      const T share = along / square;
      for (int k = 0; k < 3; k++) v[k] = fma(share, e[k], p[k]);
      only(i, j, -1, kept);
    }
    return dot(v, v);
  }

  T of_three(int i, int j, int k, T* v, int* kept) const {
    const T *p = at[i], *q = at[j], *r = at[k];
    const T e[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]}, f[3] = {r[0] - p[0], r[1] - p[1], r[2] - p[2]};
    T n[3], c[3];
    cross(e, f, n);
    const T square = dot(n, n);
    if (square > T(16) * rounding<T>() * rounding<T>() * dot(e, e) * dot(f, f)) {
      const auto weight = [&](const T* x, const T* y) { return cross(x, y, c), dot(n, c); };
      if (weight(q, r) > 0 && weight(r, p) > 0 && weight(p, q) > 0) {
        const T share = dot(n, p) / square;  // along the normal, whose direction is right however near the origin is
        for (int l = 0; l < 3; l++) v[l] = share * n[l];
        only(i, j, k, kept);
        return dot(v, v);
      }
    }
    T best = of_two(i, j, v, kept);
    const int pairs[2][2] = {{j, k}, {i, k}};
    for (const int* pair : pairs) {
      T other[3];
      int those[4];
      const T near = of_two(pair[0], pair[1], other, those);
      if (near < best) best = take(near, other, those, v, kept);
    }
    return best;
  }

  T of_four(T* v, int* kept) const {
    const int faces[4][4] = {{0, 1, 3, 2}, {1, 2, 3, 0}, {0, 2, 3, 1}, {0, 1, 2, 3}};
    T best = infinite<T>();
    for (const int* face : faces) {
      const T *p = at[face[0]], *q = at[face[1]], *r = at[face[2]], *s = at[face[3]];
      const T e[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]}, f[3] = {r[0] - p[0], r[1] - p[1], r[2] - p[2]};
      const T g[3] = {s[0] - p[0], s[1] - p[1], s[2] - p[2]};
      T n[3];
      cross(e, f, n);
      if (-dot(n, p) * dot(n, g) > 0) continue;  // the origin is on the side of the fourth point
      T other[3];
      int those[4];
      const T near = of_three(face[0], face[1], face[2], other, those);
      if (near < best) best = take(near, other, those, v, kept);
    }
    if (best < infinite<T>()) return best;
    v[0] = v[1] = v[2] = 0;
    for (int i = 0; i < 4; i++) kept[i] = i;
    return 0;
  }

  static T take(T square, const T* from, const int* those, T* v, int* kept) {
    for (int l = 0; l < 3; l++) v[l] = from[l];
    for (int l = 0; l < 4; l++) kept[l] = those[l];
    return square;
  }
};

// What is known of the distance of two polytopes: no less than `least`, in this direction, no more than `most`.
template <class T> struct Bounds {
  T least, most, direction[3];
};

// Starts along the line between the middles of the vertices; ends early where `least` is beyond `enough`.
template <class T> inline Bounds<T> nearest_points(const Couple<T>& pair, T enough) {
  constexpr int MOST = 64;
  Bounds<T> found{-infinite<T>(), infinite<T>(), {0, 0, 1}};
  const T room = T(8) * rounding<T>() * (pair.a.size() + pair.b.size());
  T v[3], w[3];
  placed(pair.a_in_b, pair.a.middle(), v);
  for (int i = 0; i < 3; i++) v[i] -= pair.b.middle()[i];
  T square = dot(v, v);
  if (!(square > room * room)) v[0] = v[1] = 0, v[2] = square = 1;
  Simplex<T> simplex;
  for (int turn = 0; turn < MOST; turn++) {
    const T length = sqrt(square), least = pair.apart(v, w) / length;
    if (least > found.least) {
      found.least = least;
      for (int i = 0; i < 3; i++) found.direction[i] = v[i] / length;
    }
    if (found.least > enough || found.most - found.least <= room || simplex.has(w)) break;
    simplex.add(w);
    T other[3];
    const T next = simplex.nearest(other), nearer = sqrt(next);
    if (!(nearer < found.most)) break;
    found.most = nearer;
    if (nearer <= room) break;  // both overlap
    square = next;
    for (int i = 0; i < 3; i++) v[i] = other[i];
  }
  return found;
}

}  // namespace pbfd
