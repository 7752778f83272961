// Face contact: where an incident polygon lies over a reference polygon, as `_Footprint` of contact/manifold.py. And the points
// that are found, of which those stay that are spread widest.
#pragma once
#include "nearest_points.h"

namespace pbfd {

// Points of contact that may stay, in the frame of the reference, and how high each is over the plane.
template <class T> struct Spots {
  static constexpr int MOST = 3 * CORNERS + 3 + VERTICES;
  int count = 0;
  T at[MOST][3], height[MOST], far[MOST];

  void add(const T* x, const T* n) {
    for (int i = 0; i < 3; i++) at[count][i] = x[i];
    height[count++] = dot_in_order(x, n);
  }

  // The deepest one and then the farthest from those taken, of those farther than `merged` from the others.
  int spread(int most, T merged, int* taken) {
    taken[0] = 0;
    for (int i = 0; i < count; i++) {
      far[i] = infinite<T>();
      if (height[i] < height[taken[0]]) taken[0] = i;
    }
    int found = 1;
    for (; found < most; found++) {
      const T* last = at[taken[found - 1]];
      T reach = -infinite<T>();
      for (int i = 0; i < count; i++) {
        const T step[3] = {at[i][0] - last[0], at[i][1] - last[1], at[i][2] - last[2]};
        far[i] = min(far[i], dot_in_order(step, step));
        if (far[i] > reach) reach = far[i], taken[found] = i;
      }
      if (!(reach > merged * merged)) break;
    }
    return found;
  }
};

// Adds the point of a line from p to q with this share of it behind.
template <class T> inline void add_between(const T* p, const T* q, T share, const T* n, Spots<T>& out) {
  const T x[3] = {p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1]), p[2] + share * (q[2] - p[2])};
  out.add(x, n);
}

// The prism over a polygon, grown by `room` so that rounding does not lose what lies on its sides.
template <class T> struct Footprint {
  int count;
  T margin, corner[CORNERS][3], side[CORNERS][3];  // outward unit normal of each side; zero for one without length

  // Of a polygon with its corners in place and an axis.
  void raise(const T* axis, T room) {
    for (int i = 0; i < count; i++) {
      const T *p = corner[i], *q = corner[i + 1 < count ? i + 1 : 0], along[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
      T* s = side[i];
      cross_in_order(along, axis, s);
      const T square = dot_in_order(s, s), length = sqrt(square);
      for (int k = 0; k < 3; k++) s[k] = square > 0 ? s[k] / length : T(0);
    }
    margin = room;
  }

  // How far a point is outside of a side.
  T outside(const T* x, int i) const {
    const T off[3] = {x[0] - corner[i][0], x[1] - corner[i][1], x[2] - corner[i][2]};
    return dot_in_order(off, side[i]) - margin;
  }

  bool holds(const T* x) const {
    for (int i = 0; i < count; i++)
      if (!(outside(x, i) <= 0)) return false;
    return true;
  }
};

// Adds the points where the incident polygon, with its normal, lies over the reference, with axis n: the ends of what the
// reference leaves of each side, and the reference's corners as projected on it. Where these, if any, are higher than its
// deepest and least outside corner by more than `coarse`, that one too: where bodies meet at the rim of a face, or do not
// overlap yet.
template <class T>
inline void cut(const Footprint<T>& reference, Footprint<T>& incident, const T* normal, const T* n, T room, T coarse,
                Spots<T>& out) {
  constexpr T EDGEWISE = T(1e-3);  // |cosine| between both normals under which nothing is projected on the incident polygon
  const int count = incident.count;
  T here[CORNERS], next[CORNERS], first[CORNERS], leave[CORNERS];  // how far corners are outside; where sides leave
  bool over[CORNERS];
  int nearest = 0;
  T lowest = infinite<T>(), nearest_height = 0;
  for (int j = 0; j < reference.count; j++) first[j] = here[j] = reference.outside(incident.corner[0], j);
  for (int i = 0; i < count; i++) {
    const T *p = incident.corner[i], *q = incident.corner[i + 1 < count ? i + 1 : 0];
    T enter = 0, most = 0;
    leave[i] = 1;
    over[i] = true;
    for (int j = 0; j < reference.count; j++) {
      next[j] = i + 1 < count ? reference.outside(q, j) : first[j];
      const T slope = next[j] - here[j];
      if (here[j] > 0 && next[j] > 0) over[i] = false;
      most = max(most, here[j]);
      if (slope < -room) enter = max(enter, -here[j] / slope);
      if (slope > room) leave[i] = min(leave[i], -here[j] / slope);
      here[j] = next[j];
    }
    const T height = dot_in_order(p, n);
    if (height + most < lowest) lowest = height + most, nearest = i, nearest_height = height;
    enter = min(enter, T(1)), leave[i] = max(leave[i], T(0));
    over[i] = over[i] && enter <= leave[i];
    if (!over[i]) continue;
    add_between(p, q, enter, n, out);
  }
  for (int i = 0; i < count; i++) {
    if (!over[i]) continue;
    add_between(incident.corner[i], incident.corner[i + 1 < count ? i + 1 : 0], leave[i], n, out);
  }
  const T facing = -dot_in_order(normal, n), *start = incident.corner[0];
  if (facing > EDGEWISE) {
    const T axis[3] = {-n[0], -n[1], -n[2]};
    incident.raise(axis, room);
    for (int j = 0; j < reference.count; j++) {
      const T *c = reference.corner[j], to[3] = {start[0] - c[0], start[1] - c[1], start[2] - c[2]};
      const T height = dot_in_order(to, normal) / -facing;
      const T x[3] = {c[0] + height * n[0], c[1] + height * n[1], c[2] + height * n[2]};
      if (incident.holds(x)) out.add(x, n);
    }
  }
  T deepest = infinite<T>();
  for (int i = 0; i < out.count; i++) deepest = min(deepest, out.height[i]);
  if (deepest > nearest_height + coarse) out.add(incident.corner[nearest], n);
}

}  // namespace pbfd
