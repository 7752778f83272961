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

// T̂ = T_n + Δt V_n + a [0 | g]: poses moved along the velocity v, and fallen.
template <class V, class N> inline void aim(Balance<V, N>& b, const V* v, V fall, V* room) {
  const Plan<N>& plan = b.plan;
  twists(plan, b.axes, v, room);
  for (int k = 0; k < plan.nodes; k++) {
    const V *w = room + 6 * k, *R = b.start.rotation + 9 * k, *p = b.start.position + 3 * k;
    for (int j = 0; j < 3; j++) {
      const V column[3] = {R[j], R[3 + j], R[6 + j]};
      V moved[3];
      cross(w, column, moved);
      for (int i = 0; i < 3; i++) b.target.rotation[9 * k + 3 * i + j] = fma(b.dt, moved[i], column[i]);
    }
    V moved[3];
    cross(w, p, moved);
    for (int i = 0; i < 3; i++)
      b.target.position[3 * k + i] = fma(fall, V(plan.gravity[i]), fma(b.dt, moved[i] + w[3 + i], p[i]));
  }
}

// The energy–momentum step from q_n with v_n: κ = 1/Δt², T̂ = T_n + Δt V_n + ½ Δt² [0 | g], inertia in the middle of the chord.
// room: 6 per node.
template <class V, class N> inline void begin_energy_momentum(Balance<V, N>& b, const V* q, const V* v, V* room) {
  for (int i = 0; i < b.plan.nq; i++) b.q_start[i] = q[i];
  place(b.plan, q, b.start);
  motion_axes(b.plan, b.start, b.axes);
  b.weight = V(1) / (b.dt * b.dt), b.share = V(0.5), b.on_chord = true;
  aim(b, v, V(0.5) * b.dt * b.dt, room);
  retract(b.plan, q, v, b.dt, b.q_target);
}

// Implicit Euler's from q_n, before it q_{n−1}: κ = 1/Δt², T̂ = 2 T_n − T_{n−1} + Δt² [0 | g], inertia at the end. room: nv.
template <class V, class N> inline void begin_implicit_euler(Balance<V, N>& b, const V* q, const V* before, V* room) {
  const Plan<N>& plan = b.plan;
  for (int i = 0; i < plan.nq; i++) b.q_start[i] = q[i];
  place(plan, q, b.start);
  place(plan, before, b.target);
  b.weight = V(1) / (b.dt * b.dt), b.share = V(1), b.on_chord = false;
  for (int i = 0; i < 9 * plan.nodes; i++)
    b.target.rotation[i] = fma(V(2), b.start.rotation[i], -b.target.rotation[i]);
  for (int k = 0; k < plan.nodes; k++)
    for (int i = 0; i < 3; i++) {
      V& x = b.target.position[3 * k + i];
      x = fma(b.dt * b.dt, V(plan.gravity[i]), fma(V(2), b.start.position[3 * k + i], -x));
    }
  difference(plan, before, q, room);
  retract(plan, q, room, V(1), b.q_target);
}

}  // namespace pbfd
