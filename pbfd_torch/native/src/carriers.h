// Obstacles in prescribed motion (contact/motion.py): where they are at the beginning and at the end of what each lane is to
// solve.
#pragma once
#include "tree.h"

namespace pbfd {

// Where they are at all instants at which a step, or a part of one that is halved, may begin or end: rotation and position of
// each obstacle, [instants, worlds, obstacles, 12], those of one world for all worlds that have the same.
template <class T> struct Timetable {
  const T* poses;
  int worlds, obstacles;
  const T* at(long instant, long world) const { return poses + (instant * worlds + (worlds > 1 ? world : 0)) * 12 * obstacles; }
};

template <class V> struct Carriers {
  using T = typename Kind<V>::Scalar;
  int count;
  V *start, *end;  // [12 × count]
  // The solid carries over the step what stands at x by `swung` (x − x₀) + `shift`, with x₀ where it is itself at the start.
  V *swung, *shift;  // [9 × count], [3 × count]

  static int room(Sizes s) { return 36 * s.moving; }
  Carriers(Sizes s, Arena<V>& arena) : count(s.moving) {
    start = arena.take(12 * count), end = arena.take(12 * count), swung = arena.take(9 * count), shift = arena.take(3 * count);
  }

  void load(int i, const T* from, const T* to) {
    for (int j = 0; j < 12 * count; j++) put(start[j], i, from[j]), put(end[j], i, to[j]);
  }

  // A step begins; belt: the velocities [3] of the running surfaces in the solids' frames.
  template <class N> void begin(const N* belt, V dt) {
    for (int m = 0; m < count; m++) {
      const V *from = start + 12 * m, *to = end + 12 * m;
      V turned[9], ran[3];
      for (int j = 0; j < 9; j++) turned[j] = to[j] - from[j];
      product_transposed(turned, from, swung + 9 * m), times(to, belt + 3 * m, ran);
      for (int j = 0; j < 3; j++) shift[3 * m + j] = fma(dt, ran[j], to[9 + j] - from[9 + j]);
    }
  }

  // A point as it is carried along by a solid, and its surface; a body's rotation [9] likewise.
  void carry(int m, V* x) const {
    const V* from = start + 12 * m;
    V off[3], moved[3];
    for (int j = 0; j < 3; j++) off[j] = x[j] - from[9 + j];
    times(swung + 9 * m, off, moved);
    for (int j = 0; j < 3; j++) x[j] += moved[j] + shift[3 * m + j];
  }
  void carry_rotation(int m, const V* R, V* out) const {
    product(swung + 9 * m, R, out);
    for (int j = 0; j < 9; j++) out[j] += R[j];
  }

  // How a solid sees a point at the end of the step; vectors turned from its frame into the world's and back, in place if asked.
  void to_own(int m, const V* x, V* out) const {
    const V* to = end + 12 * m;
    const V off[3] = {x[0] - to[9], x[1] - to[10], x[2] - to[11]};
    transposed_times(to, off, out);
  }
  void turn(int m, const V* x, V* out) const {
    const V own[3] = {x[0], x[1], x[2]};
    times(end + 12 * m, own, out);
  }
  void turn_back(int m, const V* x, V* out) const {
    const V in_world[3] = {x[0], x[1], x[2]};
    transposed_times(end + 12 * m, in_world, out);
  }
};

}  // namespace pbfd
