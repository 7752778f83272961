// Implicit Euler on positions, as integrators/implicit_euler.py: κ = 1/Δt², T̂ = 2T_n − T_{n−1} + Δt² [0 | g]; and the variational
// scheme (integrators/variational.py), which is the same with inertia at another share w of the chord.
#pragma once
#include "state.h"
#include "strayed.h"

namespace pbfd {

// Attributes as of `Positions` in Python, [nq] and [nv], and its memory.
template <class V> struct Positions {
  V *q, *q_previous, *acceleration, *behind;
  template <class F> static void each(Sizes s, F&& visit) {
    visit(&Positions::q, s.nq), visit(&Positions::q_previous, s.nq), visit(&Positions::acceleration, s.nv);
    visit(&Positions::behind, s.remembered());
  }
};

template <class V, class N, int D> struct ImplicitEuler {
  using M = typename Kind<V>::Mask;
  using State = Positions<V>;
  static constexpr bool fits = false;
  static constexpr bool extrapolates = false, leaps = false;
  static constexpr double BLENDS[] = {0.25, 0.5, 0.75, 1.0};  // what is easier to solve

  const Plan<N, D>& plan;
  int easier = 0;
  double own_share = 1;  // w
  Poses<V> earlier;
  V *axes, *moved, *gained, *twist, *rates, *back;

  static int room(Sizes s) { return (D * D + D + 18) * s.nodes + (turns(D) + D + 2) * s.nv + s.nq; }
  ImplicitEuler(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene), earlier(Poses<V>::template in<D>(arena, scene)) {
    axes = arena.take((turns(D) + D) * plan.nv);
    moved = arena.take(plan.nv), gained = arena.take(plan.nv);
    twist = arena.take(6 * plan.nodes), rates = arena.take(12 * plan.nodes), back = arena.take(plan.nq);
  }

  void ask(const Rules& rules) {
    own_share = rules.share, easier = 0;
    for (double blend : BLENDS) easier += blend > own_share;
  }
  double share(int eased) const { return eased ? BLENDS[4 - easier + eased - 1] : own_share; }

  // Average over the step that ends at t_n (Eq. 3).
  void velocity(const State& x, V dt, V* out) const {
    difference(plan, x.q_previous, x.q, out);
    for (int i = 0; i < plan.nv; i++) out[i] = out[i] / dt;
  }

  // How fast poses have changed over that step, where the nodes are now.
  void speeds(const State& x, Poses<V> now, const V*, const V*, V dt, V* out) {
    place(plan, x.q_previous, earlier, axes);
    for (int k = 0; k < plan.nodes; k++, out += D * D + D) {
      for (int i = 0; i < D * D; i++) out[i] = (now.rotation[D * D * k + i] - earlier.rotation[D * D * k + i]) / dt;
      for (int i = 0; i < D; i++) out[D * D + i] = (now.position[D * k + i] - earlier.position[D * k + i]) / dt;
    }
  }

  // What is fixed in the step from a state, and where it may end.
  void begin(Balance<V, N, D>& b, const State& before, V* guess, M) {
    for (int i = 0; i < plan.nq; i++) b.q_start[i] = before.q[i];
    place(plan, before.q, b.start, b.start_axes), place(plan, before.q_previous, earlier, axes);
    b.weight = V(1) / (b.dt * b.dt);
    const V two(2), square = b.dt * b.dt;
    for (int i = 0; i < D * D * plan.nodes; i++) b.target.rotation[i] = fma(two, b.start.rotation[i], -earlier.rotation[i]);
    for (int i = 0; i < D * plan.nodes; i++)
      b.target.position[i] = fma(square, V(plan.gravity[i % D]), fma(two, b.start.position[i], -earlier.position[i]));
    difference(plan, before.q_previous, before.q, moved);
    retract(plan, before.q, moved, V(1), b.q_target);
    for (int i = 0; i < plan.nq; i++) guess[i] = b.q_target[i];
  }

  // The state of some lanes as steps of another length see it, at the same place with the same velocity.
  void resize(M which, V dt, V other_dt, State& x) {
    difference(plan, x.q, x.q_previous, moved);
    const V share = other_dt / dt, bent = V(0.5) * other_dt * (dt - other_dt);
    for (int i = 0; i < plan.nv; i++) moved[i] = fma(share, moved[i], -(bent * x.acceleration[i]));
    retract(plan, x.q, moved, V(1), back);
    for (int i = 0; i < plan.nq; i++) x.q_previous[i] = select(which, back[i], x.q_previous[i]);
  }

  // From the state before to that after a step that ended at q; no lane refuses it.
  M advance(Balance<V, N, D>& b, const V* q, const State& before, State& after, M) {
    difference(plan, before.q_previous, before.q, moved);
    difference(plan, before.q, q, gained);
    for (int i = 0; i < plan.nv; i++) gained[i] = (gained[i] - moved[i]) / b.dt;
    pose_rates(plan, b.start, b.start_axes, gained, twist, rates);
    const M smooth = calm(plan, rates, b.dt);
    for (int i = 0; i < plan.nv; i++) after.acceleration[i] = select(smooth, gained[i] / b.dt, V(0));
    for (int i = 0; i < plan.nq; i++) after.q_previous[i] = before.q[i];
    return M(false);
  }

  // Never: an easier step is good enough.
  V halves(const Balance<V, N, D>&, Sight<V, N, D>&, const State&, M) const { return V(0); }
};

}  // namespace pbfd
