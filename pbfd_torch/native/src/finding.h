// Contact points of many pairs of shapes, one after another: for tests of manifold.h.
#pragma once
#include "manifold.h"

namespace pbfd {

// Of pair k: shapes, and whether both are boxes, pairs [3]; where they are, poses [2, 12], rotation and position, row by row; by
// how much they come nearer, moves. counts [2]: count, swapped; found [4 + 4 · POINTS]: normal, offset, and each point with its
// gap; apart [5]: direction, separation along it and distance, lower bounds where no points are looked for.
template <class T>
inline void find_pair(const Hulls<T>& hulls, int k, const int* pairs, const T* poses, const T* moves, int* counts, T* found,
                      T* apart) {
  const int* pair = pairs + 3 * k;
  Pose<T> pose[2];
  for (int i = 0; i < 2; i++) {
    const T* from = poses + 12 * (2 * k + i);
    for (int j = 0; j < 9; j++) pose[i].rotation[j] = from[j];
    for (int j = 0; j < 3; j++) pose[i].position[j] = from[9 + j];
  }
  Met<T> met;
  Separation<T> separation;
  meet(hulls, pair[0], pair[1], pair[2] != 0, pose[0], pose[1], moves[k], met, separation);
  counts[2 * k] = met.count, counts[2 * k + 1] = met.swapped;
  T* out = found + (4 + 4 * POINTS) * k;
  for (int i = 0; i < 3; i++) out[i] = met.normal[i], apart[5 * k + i] = separation.normal[i];
  out[3] = met.offset, apart[5 * k + 3] = separation.along, apart[5 * k + 4] = separation.distance;
  for (int i = 0; i < POINTS; i++) {
    for (int j = 0; j < 3; j++) out[4 + 4 * i + j] = met.point[i][j];
    out[7 + 4 * i] = met.gap[i];
  }
}

template <class T>
inline void find_pairs(const int* whole, const void* real, int count, const int* pairs, const void* poses, const void* moves,
                       int* counts, void* found, void* apart) {
  const Hulls<T> hulls{whole, static_cast<const T*>(real)};
  for (int k = 0; k < count; k++)
    find_pair(hulls, k, pairs, static_cast<const T*>(poses), static_cast<const T*>(moves), counts, static_cast<T*>(found),
              static_cast<T*>(apart));
}

}  // namespace pbfd
