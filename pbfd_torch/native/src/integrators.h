// How a step begins: κ, the target poses T̂ with gravity folded in, and where the step may end, as integrators/*.py.
#pragma once
#include "balance.h"

namespace pbfd {

// Twists (ω, v at the world's origin) of all nodes, [6] each, that move with v [nv] about these axes.
template <class V, class N> inline void twists(const Plan<N>& plan, const V* axes, const V* v, V* out) {
  for (int k = 0; k < plan.nodes; k++) {
    for (int a = 0; a < 6; a++) out[6 * k + a] = plan.parent[k] < 0 ? V(0) : out[6 * plan.parent[k] + a];
    for (int j = plan.v[k]; j < plan.v[k] + freedoms(plan.kind[k]); j++)
      for (int a = 0; a < 6; a++) out[6 * k + a] = fma(v[j], axes[6 * j + a], out[6 * k + a]);
  }
}

// How fast all poses change that move with v [nv]: Ṫ = [V] T, rotation [9] and position [3] each. twist: room, [6] each.
template <class V, class N> inline void pose_rates(const Plan<N>& plan, Poses<V> at, const V* axes, const V* v, V* twist, V* out) {
  twists(plan, axes, v, twist);
  for (int k = 0; k < plan.nodes; k++, out += 12) {
    const V *w = twist + 6 * k, *R = at.rotation + 9 * k;
    for (int j = 0; j < 3; j++) {
      const V column[3] = {R[j], R[3 + j], R[6 + j]};
      V moved[3];
      cross(w, column, moved);
      for (int i = 0; i < 3; i++) out[3 * i + j] = moved[i];
    }
    cross(w, at.position + 3 * k, out + 9);
    for (int i = 0; i < 3; i++) out[9 + i] += w[3 + i];
  }
}

// T̂ = T_n + Δt V_n + a [0 | g]: poses moved along the velocity v, and fallen. room: [18] per node.
template <class V, class N> inline void aim(Balance<V, N>& b, const V* v, V fall, V* room) {
  const Plan<N>& plan = b.plan;
  const V* rate = room + 6 * plan.nodes;
  pose_rates(plan, b.start, b.axes, v, room, room + 6 * plan.nodes);
  for (int k = 0; k < plan.nodes; k++, rate += 12) {
    for (int i = 0; i < 9; i++) b.target.rotation[9 * k + i] = fma(b.dt, rate[i], b.start.rotation[9 * k + i]);
    for (int i = 0; i < 3; i++)
      b.target.position[3 * k + i] = fma(fall, V(plan.gravity[i]), fma(b.dt, rate[9 + i], b.start.position[3 * k + i]));
  }
}

// Half the integral of ρ ẋ² over all bodies whose poses change at `rates`, [12] each.
template <class V, class N> inline V kinetic_energy(const Plan<N>& plan, const V* rates) {
  V twice(0);
  for (int k = 0; k < plan.nodes; k++, rates += 12) {
    V spread[9], speed[3];
    product(rates, plan.second + 9 * k, spread);
    for (int i = 0; i < 9; i++) twice = fma(spread[i], rates[i], twice);
    times(rates, plan.center + 3 * k, speed);
    for (int i = 0; i < 3; i++) speed[i] += rates[9 + i];
    twice = fma(V(plan.mass[k]), dot(speed, speed), twice);
  }
  return V(0.5) * twice;
}

// Kinetic energy of the bodies' fall over one step, at 1 m/s² at least.
template <class V, class N> inline V falling_energy(const Plan<N>& plan, V dt) {
  V mass(0);
  for (int k = 0; k < plan.nodes; k++) mass += V(plan.mass[k]);
  const V g[3] = {V(plan.gravity[0]), V(plan.gravity[1]), V(plan.gravity[2])}, strength = max(sqrt(dot(g, g)), V(1));
  return V(0.5) * mass * (dt * strength) * (dt * strength);
}

// The energy–momentum step from q_n with v_n: κ = 1/Δt², T̂ = T_n + Δt V_n + ½ Δt² [0 | g]; inertia works on the chord.
// room: 18 per node.
template <class V, class N> inline void begin_energy_momentum(Balance<V, N>& b, const V* q, const V* v, V* room) {
  for (int i = 0; i < b.plan.nq; i++) b.q_start[i] = q[i];
  place(b.plan, q, b.start);
  motion_axes(b.plan, b.start, b.axes);
  b.weight = V(1) / (b.dt * b.dt), b.on_chord = true;
  aim(b, v, V(0.5) * b.dt * b.dt, room);
  retract(b.plan, q, v, b.dt, b.q_target);
}

}  // namespace pbfd
