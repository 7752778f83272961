// How a step begins: κ, the target poses T̂ with gravity folded in, and where the step may end, as integrators/*.py.
#pragma once
#include "balance.h"

namespace pbfd {

// Twists (ω, v at the world's origin) of all nodes that move with v [nv] about these axes.
template <class V, class N, int D> inline void twists(const Plan<N, D>& plan, const V* axes, const V* v, V* out) {
  constexpr int S = turns(D) + D;
  for (int k = 0; k < plan.nodes; k++) {
    for (int a = 0; a < S; a++) out[S * k + a] = plan.parent[k] < 0 ? V(0) : out[S * plan.parent[k] + a];
    for (int j = plan.v[k]; j < plan.v[k] + freedoms(plan.kind[k]); j++)
      for (int a = 0; a < S; a++) out[S * k + a] = fma(v[j], axes[S * j + a], out[S * k + a]);
  }
}

// V̇ = Σ ṡ_i v_i, ṡ_i = ad(V_carrier) s_i, of all nodes: how the twists V of a steady v [nv] change.
template <class V, class N, int D> inline void drifts(const Plan<N, D>& plan, const V* axes, const V* twist, const V* v, V* out) {
  constexpr int T = turns(D), S = T + D;
  for (int k = 0; k < plan.nodes; k++) {
    V carrier[S];
    for (int a = 0; a < S; a++) {
      carrier[a] = plan.parent[k] < 0 ? V(0) : twist[S * plan.parent[k] + a];
      out[S * k + a] = plan.parent[k] < 0 ? V(0) : out[S * plan.parent[k] + a];
    }
    const int first = plan.v[k], last = first + freedoms(plan.kind[k]), rotation = plan.kind[k] == FREE ? first + 3 : first;
    for (int j = first; j < rotation; j++) carrier[T + j - first] += v[j];  // its translation carries its rotation
    for (int j = rotation; j < last; j++) {
      const V* s = axes + S * j;
      V moved[D], back[D];
      swing<D>(carrier, s + T, moved), swing<D>(s, carrier + T, back);
      for (int a = 0; a < D; a++) out[S * k + T + a] = fma(v[j], moved[a] - back[a], out[S * k + T + a]);
      if constexpr (D == 3) {
        V turned[3];
        cross(carrier, s, turned);
        for (int a = 0; a < 3; a++) out[S * k + a] = fma(v[j], turned[a], out[S * k + a]);
      }
    }
  }
}

// How fast all poses change that move with v [nv]: Ṫ = [V] T, rotation and position. twist: room, [6] each.
template <class V, class N, int D>
inline void pose_rates(const Plan<N, D>& plan, Poses<V> at, const V* axes, const V* v, V* twist, V* out) {
  constexpr int T = turns(D), S = T + D;
  twists(plan, axes, v, twist);
  for (int k = 0; k < plan.nodes; k++, out += D * D + D) {
    const V *w = twist + S * k, *R = at.rotation + D * D * k;
    for (int j = 0; j < D; j++) {
      V column[D], moved[D];
      for (int i = 0; i < D; i++) column[i] = R[D * i + j];
      swing<D>(w, column, moved);
      for (int i = 0; i < D; i++) out[D * i + j] = moved[i];
    }
    swing<D>(w, at.position + D * k, out + D * D);
    for (int i = 0; i < D; i++) out[D * D + i] += w[T + i];
  }
}

// T̈ = ([V̇] + [V]²) T of node k, whose twists are V and change at V̇.
template <int D, class V>
inline void pose_acceleration(int k, Poses<V> at, const V* twist, const V* drift, V* out) {
  constexpr int T = turns(D), S = T + D;
  const V *w = twist + S * k, *change = drift + S * k, *R = at.rotation + D * D * k;
  for (int j = 0; j <= D; j++) {
    V x[D], speed[D], gain[D];
    for (int i = 0; i < D; i++) x[i] = j < D ? R[D * i + j] : at.position[D * k + i];
    swing<D>(w, x, speed), swing<D>(change, x, gain);
    for (int i = 0; j == D && i < D; i++) speed[i] += w[T + i], gain[i] += change[T + i];
    add_swing<D>(w, speed, gain);
    for (int i = 0; i < D; i++) out[j < D ? D * i + j : D * D + i] = gain[i];
  }
}

// T̂ = T_n + Δt V_n + a [0 | g]: poses moved along the velocity v, and fallen. room: [18] per node.
template <class V, class N, int D> inline void aim(Balance<V, N, D>& b, const V* v, V fall, V* room) {
  const Plan<N, D>& plan = b.plan;
  const V* rate = room + 6 * plan.nodes;
  pose_rates(plan, b.start, b.start_axes, v, room, room + 6 * plan.nodes);
  for (int k = 0; k < plan.nodes; k++, rate += D * D + D) {
    for (int i = 0; i < D * D; i++) b.target.rotation[D * D * k + i] = fma(b.dt, rate[i], b.start.rotation[D * D * k + i]);
    for (int i = 0; i < D; i++)
      b.target.position[D * k + i] = fma(fall, V(plan.gravity[i]), fma(b.dt, rate[D * D + i], b.start.position[D * k + i]));
  }
}

// Half the integral of ρ ẋ² over all bodies whose poses change at `rates`, rotation and position each.
template <class V, class N, int D> inline V kinetic_energy(const Plan<N, D>& plan, const V* rates) {
  V twice(0);
  for (int k = 0; k < plan.nodes; k++, rates += D * D + D) {
    V spread[D * D], speed[D];
    product<D>(rates, plan.second + D * D * k, spread);
    for (int i = 0; i < D * D; i++) twice = fma(spread[i], rates[i], twice);
    times<D>(rates, plan.center + D * k, speed);
    for (int i = 0; i < D; i++) speed[i] += rates[D * D + i];
    twice = fma(V(plan.mass[k]), dot<D>(speed, speed), twice);
  }
  return V(0.5) * twice;
}

// Kinetic energy of the bodies' fall over one step, at 1 m/s² at least.
template <class V, class N, int D> inline V falling_energy(const Plan<N, D>& plan, V dt) {
  V mass(0), g[D];
  for (int k = 0; k < plan.nodes; k++) mass += V(plan.mass[k]);
  for (int i = 0; i < D; i++) g[i] = V(plan.gravity[i]);
  const V strength = max(sqrt(dot<D>(g, g)), V(1));
  return V(0.5) * mass * (dt * strength) * (dt * strength);
}

constexpr double HARDEST = 3.0;

// Whether what a step gains, in rates of the poses, is no impact's: it has no more energy than a fall of `HARDEST` steps.
template <class V, class N, int D> inline typename Kind<V>::Mask calm(const Plan<N, D>& plan, const V* rates, V dt) {
  return kinetic_energy(plan, rates) <= V(HARDEST * HARDEST) * falling_energy(plan, dt);
}

// The energy–momentum step from q_n with v_n: κ = 1/Δt², T̂ = T_n + Δt V_n + ½ Δt² [0 | g]. room: 18 per node.
template <class V, class N, int D> inline void begin_energy_momentum(Balance<V, N, D>& b, const V* q, const V* v, V* room) {
  for (int i = 0; i < b.plan.nq; i++) b.q_start[i] = q[i];
  place(b.plan, q, b.start, b.start_axes);
  b.weight = V(1) / (b.dt * b.dt);
  aim(b, v, V(0.5) * b.dt * b.dt, room);
  retract(b.plan, q, v, b.dt, b.q_target);
}

}  // namespace pbfd
