// Contact points of two convex polytopes, as contact/manifold.py and `_manifolds` of contact/polytope_pairs.py: points of one
// body, the incident one, against a plane of the other, the reference, at the corners of where both overlap.
#pragma once
#include "box_separation.h"
#include "footprint.h"

namespace pbfd {

constexpr int POINTS = 8;

template <class T> struct Met {  // contact points of one pair of shapes
  int count;                     // points there are; the first is the deepest
  bool swapped;                  // false: b has the plane and a gives the points; true: the other way round
  T normal[3], offset;           // of the plane, in the frame of the shape that has it, with that shape's radius
  T point[POINTS][3], gap[POINTS];  // on the core of the other shape, in its frame; gap of the rounded body [m]
};

constexpr double ALIGNED = 1e-5;  // 1 − cosine of the largest angle between a face's normal and the direction in face contact

// Largest cosine between the normal of a flat face and a direction, and which face; −1 where there are none.
template <class T> inline T aligned(const Hull<T>& hull, const T* outward, int& face) {
  T best = -1;
  face = 0;
  for (int f = 0; f < hull.faces; f++) {
    const T cosine = hull.flat[f] ? dot_in_order(hull.plane + 4 * f, outward) : T(-1);
    if (cosine > best) best = cosine, face = f;
  }
  return best;
}

// The polygon that meets a plane with normal n: of the faces at the lowest vertex, the most anti-parallel one.
// own: n in the frame of the hull.
template <class T>
inline int incident_polygon(const Hull<T>& hull, const T* rotation, const T* n, const T* own, T room) {
  int found = 0;
  T least, best = infinite<T>();
  hull.lowest(own, least);
  for (int f = 0; f < hull.faces; f++) {
    T normal[3];
    turned_in_order(rotation, hull.plane + 4 * f, normal);
    const T facing = dot_in_order(normal, n);
    if (!(facing < best)) continue;
    const int *corner = hull.polygon(f), count = hull.corners(f);
    for (int i = 0; i < count; i++)
      if (dot(hull.vertex + 3 * corner[i], own) <= least + room) {
        best = facing, found = f;
        break;
      }
  }
  return found;
}

// The flattest edge at the lowest vertex along n, where the hull is in its own frame or at a pose. own: n in its frame.
template <class T> inline int support_edge(const Hull<T>& hull, const Pose<T>* pose, const T* n, const T* own) {
  T least, most, best = infinite<T>();
  hull.lowest(own, least), hull.highest(own, most);
  const T low = fma(sqrt(rounding<T>()), most - least, least);
  int found = 0;
  for (int e = 0; e < hull.edges; e++) {
    const T *p = hull.vertex + 3 * hull.ends[2 * e], *q = hull.vertex + 3 * hull.ends[2 * e + 1];
    if (!(min(dot(p, own), dot(q, own)) <= low)) continue;
    T x[3] = {p[0], p[1], p[2]}, y[3] = {q[0], q[1], q[2]};
    if (pose) placed_in_order(*pose, p, x), placed_in_order(*pose, q, y);
    const T high = max(dot_in_order(x, n), dot_in_order(y, n));
    if (high < best) best = high, found = e;
  }
  return found;
}

// As `share_of` of contact/segments.py.
template <class T> inline T share_of(T along, T square) { return clamped(square > 0 ? along / square : along, T(0), T(1)); }

// Adds the points of the second segment nearest to the first: one, or both ends of the overlap of parallel segments.
template <class T>
inline void add_edge_points(const T* p, const T* p_end, const T* q, const T* q_end, const T* n, Spots<T>& out) {
  constexpr T PARALLEL = T(1e-2);  // sine under which edges are parallel
  const T d[3] = {p_end[0] - p[0], p_end[1] - p[1], p_end[2] - p[2]}, e[3] = {q_end[0] - q[0], q_end[1] - q[1], q_end[2] - q[2]};
  const T gap[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
  const T dd = dot_in_order(d, d), ee = dot_in_order(e, e), de = dot_in_order(d, e), sine = dd * ee - de * de;
  const T gd = dot_in_order(gap, d), ge = dot_in_order(gap, e);
  T share[2];
  int count = 1;
  if (sine <= PARALLEL * PARALLEL * dd * ee) {
    share[0] = share_of(-ge, ee), share[1] = share_of(de - ge, ee);  // the first segment's ends on the second
    count = share[0] != share[1] ? 2 : 1;
  } else {  // nearest points of the lines, then each pulled into its segment and matched by the other's
    const T crossing = (de * gd - dd * ge) / sine, on_first = share_of(gd + clamped(crossing, T(0), T(1)) * de, dd);
    share[0] = share_of(on_first * de - ge, ee);
  }
  for (int i = 0; i < count; i++) add_between(q, q_end, share[i], n, out);
}

// The corners of a polygon, as they are seen from another frame.
template <class T> inline void put_corners(const Hull<T>& hull, int polygon, const Pose<T>* pose, Footprint<T>& out) {
  const int* corner = hull.polygon(polygon);
  out.count = hull.corners(polygon);
  for (int i = 0; i < out.count; i++) {
    const T* x = hull.vertex + 3 * corner[i];
    for (int k = 0; k < 3; k++) out.corner[i][k] = x[k];
    if (pose) placed_in_order(*pose, x, out.corner[i]);
  }
}

// normal: the direction of separation from b to a, in the world; whole: all corners of the incident body count, not those of the
// overlap alone.
template <class T>
inline void manifold(const Hull<T>& a, const Hull<T>& b, const Pose<T>& pose_a, const Pose<T>& pose_b, const T* normal,
                     bool whole, Met<T>& out) {
  constexpr T MERGED = T(1e-3), TURN = T(ALIGNED);  // points nearer than this share of the smaller body's size are one
  const T back[3] = {-normal[0], -normal[1], -normal[2]};
  T toward_a[3], toward_b[3];
  int face_a, face_b;
  turned_back_in_order(pose_a.rotation, back, toward_a), turned_back_in_order(pose_b.rotation, normal, toward_b);
  const T aligned_a = aligned(a, toward_a, face_a), aligned_b = aligned(b, toward_b, face_b);
  const bool by_face = max(aligned_a, aligned_b) > 1 - TURN;
  // a curved body gives the points wherever it can: they move over it
  const T flat_a = a.curved ? aligned_a - 2 * TURN : aligned_a, flat_b = b.curved ? aligned_b - 2 * TURN : aligned_b;
  bool swapped = by_face ? flat_a > flat_b + TURN : aligned_a > aligned_b + TURN;
  if (!by_face && a.curved != b.curved) swapped = b.curved;
  const Hull<T>&reference = swapped ? a : b, &incident = swapped ? b : a;
  const int face = swapped ? face_a : face_b;
  const T* toward = swapped ? toward_a : toward_b;

  // from here on in the frame of the reference
  Pose<T> pose;
  relative_pose(swapped ? pose_a : pose_b, swapped ? pose_b : pose_a, pose);
  T n[3], h, own[3];
  for (int i = 0; i < 3; i++) n[i] = by_face ? reference.plane[4 * face + i] : toward[i];
  if (by_face) {
    h = reference.plane[4 * face + 3];
  } else if (reference.curved) {
    const T squares[3] = {toward[0] * toward[0], toward[1] * toward[1], toward[2] * toward[2]};
    h = fma(reference.half(), abs(toward[2]), sqrt(dot(reference.form(), squares)));
  } else {
    reference.highest(toward, h);
  }
  turned_back_in_order(pose.rotation, n, own);  // n in the frame of the incident body
  const T away = sqrt(dot(pose.position, pose.position));
  const T room = T(64) * rounding<T>() * (reference.size() + incident.size() + away);
  const T merged = max(MERGED * min(reference.size(), incident.size()), room);

  Spots<T> spots;
  if (by_face) {
    Footprint<T> base, other;
    put_corners(reference, face, static_cast<const Pose<T>*>(nullptr), base);
    base.raise(n, room);
    const int polygon = incident_polygon(incident, pose.rotation, n, own, room);
    T facing[3];
    turned_in_order(pose.rotation, incident.normal(polygon), facing);
    put_corners(incident, polygon, &pose, other);
    cut(base, other, facing, n, room, merged, spots);
  } else {
    const T down[3] = {-n[0], -n[1], -n[2]};
    const int* first = reference.ends + 2 * support_edge(reference, static_cast<const Pose<T>*>(nullptr), down, down);
    const int* second = incident.ends + 2 * support_edge(incident, &pose, n, own);
    T q[3], q_end[3];
    placed_in_order(pose, incident.vertex + 3 * second[0], q), placed_in_order(pose, incident.vertex + 3 * second[1], q_end);
    add_edge_points(reference.vertex + 3 * first[0], reference.vertex + 3 * first[1], q, q_end, n, spots);
  }
  for (int i = 0; whole && i < incident.vertices; i++) {
    T x[3];
    placed_in_order(pose, incident.vertex + 3 * i, x);
    spots.add(x, n);
  }

  int taken[POINTS];
  out.count = spots.spread(POINTS, merged, taken);
  out.swapped = swapped;
  out.offset = h + reference.radius();
  for (int i = 0; i < 3; i++) out.normal[i] = n[i];
  for (int i = 0; i < out.count; i++) {
    const T *x = spots.at[taken[i]], off[3] = {x[0] - pose.position[0], x[1] - pose.position[1], x[2] - pose.position[2]};
    turned_back_in_order(pose.rotation, off, out.point[i]);
    out.gap[i] = spots.height[taken[i]] - out.offset - incident.radius();
  }
}

// Contact points of shapes a and b, both boxes or not, that come nearer to each other by `moves` at most [m]. None where they
// are too far apart; some may be farther apart than that.
template <class T>
inline void meet(const Hulls<T>& hulls, int a, int b, bool boxes, const Pose<T>& pose_a, const Pose<T>& pose_b, T moves,
                 Met<T>& out, Separation<T>& apart) {
  out = {};
  apart = {{0, 0, 1}, 0, 0, true};
  Couple<T> pair{hulls[a], hulls[b], {}};
  relative_pose(pose_b, pose_a, pair.a_in_b);
  T sum = 0;  // of no place nothing can be said
  for (int i = 0; i < 3; i++) sum += T(0) * pose_b.position[i] + T(0) * pair.a_in_b.position[i];
  for (int i = 0; i < 9; i++) sum += T(0) * pose_b.rotation[i] + T(0) * pair.a_in_b.rotation[i];
  if (!(sum == 0)) return;
  const T most = moves + T(0.01) * max(pair.a.size(), pair.b.size()) + (pair.a.bulge() + pair.b.bulge());
  (boxes ? box_separation<T> : separation<T>)(pair, pose_b, most, apart);
  if (apart.beyond || apart.along > most) return;
  // apart, and perhaps past the middle of the thinner one at the end: whatever corner turns round meets the plane as well
  const T middle = T(0.5) * min(pair.a.thickness(), pair.b.thickness());
  const bool whole = apart.distance > middle && moves > apart.distance + middle;
  manifold(pair.a, pair.b, pose_a, pose_b, apart.normal, whole, out);
}

template <class T>
inline void meet(const Hulls<T>& hulls, int a, int b, bool boxes, const Pose<T>& pose_a, const Pose<T>& pose_b, T moves,
                 Met<T>& out) {
  Separation<T> apart;
  meet(hulls, a, b, boxes, pose_a, pose_b, moves, out, apart);
}

}  // namespace pbfd
