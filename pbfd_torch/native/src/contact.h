// Balls and points of the bodies against half-spaces: N n − G u at p = c − ρ n (METHOD §4), as terms/touching.py.
#pragma once
#include "friction.h"
#include "loads.h"
#include "relaxed.h"
#include "release.h"

namespace pbfd {

// What is fixed in a step: where the candidates and their nodes were at its start.
template <class V> struct ContactStep {
  Poses<V> start;
  V dt;
  const Relaxed<V>& relaxed;
};

template <class V, class N> inline V height(const Plan<N>& plan, int i, Poses<V> at, V* center) {
  const int k = plan.carrier[i];
  times(at.rotation + 9 * k, plan.position + 3 * i, center);
  for (int j = 0; j < 3; j++) center[j] += at.position[3 * k + j];
  const N* n = plan.normal + 3 * i;
  return fma(V(n[0]), center[0], fma(V(n[1]), center[1], V(n[2]) * center[2])) - V(plan.offset[i]);
}

// Adds the forces on all nodes, and how they answer; `turns` [3] and `turned` per node: room for their rotations over the step.
template <class V, class N>
inline void contacts(const Plan<N>& plan, const ContactStep<V>& step, Poses<V> now, Push<V>* pushes, V* turns, bool* turned) {
  const V zero(0), range = V(plan.release[0]) * step.dt, width = V(plan.slip_speed[0]) * step.dt * step.relaxed.width;
  for (int k = 0; k < plan.nodes; k++) turned[k] = false;
  for (int i = 0; i < plan.candidates; i++) {
    V c[3], before[3];
    const V reach = V(plan.radius[i]) + V(plan.margin[i]), depth = reach - height(plan, i, now, c);
    const V holding = step.relaxed.holding(i);
    if (!any((depth > zero) | (holding > zero))) continue;
    const int k = plan.carrier[i];
    const V radius = V(plan.radius[i]), start = reach - height(plan, i, step.start, before);
    const V n[3] = {V(plan.normal[3 * i]), V(plan.normal[3 * i + 1]), V(plan.normal[3 * i + 2])};
    V roll[9], moved[3];
    const bool round = any(radius > zero);
    for (int j = 0; j < 3; j++) moved[j] = c[j] - before[j];
    if (round) {
      V* phi = turns + 3 * k;
      if (!turned[k]) rotation_between(now.rotation + 9 * k, step.start.rotation + 9 * k, phi), turned[k] = true;
      V beside[3];
      cross(phi, n, beside);
      for (int j = 0; j < 3; j++) moved[j] = fma(-radius, beside[j], moved[j]);
      log_jacobian(phi, V(-0.5), roll);
    }
    const V lifted = dot(moved, n);
    V u[3], p[3];
    for (int j = 0; j < 3; j++) u[j] = fma(-lifted, n[j], moved[j]), p[j] = fma(-radius, n[j], c[j]);
    V N_, rises, factor, falls;
    releasing(step.relaxed.firmness * V(plan.firmness[i]), depth, start, range, N_, rises);
    const V size = sqrt(dot(u, u)), mu = V(plan.grip[i]);
    slip_factor(size, width, factor, falls);
    V pressed = N_, firmer = rises;
    step.relaxed.felt(holding, pressed, firmer);
    const V drag = mu * pressed * factor, by_depth = mu * firmer * factor, by_size = mu * pressed * falls;
    V f[3];
    for (int j = 0; j < 3; j++) f[j] = fma(N_, n[j], -(drag * u[j]));

    // how the centre, the depth and the slip answer (ω, v): [−[c]× | 1], n · that, and (1 − nnᵀ) of it and of the rolling
    V sinks[6], slips[18];
    cross(c, n, sinks);
    for (int j = 0; j < 3; j++) sinks[3 + j] = n[j];
    V move[18];
    const V arm[9] = {zero, c[2], -c[1], -c[2], zero, c[0], c[1], -c[0], zero};
    for (int a = 0; a < 3; a++)
      for (int b = 0; b < 3; b++) {
        move[6 * a + b] = arm[3 * a + b];
        move[6 * a + 3 + b] = a == b ? V(1) : zero;
      }
    if (round)
      for (int b = 0; b < 3; b++) {
        const V column[3] = {roll[b], roll[3 + b], roll[6 + b]};
        V beside[3];
        cross(n, column, beside);
        for (int a = 0; a < 3; a++) move[6 * a + b] = fma(radius, beside[a], move[6 * a + b]);
      }
    V answer[18], grows[6];
    for (int b = 0; b < 6; b++) {
      const V along = fma(n[0], move[b], fma(n[1], move[6 + b], n[2] * move[12 + b]));
      for (int a = 0; a < 3; a++) slips[6 * a + b] = fma(-along, n[a], move[6 * a + b]);
      grows[b] = fma(u[0], slips[b], fma(u[1], slips[6 + b], u[2] * slips[12 + b]));
      const V resists = fma(by_size, grows[b], -(by_depth * sinks[b])), presses = rises * sinks[b];
      for (int a = 0; a < 3; a++) answer[6 * a + b] = fma(n[a], presses, fma(drag, slips[6 * a + b], u[a] * resists));
    }
    Push<V>& out = pushes[k];
    out.open();
    for (int a = 0; a < 3; a++) {
      out.force[a] -= f[a];
      for (int b = 0; b < 3; b++) out.moment[3 * a + b] = fma(-f[a], p[b], out.moment[3 * a + b]);
    }
    for (int b = 0; b < 6; b++) {
      const V column[3] = {answer[b], answer[6 + b], answer[12 + b]};
      V torque[3];
      cross(p, column, torque);
      for (int a = 0; a < 3; a++) out.stiffness[6 * a + b] += torque[a], out.stiffness[6 * (3 + a) + b] += column[a];
    }
    if (round) {  // the force does not act on one material point
      const V pulled = radius * dot(n, f);
      for (int a = 0; a < 3; a++) {
        out.stiffness[7 * a] += pulled;
        for (int b = 0; b < 3; b++) out.stiffness[6 * a + b] = fma(-radius * n[a], f[b], out.stiffness[6 * a + b]);
      }
    }
  }
}

}  // namespace pbfd
