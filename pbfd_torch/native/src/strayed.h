// What a step that ended somewhere looks like there: whether anything pushes, and whether its root can be trusted, as
// balance/objective.py.
#pragma once
#include "forces.h"
#include "integrators.h"

namespace pbfd {

constexpr double FARTHEST_TURN = 1.57079632679489662;  // [rad] that contacts may turn a joint by in a step

template <class V, class N, int D> struct Sight {
  using M = typename Kind<V>::Mask;
  const Plan<N, D>& plan;
  Poses<V> there;  // where it looked last
  V *axes, *moved, *turned, *slopes;

  static int room(Sizes s) { return 2 * (D * D + D) * s.nodes + (turns(D) + D + 2) * s.nv; }
  Sight(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene), there(Poses<V>::template in<D>(arena, scene)) {
    axes = arena.take((turns(D) + D) * plan.nv), moved = arena.take((D * D + D) * plan.nodes);
    turned = arena.take(plan.nv), slopes = arena.take(plan.nv);
  }

  void look(const V* q) { place(plan, q, there, axes); }

  // Whether contacts or limits push at the end of a step at q; raised: see `Contacts`.
  M pushes(const Balance<V, N, D>& b, const V* q, bool raised = true) {
    look(q);
    M found(false);
    b.each_normal_force(there, [&](int, V force, V) { found = found | (force > V(0)); }, raised);
    forces_of<LIMITS>(b, q, turned, slopes);
    for (int i = 0; i < plan.nv; i++) found = found | (abs(turned[i]) > V(0));
    return found;
  }

  // Whether a step that ended at q has turned a joint by more than a quarter turn, and not because its free motion leads there,
  // with more kinetic energy than the free motion has, while something touches.
  M strayed(const Balance<V, N, D>& b, const V* q, const V* guess) {
    const M far = (turn(b.q_start, q) > V(FARTHEST_TURN)) & (turn(guess, q) > V(FARTHEST_TURN));
    if (!any(far)) return far;
    const M touching = pushes(b, q);
    return far & touching & (energy(b.start, there) > energy(b.start, b.target));
  }

 private:
  // The largest turn of a joint between two configurations.
  V turn(const V* from, const V* to) {
    V largest(0);
    difference(plan, from, to, turned);
    for (int i = 0; i < plan.nv; i++) largest = max(largest, abs(turned[i]) * V(plan.turns[i]));
    return largest;
  }
  V energy(Poses<V> from, Poses<V> to) {
    for (int k = 0; k < plan.nodes; k++) {
      V* shift = moved + (D * D + D) * k;
      for (int i = 0; i < D * D; i++) shift[i] = to.rotation[D * D * k + i] - from.rotation[D * D * k + i];
      for (int i = 0; i < D; i++) shift[D * D + i] = to.position[D * k + i] - from.position[D * k + i];
    }
    return kinetic_energy(plan, moved);
  }
};

}  // namespace pbfd
