// Inertia and gravity of the links, pulled to the integrator's target poses (Eq. 5), as terms/inertia.py.
//
// Points p, pulled to p̂ by f = κ m (p − p̂), work on the chord of the step, at p̄ = p₀ + w (p − p₀); w = 1 is the paper's, at the
// end of the step. When p moves, p̄ × f changes by κ m p̄ × δp + w δp × f = κ m p̃ × δp, where p̃ = p₀ + w (p̂ − p₀) does not move.
#pragma once
#include "loads.h"

namespace pbfd {

template <class V> inline V blended(V share, V start, V end) { return fma(share, end - start, start); }

// What does not change in a step.
template <class V, int D = 3> struct Hold {
  V start[D], aimed[D];  // the mass' centre at the start, and where it is pulled to
  V spread[D * D];       // κ Σ R̃ᵀ
  V held[D];             // κ m x̃
  V torque[turns(D)];    // (1 − w) κ Σ p̂ × p₀ about the centre, which R brings to zero
};

// The places p̃ of a node's mass: `other` is p̂, or p to know how f alone answers.
template <class V, class N, int D>
inline void hold_by(const Plan<N, D>& plan, int k, V weight, V share, Poses<V> start, Poses<V> other, Hold<V, D>& out) {
  const V *R = other.rotation + D * D * k, *R0 = start.rotation + D * D * k, mass = weight * V(plan.mass[k]);
  V between[D * D], x[D];
  for (int i = 0; i < D * D; i++) between[i] = weight * blended(share, R0[i], R[i]);
  product_transposed<D>(plan.second + D * D * k, between, out.spread);
  times<D>(R, plan.center + D * k, x);
  for (int i = 0; i < D; i++) out.held[i] = mass * blended(share, out.start[i], x[i] + other.position[D * k + i]);
}

template <class V, class N, int D>
inline void hold(const Plan<N, D>& plan, int k, V weight, V share, Poses<V> start, Poses<V> target, Hold<V, D>& out) {
  const V *R = start.rotation + D * D * k, *aim = target.rotation + D * D * k;
  V spread[D * D], moment[D * D];
  times<D>(R, plan.center + D * k, out.start), times<D>(aim, plan.center + D * k, out.aimed);
  for (int i = 0; i < D; i++) out.start[i] += start.position[D * k + i], out.aimed[i] += target.position[D * k + i];
  product<D>(aim, plan.second + D * D * k, spread);
  product_transposed<D>(spread, R, moment);
  curl<D>(moment, out.torque);
  for (int i = 0; i < turns(D); i++) out.torque[i] *= weight * (V(1) - share);
  hold_by(plan, k, weight, share, start, target, out);
}

template <class V, class N, int D>
inline void pull(const Plan<N, D>& plan, int k, V weight, V share, const Hold<V, D>& hold, Poses<V> now, Pull<V, D>& out) {
  const V mass = weight * V(plan.mass[k]);
  V x[D], middle[D], K[D * D], torque[turns(D)];
  times<D>(now.rotation + D * D * k, plan.center + D * k, x);
  for (int i = 0; i < D; i++) {
    x[i] += now.position[D * k + i];
    middle[i] = blended(share, hold.start[i], x[i]);
    out.force[i] = mass * (x[i] - hold.aimed[i]), out.first[i] = mass * x[i];
  }
  lever<D>(middle, out.force, torque);
  product<D>(now.rotation + D * D * k, hold.spread, K);
  curl<D>(K, out.torque);
  for (int i = 0; i < turns(D); i++) out.torque[i] += torque[i] - hold.torque[i];
  for (int i = 0; i < D; i++)
    for (int j = 0; j < D; j++) K[D * i + j] = fma(x[i], hold.held[j], K[D * i + j]);
  resistance<D>(K, out.turning);
}

}  // namespace pbfd
