// Separation of two boxes in closed form, as `box_separation` of contact/separation.py: the 15 axes of the separating-axis test,
// and where these leave them apart the direction from the vertex that is nearest to the other box. What a box covers along a
// direction d is Σ |d·axis| half an extent to either side of its middle.
#pragma once
#include "separation.h"

namespace pbfd {

// The vertex of a box that is nearest to another box, less its nearest point there, in the frame of this other box. turn, shift:
// where the box is in that frame. The square of the distance.
template <class T>
inline T from_nearest_vertex(const T* half, const T* turn, const T* shift, const T* other_half, T* best) {
  T least = infinite<T>();
  for (int corner = 0; corner < 8; corner++) {
    T x[3], d[3];
    const T own[3] = {corner & 4 ? half[0] : -half[0], corner & 2 ? half[1] : -half[1], corner & 1 ? half[2] : -half[2]};
    times(turn, own, x);
    for (int i = 0; i < 3; i++) {
      const T at = x[i] + shift[i];
      d[i] = at - clamped(at, -other_half[i], other_half[i]);
    }
    const T square = dot(d, d);
    if (square > 0 && square < least) {
      least = square;
      for (int i = 0; i < 3; i++) best[i] = d[i];
    }
  }
  return least;
}

template <class T>
inline void box_separation(const Couple<T>& pair, const Pose<T>& pose_b, T beyond, Separation<T>& out) {
  const T *A = pair.a.extents(), *B = pair.b.extents(), *R = pair.a_in_b.rotation, *t = pair.a_in_b.position;
  const T radii = pair.a.radius() + pair.b.radius(), slack = T(SLACK) * min(pair.a.size(), pair.b.size());
  Search<T> search{pair, slack, beyond + radii + slack, {}, {}};
  T Q[9], shift[3];  // |R|; where the middle of b is in the frame of a
  for (int i = 0; i < 9; i++) Q[i] = abs(R[i]);
  transposed_times(R, t, shift);
  for (T& x : shift) x = -x;
  for (int i = 0; i < 3; i++) {
    const T along = abs(t[i]) - B[i] - dot(Q + 3 * i, A), axis[3] = {T(i == 0), T(i == 1), T(i == 2)};
    if (along > search.face.along) search.face.take(along, axis, t[i] < 0 ? T(-1) : T(1));
  }
  for (int j = 0; j < 3; j++) {
    const T cover[3] = {Q[j], Q[3 + j], Q[6 + j]}, axis[3] = {R[j], R[3 + j], R[6 + j]};
    const T along = abs(shift[j]) - A[j] - dot(cover, B);
    if (along > search.face.along) search.face.take(along, axis, shift[j] > 0 ? T(-1) : T(1));
  }
  if (search.best() > search.enough) return decide(search, radii, pose_b, true, out);

  // across the axis j of a and i of b: what both cover, of the cross product, before it is scaled
  const T parallel = sqrt(rounding<T>());
  for (int j = 0; j < 3; j++) {
    const int k = (j + 1) % 3, l = (j + 2) % 3;
    for (int i = 0; i < 3; i++) {
      const int m = (i + 1) % 3, n = (i + 2) % 3;
      const T um = R[3 * m + j], un = R[3 * n + j], square = fma(um, um, un * un);
      if (!(square > parallel)) continue;
      const T ahead = fma(un, t[m], -(um * t[n]));  // c = u × e
      const T cover = fma(A[k], Q[3 * i + l], fma(A[l], Q[3 * i + k], fma(B[m], Q[3 * n + j], B[n] * Q[3 * m + j])));
      const T length = sqrt(square), along = (abs(ahead) - cover) / length;
      if (!(along > search.other.along)) continue;
      T c[3];
      c[i] = 0, c[m] = un / length, c[n] = -um / length;
      search.other.take(along, c, ahead < 0 ? T(-1) : T(1));
    }
  }
  if (search.best() > search.enough) return decide(search, radii, pose_b, true, out);

  const T room = T(64) * rounding<T>() * (pair.a.size() + pair.b.size());
  if (search.best() > -room) {
    T turn[9], d[3] = {0, 0, 0}, e[3] = {0, 0, 0};
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) turn[3 * i + j] = R[3 * j + i];
    const T from_b = from_nearest_vertex(A, R, t, B, d), from_a = from_nearest_vertex(B, turn, shift, A, e);
    const auto look = [&](const T* v, T square, T sign) {  // in the frame of b
      T own[3];
      const T length = sqrt(square), u[3] = {v[0] / length, v[1] / length, v[2] / length};
      transposed_times(R, u, own);
      T along = sign * dot(u, t);
      for (int i = 0; i < 3; i++) along = along - abs(u[i]) * B[i] - abs(own[i]) * A[i];
      if (along > search.other.along) search.other.take(along, u, sign);
    };
    if (from_b < infinite<T>()) look(d, from_b, T(1));
    if (from_a < infinite<T>()) {
      times(R, e, d);
      look(d, from_a, T(-1));
    }
  }
  decide(search, radii, pose_b, search.best() > search.enough, out);
}

}  // namespace pbfd
