// BDF2 on positions, with a step of implicit Euler where a contact force jumps, as integrators/bdf2.py: κ = 9/(4Δt²),
// T̂ = T_n + (15 ΔT_n − 7 ΔT_{n−1} + ΔT_{n−2})/9 + 4Δt²/9 [0 | g] of the last three displacements.
#pragma once
#include "state.h"
#include "strayed.h"

namespace pbfd {

// Attributes as of `FourPoses` in Python, of the nodes: T_{n−1}, T_{n−2}, T_{n−3}, each rotation [9] and position [3] of all nodes;
// the last three moves [nv], the latest first; how hard contacts and limits pushed, in weights; and its memory.
template <class V> struct FourPoses {
  V *q, *history, *moves, *push, *behind;
  template <class F> static void each(Sizes s, F&& visit) {
    visit(&FourPoses::q, s.nq), visit(&FourPoses::history, 36 * s.nodes), visit(&FourPoses::moves, 3 * s.nv);
    visit(&FourPoses::push, 1), visit(&FourPoses::behind, s.remembered());
  }
};

template <class V, class N, int D> struct Bdf2 {
  static_assert(D == 3, "its history is that of poses in space");
  using M = typename Kind<V>::Mask;
  using State = FourPoses<V>;
  static constexpr int easier = 1;  // implicit Euler, which forgets what was before it
  static constexpr bool fits = false;
  static constexpr bool extrapolates = false, leaps = false;
  static double share(int) { return 1.0; }

  const Plan<N, D>& plan;
  V jump;  // [weights]
  V *moved, *turned, *slopes;
  Poses<V> there;
  V* axes;

  static int room(Sizes s) { return 12 * s.nodes + 9 * s.nv; }
  Bdf2(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene), jump(0), there(Poses<V>::template in<D>(arena, scene)) {
    axes = arena.take(6 * plan.nv), moved = arena.take(plan.nv), turned = arena.take(plan.nv), slopes = arena.take(plan.nv);
  }

  void ask(const Rules& rules) { jump = V(typename Kind<V>::Scalar(rules.jump)); }

  // That of BDF2 at t_n.
  void velocity(const State& x, V dt, V* out) const {
    for (int i = 0; i < plan.nv; i++) out[i] = rate(x.moves[i], x.moves[plan.nv + i]) / dt;
  }

  // How fast poses change at t_n, where the nodes are.
  void speeds(const State& x, Poses<V> now, const V*, const V*, V dt, V* out) const {
    each_entry([&](int k, int i) {
      const V last = entry(now, k, i) - x.history[at(0, k, i)], before = x.history[at(0, k, i)] - x.history[at(1, k, i)];
      out[12 * k + i] = rate(last, before) / dt;
    });
  }

  // What is fixed in the step from a state, and where it may end; of implicit Euler where it is `eased`.
  void begin(Balance<V, N, D>& b, const State& x, V* guess, M eased) {
    const V square = b.dt * b.dt, per = V(9) / V(4), one(1);
    for (int i = 0; i < plan.nq; i++) b.q_start[i] = x.q[i];
    place(plan, x.q, b.start, b.start_axes);
    b.weight = select(eased, one, per) / square;
    const V fall = square * select(eased, one, one / per);
    each_entry([&](int k, int i) {
      const V now = entry(b.start, k, i), last = now - x.history[at(0, k, i)];
      const V before = x.history[at(0, k, i)] - x.history[at(1, k, i)], oldest = x.history[at(1, k, i)] - x.history[at(2, k, i)];
      V target = now + select(eased, last, ahead(last, before, oldest));
      if (i >= 9) target = fma(fall, V(plan.gravity[i - 9]), target);
      entry(b.target, k, i) = target;
    });
    const V* m = x.moves;
    for (int i = 0; i < plan.nv; i++) moved[i] = select(eased, m[i], ahead(m[i], m[plan.nv + i], m[2 * plan.nv + i]));
    retract(plan, x.q, moved, one, b.q_target);
    for (int i = 0; i < plan.nq; i++) guess[i] = b.q_target[i];
  }

  // The state of some lanes as steps of another length see it: with a past of constant acceleration, that of the last two steps.
  void resize(M which, V dt, V other, State& x) {
    place(plan, x.q, there, axes);
    each_entry([&](int k, int i) {
      const V now = entry(there, k, i), last = now - x.history[at(0, k, i)];
      const V before = x.history[at(0, k, i)] - x.history[at(1, k, i)];
      remember(plan, which, k, i, now, rate(last, before) / dt, (last - before) / (dt * dt), other, x);
    });
    for (int i = 0; i < plan.nv; i++) {
      const V last = x.moves[i], before = x.moves[plan.nv + i];
      remember(plan, which, i, rate(last, before) / dt, (last - before) / (dt * dt), other, x);
    }
  }

  // From the state before to that after a step that ended at q, where `b` has been evaluated; which lanes refuse it. An easier step
  // leaves a past of constant velocity.
  M advance(Balance<V, N, D>& b, const V* q, const State& before, State& after, M eased) {
    const int n = plan.nv;
    each_entry([&](int k, int i) {
      const V now = entry(b.now, k, i), start = entry(b.start, k, i), gone = now - start;
      after.history[at(0, k, i)] = start;
      for (int back = 1; back < 3; back++)
        after.history[at(back, k, i)] = select(eased, now - V(back + 1) * gone, before.history[at(back - 1, k, i)]);
    });
    difference(plan, b.q_start, q, after.moves);
    for (int back = 1; back < 3; back++)
      for (int i = 0; i < n; i++)
        after.moves[back * n + i] = select(eased, after.moves[i], before.moves[(back - 1) * n + i]);
    after.push[0] = push(b, q);
    return (!eased) & (abs(after.push[0] - before.push[0]) > jump);
  }

  // A past of constant acceleration, of one entry of a pose and of one degree of freedom.
  static void remember(const Sizes& s, M which, int k, int i, V now, V speed, V acceleration, V dt, State& x) {
    for (int back = 0; back < 3; back++) {
      const V h = V(back + 1) * dt;
      V& past = x.history[(back * s.nodes + k) * 12 + i];
      past = select(which, now + (V(0.5) * h * h * acceleration - h * speed), past);
    }
  }
  static void remember(const Sizes& s, M which, int i, V speed, V acceleration, V dt, State& x) {
    for (int back = 0; back < 3; back++) {
      V& move = x.moves[back * s.nv + i];
      move = select(which, dt * (speed - V(back + 0.5) * dt * acceleration), move);
    }
  }

  // Never: an easier step is good enough.
  V halves(const Balance<V, N, D>&, Sight<V, N, D>&, const State&, M) const { return V(0); }

  template <class F> void each_entry(F&& visit) const {
    for (int k = 0; k < plan.nodes; k++)
      for (int i = 0; i < 12; i++) visit(k, i);
  }
  static V& entry(const Poses<V>& poses, int k, int i) { return i < 9 ? poses.rotation[9 * k + i] : poses.position[3 * k + i - 9]; }

 private:
  int at(int back, int k, int i) const { return (back * plan.nodes + k) * 12 + i; }
  static V rate(V last, V before) { return V(1.5) * last - V(0.5) * before; }
  static V ahead(V last, V before, V oldest) { return (V(15) * last - V(7) * before + oldest) / V(9); }

  // How hard contacts and limits push in all at the end of a step, in weights (`BalanceObjective.push`).
  V push(const Balance<V, N, D>& b, const V* q) {
    V total(0);
    b.each_normal_force(b.now, [&](int, V force, V) { total += force; });
    forces_of<LIMITS>(b, q, turned, slopes);
    const V reach = V(plan.reach[0]), weight = V(plan.scale[0]) / select(V(plan.turns[0]) > V(0), reach, V(1));
    for (int i = 0; i < plan.nv; i++) total += abs(turned[i]) / select(V(plan.turns[i]) > V(0), reach, V(1));
    return total / weight;
  }
};

}  // namespace pbfd
