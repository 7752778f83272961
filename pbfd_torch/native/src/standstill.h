// Worlds that cannot be stepped stand still, as stepping/standstill.py and tree/bounds.py: those that are not finite, too far, too fast.
#pragma once
#include "plan.h"

namespace pbfd {

constexpr double FARTHEST_COORDINATE = 1e9, FASTEST = 1e6, FULLEST_TURN = 100.0;  // [m, rad], [m/s, rad/s], [rad] in a step

template <class V> inline typename Kind<V>::Mask finite(const V* x, int count) {
  typename Kind<V>::Mask all(true);
  for (int i = 0; i < count; i++) all = all & (abs(x[i]) < infinite<V>());
  return all;
}

template <class V> inline typename Kind<V>::Mask near(const V* q, int count) {
  typename Kind<V>::Mask all(true);
  for (int i = 0; i < count; i++) all = all & (abs(q[i]) <= V(FARTHEST_COORDINATE));
  return all;
}

// Who can make a step Δt with the velocity v.
template <class V, class N, int D> inline typename Kind<V>::Mask slow(const Plan<N, D>& plan, const V* v, V dt) {
  typename Kind<V>::Mask all(true);
  for (int i = 0; i < plan.nv; i++)
    all = all & (abs(v[i]) <= V(FASTEST)) & (abs(v[i]) * V(plan.turns[i]) * dt <= V(FULLEST_TURN));
  return all;
}

}  // namespace pbfd
