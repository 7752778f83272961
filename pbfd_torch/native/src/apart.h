// How far two configurations are apart.
#pragma once
#include "tree.h"

namespace pbfd {

// [m]: √(tr(D S Dᵀ)/m), D the difference of a body's poses, of the body for which it is the largest. Bodies without mass do not
// count.
template <class V, class N, int D> inline V apart(const Plan<N, D>& plan, const Poses<V>& one, const Poses<V>& other) {
  V most(0);
  for (int k = 0; k < plan.nodes; k++) {
    V turned[D * D], moved[D], spread[D * D], square(0);
    for (int i = 0; i < D * D; i++) turned[i] = one.rotation[D * D * k + i] - other.rotation[D * D * k + i];
    times<D>(turned, plan.center + D * k, moved);
    for (int i = 0; i < D; i++) moved[i] += one.position[D * k + i] - other.position[D * k + i];
    product<D>(turned, plan.second + D * D * k, spread);
    for (int i = 0; i < D * D; i++) square = fma(spread[i], turned[i], square);
    const V mass = V(plan.mass[k]);
    const auto heavy = mass > V(0);
    const V off = dot<D>(moved, moved) + square / select(heavy, mass, V(1));
    most = select(heavy, max(most, off), most);
  }
  return sqrt(max(most, V(0)));
}

}  // namespace pbfd
