// Smooth loads on joints between the trapezoidal rule and implicit Euler, as integrators/fitted.py.
#pragma once
#include <cmath>
#include "plan.h"

namespace pbfd {

// θ(z) = 1/(1 − e^{−z}) − 1/z.
inline double fit(double z) { return z < 1e-3 ? 0.5 + z / 12 : -1 / std::expm1(-z) - 1 / z; }

// θ [nv] of one lane's springs, damping and actuators in a step [s]: of the stiffness z that all of them have together. The largest
// z.
template <class V, class N, int D>
inline typename Kind<V>::Scalar fit(const Plan<N, D>& plan, int i, typename Kind<V>::Scalar step, V* share) {
  using T = typename Kind<V>::Scalar;
  auto number = [&](const N* of, int j) { return lane(of[j], i); };
  T most(0);
  for (int j = 0; j < plan.nv; j++) put(share[j], i, number(plan.spring, j) + number(plan.damping, j) / step);
  for (int k = 0; k < plan.nu; k++) {
    V& slope = share[plan.actuated_v[k]];
    const T gear = number(plan.gear, k), of_it = number(plan.stiffness, k) + number(plan.resistance, k) / step;
    put(slope, i, lane(slope, i) + gear * gear * of_it);
  }
  for (int n = 0; n < plan.nodes; n++)
    for (int j = plan.v[n]; j < plan.v[n] + freedoms(plan.kind[n]); j++) {
      const bool adds_up = freedoms(plan.kind[n]) == 1 || j < plan.v[n] + straight(plan.kind[n]);
      const T slope = lane(share[j], i), z = step * step * slope / number(plan.felt, j);
      most = z > most ? z : most;
      put(share[j], i, !adds_up && slope > T(0) ? T(1) : T(fit(double(z))));
    }
  return most;
}

}  // namespace pbfd
