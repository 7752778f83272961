// Loads on degrees of freedom: springs, damping, rotors, dry friction, limits and actuators, as their terms in Python.
#pragma once
#include "friction.h"
#include "relaxed.h"
#include "release.h"
#include "tree.h"

namespace pbfd {

// What is fixed in a step.
template <class V> struct JointStep {
  const V* start;   // [nq] θ_n
  const V* target;  // [nq] where inertia pulls the rotors
  const V* control;  // [nu]
  const V* fitted;   // [nv] θ of springs, damping and actuators
  V dt, weight;      // [s], κ
  const Relaxed<V>& relaxed;
};

// Springs, damping, actuators; dry friction; limits; both; armatures.
enum Loads { SMOOTH = 1, DRY = 2, LIMITS = 4, ROUGH = 6, ROTORS = 8, ALL = 15 };

// Adds r [nv] and its slopes [nv × nv] of these loads, each where it is wanted (not null).
template <int LOADS = ALL, class V, class N>
inline void joint_loads(const Plan<N>& plan, const JointStep<V>& step, const V* q, V* residual, V* matrix) {
  const int n = plan.nv;
  const V zero(0), per_dt = V(1) / step.dt;
  for (int k = 0; k < plan.nodes; k++) {
    const int kind = plan.kind[k], i = plan.v[k], c = plan.q[k];
    if (kind == HINGE || kind == SLIDE) {
      const V x = q[c], moved = x - step.start[c];
      V r(0), slope(0);
      if (LOADS & SMOOTH) {
        const V share = step.fitted[i], taken = fma(share, moved, step.start[c]);
        const V spring = share * V(plan.spring[i]), damping = share * V(plan.damping[i]) * per_dt;
        r = fma(spring, taken - V(plan.rest[c]), damping * moved), slope = fma(spring, share, damping);
      }
      if (LOADS & ROTORS) {
        const V rotor = V(plan.armature[i]) * step.weight;
        r = fma(rotor, x - step.target[c], r), slope += rotor;
      }
      if (LOADS & DRY) {
        V factor, falls;
        const V size = abs(moved);
        slip_factor(size, V(plan.dry_speed[0]) * step.dt * step.relaxed.width, factor, falls);
        r = fma(V(plan.dry[i]) * factor, moved, r);
        slope = fma(V(plan.dry[i]), fma(falls * size, size, factor), slope);
      }
      if (LOADS & LIMITS) {
        V push, rises;
        const V range = V(plan.limit_release[0]) * step.dt, stiffness = step.relaxed.firmness * V(plan.limit[i]);
        const V low = V(plan.lower[i]), high = V(plan.upper[i]);
        releasing(stiffness, low - x, max(low - step.start[c], zero), range, push, rises);
        r -= push, slope += rises;
        releasing(stiffness, x - high, max(step.start[c] - high, zero), range, push, rises);
        r += push, slope += rises;
      }
      if (residual) residual[i] += r;
      if (matrix) matrix[i * n + i] += slope;
      continue;
    }
    // coordinates that do not add up: ½ c ‖log(q̂⁻¹ q)‖² and its Hessian
    if (!(LOADS & (SMOOTH | ROTORS))) continue;
    const int turn = kind == FREE ? 3 : 0;
    V gap[3 * 6];
    const V* aims[3] = {nullptr, step.start, step.target};
    V rest[7];
    for (int j = 0; j < coordinates(kind); j++) rest[j] = V(plan.rest[c + j]);
    for (int what = LOADS & SMOOTH ? 0 : 2; what < (LOADS & ROTORS ? 3 : 2); what++) {
      const V* aim = what == 0 ? rest : aims[what] + c;
      V* d = gap + 6 * what;
      for (int j = 0; j < turn; j++) d[j] = q[c + j] - aim[j];
      const V back[4] = {aim[turn], -aim[turn + 1], -aim[turn + 2], -aim[turn + 3]};
      V between[4];
      quaternion_product(back, q + c + turn, between);
      quaternion_log(between, d + turn);
      for (int j = 0; j < turn + 3; j++) {
        const int dof = i + j;
        const V rotor = V(plan.armature[dof]) * step.weight, damping = V(plan.damping[dof]) * per_dt;
        const V own = what == 0 ? V(plan.spring[dof]) : what == 1 ? damping : rotor;
        if (residual) residual[dof] = fma(own, d[j], residual[dof]);
        if (matrix && j < turn) matrix[dof * n + dof] += own;
        if (matrix && j == turn) {
          V bent[9];
          log_jacobian(d + turn, zero, bent);
          for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) {
              V& entry = matrix[(dof + a) * n + dof + b];
              entry = fma(own, bent[3 * a + b], entry);
            }
        }
      }
    }
  }
  for (int a = 0; LOADS & SMOOTH && a < plan.nu; a++) {
    const int c = plan.actuated_q[a], i = plan.actuated_v[a];
    const V share = step.fitted[i], gear = V(plan.gear[a]), before = gear * step.start[c], moved = fma(gear, q[c], -before);
    const V asked = clamped(step.control[a], V(plan.least_control[a]), V(plan.most_control[a]));
    const V drive = fma(V(plan.gain[a]), asked, V(plan.bias[a])), stiffness = V(plan.stiffness[a]);
    const V falls = fma(share, stiffness, V(plan.resistance[a]) * per_dt);
    const V free = drive - stiffness * before - falls * moved, low = V(plan.least_force[a]), high = V(plan.most_force[a]);
    if (residual) residual[i] -= share * gear * clamped(free, low, high);
    if (matrix) matrix[i * n + i] += select((free > low) & (free < high), share * falls * gear * gear, zero);
  }
}

}  // namespace pbfd
