// Forces from outside on the nodes, constant in the world, at points fixed on them (terms/pushes.py).
#pragma once
#include "loads.h"

namespace pbfd {

// Adds their loads; how they answer is what the tree does by itself.
template <class V, class N> inline void push_from_outside(const Plan<N, 3>& plan, Poses<V> now, Push<V, 3>* pushes) {
  for (int i = 0; i < plan.pushes; i++) {
    const int k = plan.pushed[i];
    const N* f = plan.push + 3 * i;
    Push<V, 3>& out = pushes[k];
    V p[3];
    times(now.rotation + 9 * k, plan.push_point + 3 * i, p);
    out.open();
    for (int a = 0; a < 3; a++) {
      out.force[a] -= V(f[a]);
      for (int b = 0; b < 3; b++) out.moment[3 * a + b] = fma(-V(f[a]), p[b] + now.position[3 * k + b], out.moment[3 * a + b]);
    }
  }
}

}  // namespace pbfd
