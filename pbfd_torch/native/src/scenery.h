// The plan that the lanes share, or that of each lane's own world.
#pragma once
#include "plan.h"

namespace pbfd {

// One for all worlds of a call.
template <class V, class N, int D> struct Scenery {
  Plan<N, D> plan;
  static int room(Sizes) { return 0; }
  Scenery(Sizes s, const int* whole, const N* real, Arena<V>&) : plan(s, whole, real) {}
  void enter(int, int) {}
};

// Worlds that have numbers of their own, [worlds, count]: a lane takes them up with the world.
template <class T, int W, int D> struct Scenery<Lanes<T, W>, Lanes<T, W>, D> {
  using V = Lanes<T, W>;
  const T* all;
  V* here;
  int count;
  Plan<V, D> plan;
  static int room(Sizes s) { return Plan<V, D>::real_numbers(s); }
  Scenery(Sizes s, const int* whole, const T* real, Arena<V>& arena)
      : all(real), here(arena.take(room(s))), count(room(s)), plan(s, whole, here) {}
  void enter(int lane, int world) {
    for (int j = 0; j < count; j++) put(here[j], lane, all[long(world) * count + j]);
  }
};

}  // namespace pbfd
