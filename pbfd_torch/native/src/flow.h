// How bodies move at an instant, where nothing touches: M v̇ = f − h.
#pragma once
#include "forces.h"
#include "momenta.h"

namespace pbfd {

// How coordinates change: quaternions, of any norm, turn by ½ q ⊗ ω and keep it.
template <class V, class N, int D> inline void coordinate_rates(const Plan<N, D>& plan, const V* q, const V* v, V* out) {
  for (int k = 0; k < plan.nodes; k++) {
    const int kind = plan.kind[k], moves = straight(kind);
    const V *x = q + plan.q[k], *speed = v + plan.v[k];
    V* rate = out + plan.q[k];
    for (int i = 0; i < moves; i++) rate[i] = speed[i];
    if (kind == HINGE) rate[0] = speed[0];
    if (kind != BALL && kind != FREE) continue;
    const V spin[4] = {V(0), V(0.5) * speed[moves], V(0.5) * speed[moves + 1], V(0.5) * speed[moves + 2]};
    quaternion_product(x + moves, spin, rate + moves);
  }
}

// q with its quaternions at unit norm.
template <class V, class N, int D> inline void normalize(const Plan<N, D>& plan, const V* q, V* out) {
  for (int i = 0; i < plan.nq; i++) out[i] = q[i];
  for (int k = 0; k < plan.nodes; k++) {
    if (plan.kind[k] != BALL && plan.kind[k] != FREE) continue;
    V* x = out + plan.q[k] + straight(plan.kind[k]);
    const V per = V(1) / sqrt(fma(x[0], x[0], fma(x[1], x[1], fma(x[2], x[2], x[3] * x[3]))));
    for (int i = 0; i < 4; i++) x[i] *= per;
  }
}

// Springs, damping and actuators, as they are at q with v. r: minus their force, not added to.
template <class V, class N, int D> inline void smooth_loads(const Plan<N, D>& plan, const V* control, const V* q, const V* v, V* r) {
  for (int k = 0; k < plan.nodes; k++) {
    const int kind = plan.kind[k], i = plan.v[k], c = plan.q[k], size = freedoms(kind), turn = straight(kind);
    V gap[6];
    if (kind == HINGE || kind == SLIDE) {
      gap[0] = q[c] - V(plan.rest[c]);
    } else {
      V back[4], between[4];
      for (int j = 0; j < turn; j++) gap[j] = q[c + j] - V(plan.rest[c + j]);
      for (int j = 0; j < 4; j++) back[j] = j ? -V(plan.rest[c + turn + j]) : V(plan.rest[c + turn]);
      quaternion_product(back, q + c + turn, between), quaternion_log(between, gap + turn);
    }
    for (int j = i; j < i + size; j++) r[j] = fma(V(plan.spring[j]), gap[j - i], V(plan.damping[j]) * v[j]);
  }
  for (int a = 0; a < plan.nu; a++) {
    const V gear = V(plan.gear[a]), asked = clamped(control[a], V(plan.least_control[a]), V(plan.most_control[a]));
    const V x = gear * q[plan.actuated_q[a]], speed = gear * v[plan.actuated_v[a]], drive = fma(V(plan.gain[a]), asked, V(plan.bias[a]));
    const V force = drive - fma(V(plan.stiffness[a]), x, V(plan.resistance[a]) * speed);
    r[plan.actuated_v[a]] -= gear * clamped(force, V(plan.least_force[a]), V(plan.most_force[a]));
  }
}

template <class V, class N, int D = 3> struct Flow {
  static constexpr int T = turns(D), S = T + D;
  const Plan<N, D>& plan;
  Momenta<V, N, D>& momenta;
  V *drift, *smooth, *others;  // what springs, damping and actuators do at the last instant, and all else

  static int room(Sizes s) { return S * s.nodes + 2 * s.nv; }
  Flow(const Plan<N, D>& scene, Momenta<V, N, D>& shared, Arena<V>& arena) : plan(scene), momenta(shared) {
    drift = arena.take(S * plan.nodes), smooth = arena.take(plan.nv), others = arena.take(plan.nv);
  }

  // v̇ at q, where the nodes are placed, and M's factors in `momenta`.
  void accelerate(Poses<V> now, const V* axes, const V* q, const V* v, const V* control, V* out) {
    V* twist = momenta.twist;
    twists(plan, axes, v, twist), drifts(plan, axes, twist, v, drift);
    for (int k = 0; k < plan.nodes; k++) {
      V rate[D * D + D];
      pose_acceleration<D>(k, now, twist, drift, rate);
      for (int i = 0; i < D; i++) rate[D * D + i] -= V(plan.gravity[i]);
      momenta.take(k, now, rate);
    }
    if constexpr (D == 3) push(now);
    for (int i = 0; i < plan.nv; i++) others[i] = V(0);
    momenta.add_to(others, axes);
    momenta.masses(axes);
    smooth_loads(plan, control, q, v, smooth);
    for (int i = 0; i < plan.nv; i++) others[i] = -others[i], smooth[i] = -smooth[i], out[i] = others[i] + smooth[i];
    factor(tree(plan), momenta.matrix);
    substitute(tree(plan), momenta.matrix, out);
  }

 private:
  // Forces from outside lessen what moves their nodes.
  void push(Poses<V> now) {
    for (int i = 0; i < plan.pushes; i++) {
      const int k = plan.pushed[i];
      V p[3], f[3], torque[3];
      times(now.rotation + 9 * k, plan.push_point + 3 * i, p);
      for (int a = 0; a < 3; a++) p[a] += now.position[3 * k + a], f[a] = V(plan.push[3 * i + a]);
      lever<3>(p, f, torque);
      for (int a = 0; a < 3; a++) momenta.sums[k].force[a] -= f[a], momenta.sums[k].torque[a] -= torque[a];
    }
  }
};

}  // namespace pbfd
