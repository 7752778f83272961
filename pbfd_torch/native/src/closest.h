// Where two round shapes come closest, in scalars, and whether they touch there at one point (contact/closest.py).
//
// A shape is one ellipsoid, or the hull of two equal ones at its ends: it touches with the one, with the other, or with what lies
// between, one ellipsoid swept along the axis. The gap of whole shapes along any direction is never more than their signed
// distance, so of the directions that are found for all choices of both that with the largest gap is the right one.
#pragma once
#include "approach.h"
#include "solids.h"

namespace pbfd {

// Both shapes in the world: centres, forms, axes, how far from the centres the ellipsoids go, half the thickness of the thinner one,
// and whether they have flat caps.
template <class T> struct RoundPair {
  T center[2][3], form[2][9], axis[2][3], half[2], thin;
  bool capped[2];
};

// The gap, along which direction, out of which ellipsoids, 0: swept, −1, 1: one at an end; and whether they touch at one point.
template <class T> struct Sought {
  T gap, normal[3];
  int height[2];
  bool alone;
};

constexpr double CAP = 0.02;       // [rad] between a cap's normal and the direction, under which the cap is what touches
constexpr double BESIDE = 1e-2;    // sine of the angle between axes under which shapes lie side by side

// The ellipsoids at these heights.
template <class T> inline void choose(const RoundPair<T>& pair, const int* height, Approach<T>& out) {
  for (int j = 0; j < 3; j++) out.between[j] = pair.center[0][j] - pair.center[1][j];
  for (int i = 0; i < 2; i++) {
    const bool swept = height[i] == 0 && pair.half[i] > 0;
    const T far = T(height[i]) * pair.half[i];
    for (int j = 0; j < 9; j++) out.form[i][j] = pair.form[i][j];
    for (int j = 0; j < 3; j++) {
      out.line[i][j] = swept ? pair.axis[i][j] : T(0);
      out.between[j] = fma(i ? -far : far, pair.axis[i][j], out.between[j]);
    }
  }
}

// A direction to begin with: the normal of an ellipsoid about as large as both, where these are on the way from the one to the other.
template <class T> inline void first_direction(const Approach<T>& both, T softness, T* out) {
  T a[9], sides[3], size(0);
  for (int j = 0; j < 9; j++) a[j] = both.form[0][j] + both.form[1][j];
  for (int j = 0; j < 3; j++) size += a[4 * j];
  for (int j = 0; j < 3; j++) a[4 * j] += softness * size;
  for (int j = 0; j < 3; j++) {  // rows are columns
    T c[3];
    cross(a + 3 * ((j + 1) % 3), a + 3 * ((j + 2) % 3), c);
    sides[j] = dot(c, both.between) / (size * size);
  }
  const T up[3] = {T(0), T(0), T(1)};
  unit<3>(sides, up, out);
}

// Of the whole shapes along a direction.
template <class T> inline T whole_gap(const RoundPair<T>& pair, const T* n) {
  T gap(0);
  for (int i = 0; i < 2; i++) {
    T y[3];
    times(pair.form[i], n, y);
    const T middle = dot(pair.center[i], n), reach = Approach<T>::reaching(dot(y, n));
    gap += (i ? -middle : middle) - reach - pair.half[i] * abs(dot(pair.axis[i], n));
  }
  return gap;
}

template <class T> inline void seek(const RoundPair<T>& pair, Sought<T>& out) {
  constexpr int STEPS = 8, HEIGHTS[3] = {0, -1, 1};  // of Newton's method, from a direction that only knows the forms
  constexpr double SOFT[2] = {0.05, 1.0};  // of the forms' size, which is added to them for two such directions: rims are thin
  out.gap = -infinite<T>(), out.height[0] = out.height[1] = 0, out.alone = false;
  for (int j = 0; j < 3; j++) out.normal[j] = T(j == 2);
  for (const double soft : SOFT)
    for (int i = 0; i < (pair.half[0] > 0 ? 3 : 1); i++)
      for (int k = 0; k < (pair.half[1] > 0 ? 3 : 1); k++) {
        const int height[2] = {HEIGHTS[i], HEIGHTS[k]};
        Approach<T> both;
        T n[3], slides[2];
        choose(pair, height, both);
        first_direction(both, T(soft), n);
        both.look(n), both.close(STEPS, slides);
        const T gap = whole_gap(pair, both.normal);
        if (!(gap > out.gap)) continue;
        out.gap = gap, out.height[0] = height[0], out.height[1] = height[1];
        for (int j = 0; j < 3; j++) out.normal[j] = both.normal[j];
      }
  bool flat = false;
  T cap = -infinite<T>();
  for (int i = 0; i < 2; i++) {
    if (!pair.capped[i]) continue;
    const T* l = pair.axis[i];
    const T back[3] = {-l[0], -l[1], -l[2]};
    cap = max(cap, max(whole_gap(pair, l), whole_gap(pair, back)));
    flat = flat || abs(dot(l, out.normal)) > T(1 - 0.5 * CAP * CAP);
  }
  const T cosine = dot(pair.axis[0], pair.axis[1]);
  const bool sides = out.height[0] == 0 && out.height[1] == 0 && pair.half[0] > 0 && pair.half[1] > 0;
  out.alone = out.gap >= cap && !flat && !(sides && T(1) - cosine * cosine < T(BESIDE * BESIDE));
}

// Whether they come so far [m] that they may be past each other's middle, where this gap lies between them.
template <class T> inline bool held_apart(const RoundPair<T>& pair, T gap, T moves) { return gap > 0 && moves > gap + pair.thin; }

// Where they meet: both centres, where there is a line the nearest points of it; the direction; the plane that touches the second one
// is `reach` [m] from its centre.
template <class T> struct Spotted {
  T center[2][3], normal[3], reach;
  bool swept[2];
};

template <class T> inline void spot(const RoundPair<T>& pair, const Sought<T>& found, Spotted<T>& out) {
  Approach<T> both;
  T slides[2];
  choose(pair, found.height, both);
  both.look(found.normal), both.nearer(slides);
  out.reach = both.reach[1];
  for (int j = 0; j < 3; j++) out.normal[j] = both.normal[j];
  for (int i = 0; i < 2; i++) {
    out.swept[i] = found.height[i] == 0 && pair.half[i] > 0;
    const T along = out.swept[i] ? (i ? slides[1] : -slides[0]) : T(found.height[i]) * pair.half[i];
    for (int j = 0; j < 3; j++) out.center[i][j] = fma(along, pair.axis[i][j], pair.center[i][j]);
  }
}

}  // namespace pbfd
