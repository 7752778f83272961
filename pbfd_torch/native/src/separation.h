// How far two convex polytopes are apart and in which direction, as contact/separation.py; boxes are in box_separation.h.
//
// Every direction gives a lower bound of the signed distance. What is looked at: the normals of all faces (those that only stand
// for a curved surface count as any other direction), where these do not show that both overlap the direction between nearest
// points, and wherever that has not shown the distance the directions across two edges whose arcs of normals cross: with these
// the depth is exact. Edges go in order of a bound on what they can give, so that few are looked at.
#pragma once
#include "nearest_points.h"

namespace pbfd {

template <class T> struct Separation {
  T normal[3];      // unit, in the world, from b to a: a face's normal unless another direction separates clearly more
  T along;          // the separation in this direction [m]
  T distance;       // the signed distance [m]
  bool beyond;      // the bodies are so far apart that nothing else was looked at; what is above is a lower bound
};

// The largest separation so far, and its direction in the frame of b.
template <class T> struct Best {
  T along = -infinite<T>(), direction[3] = {0, 0, 1};

  void take(T separation, const T* d, T sign) {
    along = separation;
    for (int i = 0; i < 3; i++) direction[i] = sign * d[i];
  }
};

// What has been found of a pair: by faces, and by other directions. Without the radii.
template <class T> struct Search {
  const Couple<T>& pair;
  T slack, enough;  // beyond `enough` the bodies cannot touch
  Best<T> face, other;

  T best() const { return max(face.along, other.along); }

  // A direction of length one, from b to a, in the frame of b.
  void look(const T* d) {
    T difference[3];
    const T along = pair.apart(d, difference);
    if (along > other.along) other.take(along, d, T(1));
  }
};

// out = Rᵀ x + p
template <class T> inline void seen_back(const T* turn, const T* shift, const T* x, T* out) {
  transposed_times(turn, x, out);
  for (int i = 0; i < 3; i++) out[i] += shift[i];
}

// How far `other` is in front of the planes of `owner`, the largest of it into `flat` or `rest`. turn [9]: takes directions from
// the owner's frame to the other's; shift [3]: where the origin of the other's frame is in the owner's. to_b [9]: takes them to
// the frame of b, with this sign. nearest [3]: gets the lowest point of `other` under the best plane, in the owner's frame.
template <class T>
inline void look_at_faces(const Hull<T>& owner, const Hull<T>& other, const T* turn, const T* shift, const T* to_b, T sign,
                          Best<T>& flat, Best<T>& rest, T* nearest) {
  int hint = 0;
  T top = -infinite<T>();
  for (int f = 0; f < owner.faces; f++) {
    const T* n = owner.plane + 4 * f;
    Best<T>& best = owner.flat[f] ? flat : rest;
    T own[3];
    times(turn, n, own);
    const T constant = dot(n, shift) - n[3], reached = min(best.along, top) - constant;
    // most faces are far below the best one, and one vertex says so: the lowest one of the last face that was looked at
    T least = dot(other.vertex + 3 * hint, own);
    if (least < reached) continue;
    int at = hint, i = 0;
    for (; i < other.vertices; i++) {
      const T along = dot(other.vertex + 3 * i, own);
      if (along < least) {
        least = along, at = i;
        if (least < reached) break;
      }
    }
    hint = at;
    const T along = least + constant;
    if (i < other.vertices || !(along > min(best.along, top))) continue;
    if (along > best.along) {
      T d[3] = {n[0], n[1], n[2]};
      if (to_b) times(to_b, n, d);
      best.take(along, d, sign);
    }
    if (along > top) {
      top = along;
      seen_back(turn, shift, other.vertex + 3 * at, nearest);
    }
  }
}

// Edges of one hull in falling order of what separation they can be part of, at most.
template <class T> struct Ranked {
  static constexpr int MOST = 96;
  int count = 0, edge[MOST];
  T bound[MOST];

  void add(int e, T most) {
    if (count == MOST && !(most > bound[MOST - 1])) return;
    int i = count < MOST ? count++ : MOST - 1;
    for (; i > 0 && most > bound[i - 1]; i--) bound[i] = bound[i - 1], edge[i] = edge[i - 1];
    bound[i] = most, edge[i] = e;
  }

  // Along an arc from one normal to the other no direction separates by more than it puts a point of the other body before the
  // edge, and that is most at the ends of the arc where it is not positive there. Points: inside [2, 3], and the lowest one in
  // the middle of the arc. turn, shift: see `look_at_faces`.
  void rank(const Hull<T>& hull, const Hull<T>& other, const T* turn, const T* shift, const T* inside, T best) {
    const T floor = min(best, T(0)), opposite = T(-1) + T(64) * rounding<T>();
    for (int e = 0; e < hull.edges; e++) {
      const T *u = hull.edge + 9 * e, *left = u + 3, *right = u + 6, *x = hull.vertex + 3 * hull.ends[2 * e];
      if (dot(u, u) == 0) continue;
      T most = infinite<T>();
      if (dot(left, left) > 0 && dot(right, right) > 0 && dot(left, right) > opposite) {
        const auto bound = [&](const T* y) {
          const T w[3] = {y[0] - x[0], y[1] - x[1], y[2] - x[2]}, at_most = max(dot(left, w), dot(right, w));
          if (!(at_most > 0)) most = min(most, at_most);
        };
        bound(inside), bound(inside + 3);
        if (!(most > floor)) continue;
        const T middle[3] = {left[0] + right[0], left[1] + right[1], left[2] + right[2]};
        T own[3], least, y[3];
        times(turn, middle, own);
        seen_back(turn, shift, other.vertex + 3 * other.lowest(own, least), y);
        bound(y);
      }
      if (most > floor) add(e, most);
    }
  }
};

// Directions across edges of both whose arcs of normals cross. back, shift: where the frame of b is in that of a; inside_a,
// inside_b [2, 3]: points of b in the frame of a, and of a in the frame of b.
template <class T>
inline void look_at_edges(Search<T>& search, const T* back, const T* shift, const T* inside_a, const T* inside_b) {
  const Couple<T>& pair = search.pair;
  const Hull<T>&a = pair.a, &b = pair.b;
  const T* R = pair.a_in_b.rotation;
  Ranked<T> first, second;
  first.rank(a, b, R, shift, inside_a, search.best());
  second.rank(b, a, back, pair.a_in_b.position, inside_b, search.best());
  for (int i = 0; i < first.count; i++) {
    const T* edge = a.edge + 9 * first.edge[i];
    T u[3], l[3], r[3], x[3];
    if (!(first.bound[i] > min(search.best(), T(0)))) return;
    times(R, edge, u), times(R, edge + 3, l), times(R, edge + 6, r);
    placed(pair.a_in_b, a.vertex + 3 * a.ends[2 * first.edge[i]], x);
    for (int j = 0; j < second.count; j++) {
      if (!(second.bound[j] > min(search.best(), T(0)))) break;
      const T* w = b.edge + 9 * second.edge[j];
      const T al = dot(l, w), ar = dot(r, w), bl = dot(w + 3, u), br = dot(w + 6, u);
      const bool down = al >= 0 && ar <= 0 && bl >= 0 && br <= 0, up = al <= 0 && ar >= 0 && bl <= 0 && br >= 0;
      if (!down && !up) continue;
      T c[3];
      cross(u, w, c);
      const T square = dot(c, c);
      if (!(square > T(256) * rounding<T>())) continue;
      const T* y = b.vertex + 3 * b.ends[2 * second.edge[j]];
      const T between[3] = {x[0] - y[0], x[1] - y[1], x[2] - y[2]}, length = sqrt(square), along = dot(c, between) / length;
      for (int sign = -1; sign <= 1; sign += 2) {
        if (!(sign < 0 ? down : up) || !(sign * along > search.best())) continue;
        const T d[3] = {sign * c[0] / length, sign * c[1] / length, sign * c[2] / length};
        search.look(d);
      }
    }
  }
}

// Bodies without faces of which one lies on the other's line: any direction across it.
template <class T> inline void look_across(Search<T>& search) {
  const Couple<T>& pair = search.pair;
  T u[3] = {0, 0, 0};
  if (pair.a.edges) times(pair.a_in_b.rotation, pair.a.edge, u);
  if (dot(u, u) == 0 && pair.b.edges)
    for (int i = 0; i < 3; i++) u[i] = pair.b.edge[i];
  int least = 2;
  for (int i = 0; i < 2; i++)
    if (abs(u[i]) < abs(u[least])) least = i;
  T across[3] = {0, 0, 0};
  across[least] = 1;
  const T part = dot(u, across);
  for (int i = 0; i < 3; i++) across[i] = fma(-part, u[i], across[i]);
  const T length = sqrt(dot(across, across));
  for (T& x : across) x = x / length;
  search.look(across);
}

// Which of both it is, in the world. radii: of both bodies together.
template <class T> inline void decide(const Search<T>& search, T radii, const Pose<T>& pose_b, bool beyond, Separation<T>& out) {
  constexpr T DEEPER = T(0.05);  // a face is taken where its depth is at most this share larger than the smallest
  const T face = search.face.along - radii, other = search.other.along - radii;
  out.distance = max(face, other);
  const T slack = fma(DEEPER, max(-out.distance, T(0)), search.slack);
  const bool by_face = face >= other - slack;
  times(pose_b.rotation, by_face ? search.face.direction : search.other.direction, out.normal);
  out.along = by_face ? face : other;
  out.beyond = beyond;
}

constexpr double SLACK = 1e-4;  // or its separation at most this share of the smaller body's size less than the largest

// beyond: the distance from which on the bodies cannot touch [m]; ±∞ or any number.
template <class T>
inline void separation(const Couple<T>& pair, const Pose<T>& pose_b, T beyond, Separation<T>& out) {
  const Hull<T>&a = pair.a, &b = pair.b;
  const T radii = a.radius() + b.radius(), slack = T(SLACK) * min(a.size(), b.size()), size = a.size() + b.size();
  Search<T> search{pair, slack, beyond + radii + slack, {}, {}};
  const Pose<T>& pose = pair.a_in_b;
  T back[9], shift[3], inside_a[6], inside_b[6];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) back[3 * i + j] = pose.rotation[3 * j + i];
  times(back, pose.position, shift);
  for (T& x : shift) x = -x;
  placed(pose, a.middle(), inside_b);
  seen_back(pose.rotation, shift, b.middle(), inside_a);
  for (int i = 0; i < 3; i++) inside_a[3 + i] = inside_a[i], inside_b[3 + i] = inside_b[i];

  look_at_faces(b, a, back, pose.position, static_cast<const T*>(nullptr), T(1), search.face, search.other, inside_b + 3);
  if (search.best() > search.enough) return decide(search, radii, pose_b, true, out);
  look_at_faces(a, b, pose.rotation, shift, pose.rotation, T(-1), search.face, search.other, inside_a + 3);
  if (search.best() > search.enough) return decide(search, radii, pose_b, true, out);

  const T room = T(64) * rounding<T>() * size;
  bool settled = false;
  const auto look_between = [&] {
    const Bounds<T> found = nearest_points(pair, search.enough);
    if (found.least > search.other.along) search.other.take(found.least, found.direction, T(1));
    settled = found.least > search.enough || (found.most > T(1e-5) * size && found.most - search.best() <= room);
  };
  const bool open = search.best() > -room || (!a.faces && !b.faces);
  if (open) look_between();
  if (search.best() > search.enough) return decide(search, radii, pose_b, true, out);
  if (!settled) {
    look_at_edges(search, back, shift, inside_a, inside_b);
    if (!open && search.best() > -room) look_between();
    if (!a.faces && !b.faces) look_across(search);
  }
  decide(search, radii, pose_b, search.best() > search.enough, out);
}

}  // namespace pbfd
