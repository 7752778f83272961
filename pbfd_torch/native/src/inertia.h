// Inertia and gravity of the links, pulled to the integrator's target poses (Eq. 5), as terms/inertia.py.
#pragma once
#include "loads.h"

namespace pbfd {

// Of one node: D = T − T̂ works on the chord's poses, T̄ = T₀ + w (T − T₀); w = 1 is the paper's, at the end of the step.
template <class V, class N>
inline void pull(const Plan<N>& plan, int k, V weight, V share, Poses<V> start, Poses<V> target, Poses<V> now, Pull<V>& out) {
  const N *center = plan.center + 3 * k, *second = plan.second + 9 * k;
  const V *R = now.rotation + 9 * k, *R0 = start.rotation + 9 * k, *aim = target.rotation + 9 * k;
  const V mass = weight * V(plan.mass[k]);
  V chord[9], lag[9], spread[9];
  for (int i = 0; i < 9; i++) chord[i] = fma(share, R[i] - R0[i], R0[i]), lag[i] = R[i] - aim[i];
  V x[3], x0[3], aimed[3], middle[3], behind[3];
  times(R, center, x), times(R0, center, x0), times(aim, center, aimed);
  for (int i = 0; i < 3; i++) {
    x[i] += now.position[3 * k + i], x0[i] += start.position[3 * k + i], aimed[i] += target.position[3 * k + i];
    middle[i] = fma(share, x[i] - x0[i], x0[i]);
    behind[i] = mass * (x[i] - aimed[i]);
    out.force[i] = behind[i], out.first[i] = mass * x[i], out.on_chord[i] = mass * middle[i];
  }
  out.mass = mass;
  product(lag, second, spread);
  product_transposed(spread, chord, out.moment);
  product_transposed(spread, R, out.at_end);
  product(R, second, spread);
  product_transposed(spread, chord, out.second);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      out.moment[3 * i + j] = fma(weight, out.moment[3 * i + j], behind[i] * middle[j]);
      out.at_end[3 * i + j] = fma(weight, out.at_end[3 * i + j], behind[i] * x[j]);
      out.second[3 * i + j] = fma(weight, out.second[3 * i + j], out.first[i] * middle[j]);
    }
}

}  // namespace pbfd
