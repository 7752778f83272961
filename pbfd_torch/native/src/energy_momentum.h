// The state after an energy–momentum step, and what it has gained beyond the forces' work, as integrators/energy_momentum.py.
#pragma once
#include "state.h"
#include "strayed.h"

namespace pbfd {

constexpr double FLATTEST = 0.3, FARTHEST = 2.0, EXCESS = 1e-2, NOISE = 1e-4, RESERVE = 1e-2;
constexpr double PATIENCE = 3, FAST = 1.9106729782512120;  // halvings; 2 cos(.3 rad), of the trace of a rotation by so much

// Attributes as of `Velocities` in Python, [nq], [nv] each, three energies, and its memory.
template <class V> struct Velocities {
  V *q, *v, *push, *steady, *lag, *average, *gained, *surplus, *peak, *behind;
  template <class F> static void each(Sizes s, F&& visit) {
    using X = Velocities;
    visit(&X::q, s.nq), visit(&X::v, s.nv), visit(&X::push, s.nv), visit(&X::steady, s.nv), visit(&X::lag, s.nv);
    visit(&X::average, s.nv), visit(&X::gained, 1), visit(&X::surplus, 1), visit(&X::peak, 1);
    visit(&X::behind, 3 * s.anchors);
  }
};

template <class V, class N, int D = 3> struct EnergyMomentum {
  static constexpr int T = turns(D), S = T + D;
  using M = typename Kind<V>::Mask;
  using State = Velocities<V>;
  static constexpr int easier = 1;  // inertia at the end of the step, as the paper has it
  static double share(int eased) { return eased ? 1.0 : 0.5; }

  const Plan<N, D>& plan;
  V surplus_allowed;  // of the largest kinetic energy so far
  V *twist, *rates, *momentum, *impulse, *smooth, *rough, *other, *matrix, *total, *room_to_begin;
  Pull<V, D>* sums;

  static int room(Sizes s) {
    return s.nodes * (6 + 12 + 18 + int(sizeof(Pull<V, D>) / sizeof(V))) + 6 * s.nv + s.nv * s.nv;
  }
  EnergyMomentum(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene), surplus_allowed(1e-3) {
    twist = arena.take(6 * plan.nodes), rates = arena.take(12 * plan.nodes);
    momentum = arena.take(plan.nv), impulse = arena.take(plan.nv), smooth = arena.take(plan.nv), rough = arena.take(plan.nv);
    other = arena.take(plan.nv), total = arena.take(plan.nv), matrix = arena.take(plan.nv * plan.nv);
    room_to_begin = arena.take(18 * plan.nodes);
    sums = reinterpret_cast<Pull<V, D>*>(arena.take(plan.nodes * int(sizeof(Pull<V, D>) / sizeof(V))));
  }

  void ask(const Rules& rules) { surplus_allowed = V(typename Kind<V>::Scalar(rules.surplus)); }

  // At t_n.
  void velocity(const State& x, V, V* out) const {
    for (int i = 0; i < plan.nv; i++) out[i] = fma(V(0.5), x.steady[i] + x.lag[i], x.v[i]);
  }

  // How fast poses change at t_n, where the nodes are and the velocity is known.
  void speeds(const State&, Poses<V> now, const V* axes, const V* velocity, V, V* out) {
    pose_rates(plan, now, axes, velocity, twist, out);
  }

  // What is fixed in the step from a state, and where it may end.
  void begin(Balance<V, N, D>& b, const State& before, V* guess) {
    begin_energy_momentum(b, before.q, before.v, room_to_begin);
    retract(plan, before.q, before.average, b.dt, guess);
  }

  // The state of some lanes as steps of another length see it, at the same place with the same velocity.
  void resize(M which, V dt, V other_dt, State& x) const {
    const V share = other_dt / dt;
    for (int i = 0; i < plan.nv; i++) {
      const V steady = share * x.steady[i], lag_ = share * x.lag[i];
      x.v[i] = select(which, x.v[i] + V(0.5) * (x.steady[i] - steady + x.lag[i] - lag_), x.v[i]);
      x.steady[i] = select(which, steady, x.steady[i]), x.lag[i] = select(which, lag_, x.lag[i]);
      x.push[i] = select(which, share * x.push[i], x.push[i]);
    }
  }

  // How often a step had better be halved before it is made easier, if that which ended like this is unsolved or refused.
  V halves(const Balance<V, N, D>& b, Sight<V, N, D>& sight, const State& after, M solved) const {
    M held = sight.pushes(b, b.q_start), fast(false);
    held = held | sight.pushes(b, b.q_target);
    held = held | sight.pushes(b, after.q);  // the last look, which `fast` goes by
    for (int k = 0; k < plan.nodes; k++) {
      V traced(0);
      for (int j = 0; j < D * D; j++)
        traced = fma(sight.there.rotation[D * D * k + j], b.start.rotation[D * D * k + j], traced);
      fast = fast | ((traced < V(FAST + (D - 2))) & (V(plan.mass[k]) > V(0)));
    }
    const M overdrawn = (after.surplus[0] > surplus_allowed * after.peak[0]) & (after.gained[0] > V(NOISE) * after.peak[0]);
    return select(solved & overdrawn & fast, V(PATIENCE), select(held, V(0), V(1)));
  }

  // From the state before to that after a step that ended at q, where `b` has been evaluated; which lanes refuse it. Where inertia
  // works at the end of the step, the state after it has the step's average velocity, and what the forces that are not early give.
  M advance(Balance<V, N, D>& b, const V* q, const State& before, State& after) {
    const int n = plan.nv;
    const V h = b.dt, per = V(1) / h, zero(0), half(0.5);
    const M on_chord = b.share < V(1);
    split_forces(b, q);
    difference(plan, b.q_start, q, after.average);
    for (int i = 0; i < n; i++) after.average[i] = per * after.average[i];

    // what V_n and V_{n+1} = 2 ΔT/Δt − V_n are on the joints' motions; at the end of the step, ΔT/Δt and half its fall
    const V factor = select(on_chord, V(2), V(1)), less = select(on_chord, V(-1), zero), fall = select(on_chord, zero, half * h);
    pose_rates(plan, b.start, b.start_axes, before.v, twist, rates);
    for (int k = 0; k < plan.nodes; k++) {
      const V* rate = rates + (D * D + D) * k;
      V next[D * D + D];
      for (int i = 0; i < D * D; i++)
        next[i] = fma(factor * per, b.now.rotation[D * D * k + i] - b.start.rotation[D * D * k + i], less * rate[i]);
      for (int i = 0; i < D; i++) {
        const V kept = fma(less, rate[D * D + i], fall * V(plan.gravity[i]));
        next[D * D + i] = fma(factor * per, b.now.position[D * k + i] - b.start.position[D * k + i], kept);
      }
      pushed(k, b.now, next, sums[k]);
    }
    sum_up();
    for (int i = 0; i < n; i++) {
      impulse[i] = h * rough[i];
      momentum[i] = V(plan.armature[i]) * fma(factor, after.average[i], less * before.v[i]);
    }
    each_freedom([&](int k, int i) {
      momentum[i] += dot<T>(b.axes + S * i, sums[k].torque) + dot<D>(b.axes + S * i + T, sums[k].force);
    });
    for (int i = 0; i < n; i++) {
      const V ahead = early(b, i);
      momentum[i] += h * select(on_chord, -fma(ahead, smooth[i], rough[i]), half * (V(1) - ahead) * smooth[i]);
    }

    masses(b);
    for (int i = 0; i < n; i++) {
      V row(0);
      for (int j = 0; j < n; j++) row = fma(matrix[i * n + j], before.v[j], row);
      other[i] = momentum[i] - row - h * smooth[i];
      after.v[i] = momentum[i], after.push[i] = impulse[i];
    }
    factor_along_the_tree(plan, matrix);
    substitute_along_the_tree(plan, matrix, after.v), substitute_along_the_tree(plan, matrix, after.push);
    V kept(0), whole(0);
    for (int i = 0; i < n; i++) kept = fma(impulse[i], before.push[i], kept), whole = fma(impulse[i], after.push[i], whole);
    const V share = clamped(kept / select(whole > zero, whole, V(1)), zero, V(1));
    for (int i = 0; i < n; i++) {
      after.lag[i] = -early(b, i) * (other[i] - (V(1) - share) * impulse[i]);
      after.steady[i] = share * after.push[i];
    }
    substitute_along_the_tree(plan, matrix, after.lag);

    for (int i = 0; i < n; i++) total[i] = fma(half, before.steady[i], before.v[i]);
    const V first = kinetic(b.start, b.start_axes, total);
    for (int i = 0; i < n; i++) total[i] = fma(half, after.steady[i], after.v[i]);
    const V last = kinetic(b.now, b.axes, total);
    V work(0), spurious(0), turned(0);
    for (int i = 0; i < n; i++) {
      work = fma(h * (rough[i] + smooth[i]), after.average[i], work);
      spurious = fma(h * b.residual[i], after.average[i], spurious);
      turned = max(turned, abs(h * after.average[i]) * V(plan.turns[i]));
    }
    V lost(0), flattest(1);
    for (int k = 0; k < plan.nodes; k++) {
      V x[D], x0[D], middle[D * D];
      times<D>(b.now.rotation + D * D * k, plan.center + D * k, x), times<D>(b.start.rotation + D * D * k, plan.center + D * k, x0);
      for (int i = 0; i < D; i++) {
        const V fell = (x[i] + b.now.position[D * k + i]) - (x0[i] + b.start.position[D * k + i]);
        lost = fma(V(plan.mass[k]) * V(plan.gravity[i]), fell, lost);
      }
      for (int i = 0; i < D * D; i++) middle[i] = half * (b.now.rotation[D * D * k + i] + b.start.rotation[D * D * k + i]);
      flattest = min(flattest, determinant<D>(middle));
    }
    const V falls = falling_energy(plan, h), energy = last - first - lost - work;
    const V peak = max(before.peak[0], max(first, last) + falls), sum = max(before.surplus[0] + energy, V(-RESERVE) * peak);
    after.gained[0] = energy, after.peak[0] = peak, after.surplus[0] = sum;
    const V whole_energy = first + last + falls, gained = energy - spurious, surplus = sum - spurious;
    const M excess = (energy > V(EXCESS) * whole_energy) & (gained > V(EXCESS) * whole_energy);
    const M overdrawn = (sum > surplus_allowed * peak) & (energy > V(NOISE) * peak) & (surplus > surplus_allowed * peak) &
                        (gained > V(NOISE) * peak);
    return on_chord & ((flattest < V(FLATTEST)) | (turned > V(FARTHEST)) | excess | overdrawn);
  }

 private:
  // The share of smooth forces that comes early.
  V early(const Balance<V, N, D>& b, int i) const { return fma(V(2), b.fitted[i], V(-1)); }

  template <class F> void each_freedom(F&& visit) const {
    for (int k = 0; k < plan.nodes; k++)
      for (int i = plan.v[k]; i < plan.v[k] + freedoms(plan.kind[k]); i++) visit(k, i);
  }
  // Generalised forces of contacts, limits and dry friction, and of what is `Fitted`, as if taken whole.
  void split_forces(const Balance<V, N, D>& b, const V* q) {
    const JointStep<V> step = b.steps();
    for (int i = 0; i < plan.nv; i++) smooth[i] = rough[i] = other[i] = V(0);  // slopes are not asked for
    joint_loads<SMOOTH>(plan, step, q, smooth, other);
    joint_loads<ROUGH>(plan, step, q, rough, other);
    each_freedom([&](int k, int i) {
      if (b.pushes[k].any) rough[i] += worked<D>(b.axes + S * i, b.pushes[k].moment, b.pushes[k].force);
    });
    for (int i = 0; i < plan.nv; i++) smooth[i] = -smooth[i] / b.fitted[i], rough[i] = -rough[i];
  }

  // The moment of the momenta of a node whose pose changes at `rate`.
  void pushed(int k, Poses<V> at, const V* rate, Pull<V, D>& out) const {
    const N *center = plan.center + D * k, *second = plan.second + D * D * k;
    const V *R = at.rotation + D * D * k, mass = V(plan.mass[k]);
    V spread[D * D], moment[D * D], x[D], speed[D], torque[T];
    product<D>(rate, second, spread);
    product_transposed<D>(spread, R, moment);
    times<D>(R, center, x), times<D>(rate, center, speed);
    for (int i = 0; i < D; i++) {
      x[i] += at.position[D * k + i];
      out.force[i] = mass * (speed[i] + rate[D * D + i]), out.first[i] = mass * x[i];
    }
    curl<D>(moment, out.torque), lever<D>(x, out.force, torque);
    for (int i = 0; i < T; i++) out.torque[i] += torque[i];
    // beside it, what the mass matrix needs
    product<D>(R, second, spread);
    product_transposed<D>(spread, R, moment);
    for (int i = 0; i < D; i++)
      for (int j = 0; j < D; j++) moment[D * i + j] = fma(out.first[i], x[j], moment[D * i + j]);
    resistance<D>(moment, out.turning);
    out.any = true;
  }
  void sum_up() {
    for (int k = plan.nodes - 1; k > 0; k--)
      if (plan.parent[k] >= 0) sums[plan.parent[k]].add(sums[k]);
  }

  V kinetic(Poses<V> at, const V* axes, const V* v) {
    pose_rates(plan, at, axes, v, twist, rates);
    V rotors(0);
    for (int i = 0; i < plan.nv; i++) rotors = fma(V(plan.armature[i]) * v[i], v[i], rotors);
    return fma(V(0.5), rotors, kinetic_energy(plan, rates));
  }

  // M [nv × nv] at the end of the step.
  void masses(const Balance<V, N, D>& b) {
    const int n = plan.nv;
    for (int i = 0; i < n * n; i++) matrix[i] = V(0);
    each_freedom([&](int k, int j) {
      const Pull<V, D>& p = sums[k];
      V below[S];
      answer(p, V(plan.carried[k]), p.first, b.axes + S * j, below);
      for (int up = k; up >= 0; up = plan.parent[up])
        for (int i = plan.v[up]; i < (up == k ? j + 1 : plan.v[up] + freedoms(plan.kind[up])); i++)
          matrix[i * n + j] = matrix[j * n + i] = dot<S>(b.axes + S * i, below);
      matrix[j * n + j] += V(plan.armature[j]);
    });
  }
};

}  // namespace pbfd
