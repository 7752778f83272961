// Convex polytopes as contact/polytope.py has them, and their poses: a table that is read from two arrays.
//
// whole: how many shapes there are; of each, 6 numbers: how many vertices, faces and edges it has, whether it is curved, and
//   where its own numbers begin in `whole` and in `real`. Its own are
//     start  [polygons + 1]  where the corners of each polygon begin among those below, and where the last ones end; there are
//                            as many polygons as faces, and one without faces: the segment or the point
//     flat   [faces]         which faces are the shape's own
//     ends   [edges, 2]      vertices; the point is an edge of length zero
//     corner [start[polygons]]  vertices of the polygons, counter-clockwise seen from outside
// real: of each shape
//     [14]  radius, size, thickness, form [3], half; half extents of a box [3]; the middle of the vertices [3]; how far the curved
//           shape goes beyond the polytope that stands for it, at most; 0 for others
//     vertex [vertices, 3]
//     plane  [faces, 4]      unit outward normal and offset
//     edge   [edges, 9]      unit direction from the first end to the second (zero for the point), and the normals of the face
//                            that has the edge in this direction and of the one that has it in the other (zero: none)
// Lengths are of the shape's own frame [m]. See native/plan_hulls.py, which writes it.
#pragma once
#include "vectors.h"

namespace pbfd {

constexpr int CORNERS = 128;    // of one polygon at most
constexpr int VERTICES = 1024;  // of one polytope at most

template <class T> struct Pose {
  T rotation[9], position[3];  // row by row
};

// One of them.
template <class T> struct Hull {
  int vertices, faces, edges;
  bool curved;
  const int *start, *flat, *ends, *corner;
  const T *number, *vertex, *plane, *edge;

  T radius() const { return number[0]; }
  T size() const { return number[1]; }
  T thickness() const { return number[2]; }
  const T* form() const { return number + 3; }
  T half() const { return number[6]; }
  const T* extents() const { return number + 7; }
  const T* middle() const { return number + 10; }
  T bulge() const { return number[13]; }

  int corners(int polygon) const { return start[polygon + 1] - start[polygon]; }
  const int* polygon(int i) const { return corner + start[i]; }
  // of a segment and a point zero, as for faces that a padded table has too many
  const T* normal(int polygon) const {
    static constexpr T none[4] = {};
    return faces ? plane + 4 * polygon : none;
  }

  // The vertex that is least far along d, and how far.
  int lowest(const T* d, T& least) const {
    int found = 0;
    least = dot(vertex, d);
    for (int i = 1; i < vertices; i++) {
      const T along = dot(vertex + 3 * i, d);
      if (along < least) least = along, found = i;
    }
    return found;
  }

  // The vertex that is farthest along d, and how far.
  int highest(const T* d, T& most) const {
    int found = 0;
    most = dot(vertex, d);
    for (int i = 1; i < vertices; i++) {
      const T along = dot(vertex + 3 * i, d);
      if (along > most) most = along, found = i;
    }
    return found;
  }
};

template <class T> struct Hulls {
  static constexpr int HEADER = 6, NUMBERS = 14;
  const int* whole;
  const T* real;

  int count() const { return whole[0]; }

  Hull<T> operator[](int shape) const {
    const int* head = whole + 1 + HEADER * shape;
    Hull<T> h;
    h.vertices = head[0], h.faces = head[1], h.edges = head[2], h.curved = head[3] != 0;
    h.start = whole + head[4];
    h.flat = h.start + (h.faces > 1 ? h.faces : 1) + 1;
    h.ends = h.flat + h.faces;
    h.corner = h.ends + 2 * h.edges;
    h.number = real + head[5];
    h.vertex = h.number + NUMBERS;
    h.plane = h.vertex + 3 * h.vertices;
    h.edge = h.plane + 4 * h.faces;
    return h;
  }
};

// Products that round as PyTorch's do, after every operation. Corners of boxes are often equally deep or far from another but
// for rounding: with these the same ones are taken.
template <class T> inline T dot_in_order(const T* a, const T* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

template <class T> inline void cross_in_order(const T* a, const T* b, T* out) {
  out[0] = a[1] * b[2] - a[2] * b[1], out[1] = a[2] * b[0] - a[0] * b[2], out[2] = a[0] * b[1] - a[1] * b[0];
}

// out = R x
template <class T> inline void turned_in_order(const T* R, const T* x, T* out) {
  for (int i = 0; i < 3; i++) out[i] = dot_in_order(R + 3 * i, x);
}

// out = Rᵀ x
template <class T> inline void turned_back_in_order(const T* R, const T* x, T* out) {
  for (int i = 0; i < 3; i++) out[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}

// out = R x + p
template <class T> inline void placed_in_order(const Pose<T>& pose, const T* x, T* out) {
  for (int i = 0; i < 3; i++) out[i] = dot_in_order(pose.rotation + 3 * i, x) + pose.position[i];
}

// The pose of one frame as it is seen from another.
template <class T> inline void relative_pose(const Pose<T>& base, const Pose<T>& pose, Pose<T>& out) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const T *u = base.rotation + i, *w = pose.rotation + j;
      out.rotation[3 * i + j] = u[0] * w[0] + u[3] * w[3] + u[6] * w[6];
    }
  T off[3];
  for (int i = 0; i < 3; i++) off[i] = pose.position[i] - base.position[i];
  turned_back_in_order(base.rotation, off, out.position);
}

// out = R x + p
template <class T> inline void placed(const Pose<T>& pose, const T* x, T* out) {
  for (int i = 0; i < 3; i++) {
    const T* row = pose.rotation + 3 * i;
    out[i] = fma(row[0], x[0], fma(row[1], x[1], fma(row[2], x[2], pose.position[i])));
  }
}

}  // namespace pbfd
