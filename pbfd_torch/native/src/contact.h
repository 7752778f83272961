// Balls and points of the bodies against half-spaces: N n − G u at p = c − ρ n (METHOD §4), as terms/touching.py.
#pragma once
#include "friction.h"
#include "loads.h"
#include "release.h"

namespace pbfd {

// What is fixed in a step: where the candidates and their nodes were at its start.
template <class V> struct ContactStep {
  Poses<V> start;
  V dt;
};

template <class V, class N, int D> inline V height(const Plan<N, D>& plan, int i, Poses<V> at, V* center) {
  const int k = plan.carrier[i];
  times<D>(at.rotation + D * D * k, plan.position + D * i, center);
  for (int j = 0; j < D; j++) center[j] += at.position[D * k + j];
  V sum = V(plan.normal[D * i + D - 1]) * center[D - 1];
  for (int j = D - 2; j >= 0; j--) sum = fma(V(plan.normal[D * i + j]), center[j], sum);
  return sum - V(plan.offset[i]);
}

// Adds the forces on all nodes, and how they answer; `rolls` [3] and `turned` per node: room for their rotations over the step.
template <class V, class N, int D>
inline void contacts(const Plan<N, D>& plan, const ContactStep<V>& step, Poses<V> now, Push<V, D>* pushes, V* rolls, bool* turned) {
  constexpr int T = turns(D), S = T + D;
  const V zero(0), per_dt = V(1) / step.dt;
  const V per_range = per_dt * V(N(1) / plan.release[0]), per_width = per_dt * V(N(1) / plan.slip_speed[0]);
  for (int k = 0; k < plan.nodes; k++) turned[k] = false;
  for (int i = 0; i < plan.candidates; i++) {
    V c[D], before[D], n[D];
    const V reach = V(plan.radius[i]) + V(plan.margin[i]), depth = reach - height(plan, i, now, c);
    if (!any(depth > zero)) continue;
    const int k = plan.carrier[i];
    const V radius = V(plan.radius[i]), start = reach - height(plan, i, step.start, before);
    V roll[T * T] = {}, moved[D];
    const bool round = any(plan.radius[i] > N(0));
    for (int j = 0; j < D; j++) moved[j] = c[j] - before[j], n[j] = V(plan.normal[D * i + j]);
    if (round) {
      V *phi = rolls + 3 * k, beside[D];
      if (!turned[k]) rotation_between<D>(now.rotation + D * D * k, step.start.rotation + D * D * k, phi), turned[k] = true;
      swing<D>(phi, n, beside);
      for (int j = 0; j < D; j++) moved[j] = fma(-radius, beside[j], moved[j]);
      log_jacobian<D>(phi, V(-0.5), roll);
    }
    const V lifted = dot<D>(moved, n);
    V u[D], p[D];
    for (int j = 0; j < D; j++) u[j] = fma(-lifted, n[j], moved[j]), p[j] = fma(-radius, n[j], c[j]);
    V N_, rises, factor, falls;
    release_law(V(plan.firmness[i]), depth, start, per_range, N_, rises);
    const V size = sqrt(dot<D>(u, u)), mu = V(plan.grip[i]);
    slip_law(size, per_width, factor, falls);
    const V drag = mu * N_ * factor, by_depth = mu * rises * factor, by_size = mu * N_ * falls;
    V f[D];
    for (int j = 0; j < D; j++) f[j] = fma(N_, n[j], -(drag * u[j]));

    // how the centre, the depth and the slip answer (ω, v): [−[c]× | 1], n · that, and (1 − nnᵀ) of it and of the rolling
    V sinks[S], move[D * S], answer[D * S];
    lever<D>(c, n, sinks);
    for (int j = 0; j < D; j++) sinks[T + j] = n[j];
    V arm[D * T];
    arms<D>(c, arm);
    for (int a = 0; a < D; a++) {
      for (int b = 0; b < T; b++) move[S * a + b] = arm[T * a + b];
      for (int b = 0; b < D; b++) move[S * a + T + b] = a == b ? V(1) : zero;
    }
    for (int b = 0; round && b < T; b++) {
      V column[T], beside[D];
      for (int a = 0; a < T; a++) column[a] = roll[T * a + b];
      swing<D>(column, n, beside);
      for (int a = 0; a < D; a++) move[S * a + b] = fma(-radius, beside[a], move[S * a + b]);
    }
    for (int b = 0; b < S; b++) {
      V column[D];
      for (int a = 0; a < D; a++) column[a] = move[S * a + b];
      const V along = dot<D>(n, column);
      for (int a = 0; a < D; a++) column[a] = fma(-along, n[a], column[a]);
      const V grows = dot<D>(u, column), resists = fma(by_size, grows, -(by_depth * sinks[b])), presses = rises * sinks[b];
      for (int a = 0; a < D; a++) answer[S * a + b] = fma(n[a], presses, fma(drag, column[a], u[a] * resists));
    }
    Push<V, D>& out = pushes[k];
    out.open();
    for (int a = 0; a < D; a++) {
      out.force[a] -= f[a];
      for (int b = 0; b < D; b++) out.moment[D * a + b] = fma(-f[a], p[b], out.moment[D * a + b]);
    }
    for (int b = 0; b < S; b++) {
      V column[D], torque[T];
      for (int a = 0; a < D; a++) column[a] = answer[S * a + b];
      lever<D>(p, column, torque);
      for (int a = 0; a < T; a++) out.stiffness[S * a + b] += torque[a];
      for (int a = 0; a < D; a++) out.stiffness[S * (T + a) + b] += column[a];
    }
    if (round) {  // the force does not act on one material point
      V pulled[D * D], turning[T * T];
      for (int a = 0; a < D; a++)
        for (int b = 0; b < D; b++) pulled[D * a + b] = radius * n[a] * f[b];
      resistance<D>(pulled, turning);
      for (int a = 0; a < T; a++)
        for (int b = 0; b < T; b++) out.stiffness[S * a + b] += turning[T * a + b];
    }
  }
}

}  // namespace pbfd
