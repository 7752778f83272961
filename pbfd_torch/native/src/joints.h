// Loads on degrees of freedom: springs, damping, rotors, dry friction, limits and actuators, as their terms in Python.
#pragma once
#include "friction.h"
#include "relaxed.h"
#include "release.h"
#include "tree.h"

namespace pbfd {

constexpr double TOO_FAR = 0.02;  // [rad or m] past a limit: a hazard

// What is fixed in a step.
template <class V> struct JointStep {
  const V* start;   // [nq] θ_n
  const V* target;  // [nq] where inertia pulls the rotors
  const V* control;  // [nu]
  const V* limits;   // [nv] how stiff they are
  const V* fitted;   // [nv] θ of springs, damping and actuators
  V dt, weight;      // [s], κ
  const Relaxed<V>& relaxed;
};

// How stiff the limits are in a step: at least so that they hold what its actuators press with where it begins.
template <class V, class N, int D> inline void stiffen_limits(const Plan<N, D>& plan, const JointStep<V>& step, V* out) {
  for (int i = 0; i < plan.nv; i++) out[i] = V(0);
  for (int a = 0; a < plan.nu; a++) {
    const V gear = V(plan.gear[a]), asked = clamped(step.control[a], V(plan.least_control[a]), V(plan.most_control[a]));
    const V drive = fma(V(plan.gain[a]), asked, V(plan.bias[a])) - V(plan.stiffness[a]) * gear * step.start[plan.actuated_q[a]];
    out[plan.actuated_v[a]] += gear * clamped(drive, V(plan.least_force[a]), V(plan.most_force[a]));
  }
  for (int i = 0; i < plan.nv; i++) out[i] = max(V(plan.limit[i]), V(plan.limit_per_force[0]) * abs(out[i]));
}

// How far each hinge and slide is past its limits, < 0 within them: visit(dof, past).
template <class V, class N, int D, class F> inline void each_limit(const Plan<N, D>& plan, const V* q, F&& visit) {
  for (int k = 0; k < plan.nodes; k++) {
    if (plan.kind[k] != HINGE && plan.kind[k] != SLIDE) continue;
    const int i = plan.v[k];
    const V x = q[plan.q[k]];
    visit(i, max(V(plan.lower[i]) - x, x - V(plan.upper[i])));
  }
}

// Springs, damping, actuators; dry friction; limits; both; armatures.
enum Loads { SMOOTH = 1, DRY = 2, LIMITS = 4, ROUGH = 6, ROTORS = 8, ALL = 15 };

// Balls and free joints, whose coordinates do not add up: ½ c ‖log(q̂⁻¹ q)‖² of springs, damping and rotors. Adds its gradient and
// its Hessian, each where it is wanted (not null).
template <int LOADS = ALL, class V, class N, int D>
inline void turning_loads(const Plan<N, D>& plan, int k, const JointStep<V>& step, const V* q, V* residual, V* matrix) {
  const int n = plan.nv, i = plan.v[k], c = plan.q[k], turn = straight(plan.kind[k]), size = freedoms(plan.kind[k]);
  const V zero(0), per_dt = V(1) / step.dt;
  const V* aims[3] = {nullptr, step.start, step.target};
  V rest[7];
  for (int j = 0; j < coordinates(plan.kind[k]); j++) rest[j] = V(plan.rest[c + j]);
  for (int what = LOADS & SMOOTH ? 0 : 2; what < (LOADS & ROTORS ? 3 : 2); what++) {
    const N* number = (what == 0 ? plan.spring : what == 1 ? plan.damping : plan.armature) + i;
    const V* aim = what == 0 ? rest : aims[what] + c;
    bool there = false;
    for (int j = 0; j < size; j++) there |= any(number[j] > N(0));
    if (!there) continue;
    const V back[4] = {aim[turn], -aim[turn + 1], -aim[turn + 2], -aim[turn + 3]};
    V gap[6], between[4], bent[9];
    V share[6];
    for (int j = 0; j < size; j++) share[j] = what == 2 ? V(1) : step.fitted[i + j];
    for (int j = 0; j < turn; j++) {
      const V start = what == 0 ? step.start[c + j] : aim[j];  // springs are taken on the way
      gap[j] = fma(what == 0 ? share[j] : V(1), q[c + j] - start, start - aim[j]);
    }
    quaternion_product(back, q + c + turn, between);
    quaternion_log(between, gap + turn);
    if (matrix) log_jacobian(gap + turn, zero, bent);
    for (int j = 0; j < size; j++) {
      const V own = share[j] * V(number[j]) * (what == 0 ? V(1) : what == 1 ? per_dt : step.weight);
      if (residual) residual[i + j] = fma(own, gap[j], residual[i + j]);
      if (!matrix) continue;
      V* row = matrix + n * (i + j) + i;
      if (j < turn) row[j] += what == 0 ? share[j] * own : own;
      for (int b = 0; j >= turn && b < 3; b++) row[turn + b] = fma(own, bent[3 * (j - turn) + b], row[turn + b]);
    }
  }
}

// Adds r [nv] of these loads, and their slopes [nv] where each freedom has its own.
template <int LOADS = ALL, class V, class N, int D>
inline void joint_loads(const Plan<N, D>& plan, const JointStep<V>& step, const V* q, V* residual, V* slopes) {
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
      if ((LOADS & DRY) && any(plan.dry[i] > N(0))) {
        V factor, falls;
        const V size = abs(moved);
        slip_law(size, V(1) / (V(plan.dry_speed[0]) * step.dt * step.relaxed.width), factor, falls);
        r = fma(V(plan.dry[i]) * factor, moved, r);
        slope = fma(V(plan.dry[i]), fma(falls * size, size, factor), slope);
      }
      const V under = V(plan.lower[i]) - x, over = x - V(plan.upper[i]);
      if ((LOADS & LIMITS) && any((under > zero) | (over > zero))) {
        V push, rises;
        const V release(plan.limit_release[0]), stiffness = step.relaxed.firmness * step.limits[i];
        const V below = max(V(plan.lower[i]) - step.start[c], zero), above = max(step.start[c] - V(plan.upper[i]), zero);
        release_law(stiffness, under, below, per_return(release, below, step.dt), push, rises);
        r -= push, slope += rises;
        release_law(stiffness, over, above, per_return(release, above, step.dt), push, rises);
        r += push, slope += rises;
      }
      residual[i] += r, slopes[i] += slope;
      continue;
    }
    if (LOADS & (SMOOTH | ROTORS)) turning_loads<LOADS>(plan, k, step, q, residual, static_cast<V*>(nullptr));
  }
  for (int a = 0; LOADS & SMOOTH && a < plan.nu; a++) {
    const int c = plan.actuated_q[a], i = plan.actuated_v[a];
    const V share = step.fitted[i], gear = V(plan.gear[a]), before = gear * step.start[c], moved = fma(gear, q[c], -before);
    const V asked = clamped(step.control[a], V(plan.least_control[a]), V(plan.most_control[a]));
    const V drive = fma(V(plan.gain[a]), asked, V(plan.bias[a])), stiffness = V(plan.stiffness[a]);
    const V falls = fma(share, stiffness, V(plan.resistance[a]) * per_dt);
    const V free = drive - stiffness * before - falls * moved, low = V(plan.least_force[a]), high = V(plan.most_force[a]);
    residual[i] -= share * gear * clamped(free, low, high);
    slopes[i] += select((free > low) & (free < high), share * falls * gear * gear, zero);
  }
}

}  // namespace pbfd
