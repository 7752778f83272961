// What a step that ended somewhere looks like there: whether anything pushes, and whether its root can be trusted, as
// balance/objective.py.
#pragma once
#include "integrators.h"

namespace pbfd {

constexpr double FARTHEST_TURN = 1.57079632679489662;  // [rad] that contacts may turn a joint by in a step

template <class V, class N> struct Sight {
  using M = typename Kind<V>::Mask;
  const Plan<N>& plan;
  Poses<V> there;  // where it looked last
  V *moved, *turned;

  static int room(Sizes s) { return 24 * s.nodes + s.nv; }
  Sight(const Plan<N>& scene, Arena<V>& arena) : plan(scene), there(Poses<V>::in(arena, scene)) {
    moved = arena.take(12 * plan.nodes), turned = arena.take(plan.nv);
  }

  // The normal force of candidate i at a configuration.
  V pressing(const Balance<V, N>& b, int i) const {
    V c[3], push, rises;
    const V reach = V(plan.radius[i]) + V(plan.margin[i]);
    const V depth = reach - height(plan, i, there, c), start = reach - height(plan, i, b.start, c);
    releasing(V(plan.firmness[i]), depth, start, V(plan.release[0]) * b.dt, push, rises);
    return push;
  }

  // Whether contacts or limits push at the end of a step at q.
  M pushes(const Balance<V, N>& b, const V* q) {
    place(plan, q, there);
    M found(false);
    for (int i = 0; i < plan.candidates; i++) found = found | (pressing(b, i) > V(0));
    for (int i = 0; i < plan.nv; i++) turned[i] = V(0);
    joint_loads<LIMITS>(plan, b.steps(), q, turned, static_cast<V*>(nullptr));
    for (int i = 0; i < plan.nv; i++) found = found | (abs(turned[i]) > V(0));
    return found;
  }

  // Whether a step that ended at q has turned a joint by more than a quarter turn, and not because its free motion leads there,
  // with more kinetic energy than the free motion has, while something touches.
  M strayed(const Balance<V, N>& b, const V* q, const V* guess) {
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
      for (int i = 0; i < 9; i++) moved[12 * k + i] = to.rotation[9 * k + i] - from.rotation[9 * k + i];
      for (int i = 0; i < 3; i++) moved[12 * k + 9 + i] = to.position[3 * k + i] - from.position[3 * k + i];
    }
    return kinetic_energy(plan, moved);
  }
};

}  // namespace pbfd
