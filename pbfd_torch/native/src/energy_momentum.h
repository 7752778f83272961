// The state after an energy–momentum step, and what it has gained beyond the forces' work, as integrators/energy_momentum.py.
#pragma once
#include "newton.h"

namespace pbfd {

constexpr double FLATTEST = 0.3, FARTHEST = 2.0, EXCESS = 1e-2, NOISE = 1e-4, RESERVE = 1e-2;

// Attributes as of `Velocities`, [nv] each but for the three energies.
template <class V> struct Velocities {
  V *v, *push, *steady, *lag, *average;
  V gained, surplus, peak;
  static Velocities in(Arena<V>& arena, Sizes s) {
    Velocities x;
    x.v = arena.take(s.nv), x.push = arena.take(s.nv), x.steady = arena.take(s.nv);
    x.lag = arena.take(s.nv), x.average = arena.take(s.nv), x.gained = x.surplus = x.peak = V(0);
    return x;
  }
};

template <class V, class N, int D = 3> struct EnergyMomentum {
  static constexpr int T = turns(D), S = T + D;
  using M = typename Kind<V>::Mask;
  const Plan<N, D>& plan;
  V surplus_allowed;
  V *twist, *rates, *momentum, *impulse, *smooth, *rough, *other, *matrix, *total;
  Pull<V, D>* sums;

  static int room(Sizes s) {
    return s.nodes * (6 + 12 + int(sizeof(Pull<V, D>) / sizeof(V))) + 6 * s.nv + s.nv * s.nv;
  }
  EnergyMomentum(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene), surplus_allowed(1e-3) {
    twist = arena.take(6 * plan.nodes), rates = arena.take(12 * plan.nodes);
    momentum = arena.take(plan.nv), impulse = arena.take(plan.nv), smooth = arena.take(plan.nv), rough = arena.take(plan.nv);
    other = arena.take(plan.nv), total = arena.take(plan.nv), matrix = arena.take(plan.nv * plan.nv);
    sums = reinterpret_cast<Pull<V, D>*>(arena.take(plan.nodes * int(sizeof(Pull<V, D>) / sizeof(V))));
  }

  // At t_n.
  V velocity(const Velocities<V>& x, int i) const { return fma(V(0.5), x.steady[i] + x.lag[i], x.v[i]); }

  // From the state before to that after a step that ended at q, where `b` has been evaluated; which lanes refuse it.
  M advance(Balance<V, N, D>& b, const V* q, const Velocities<V>& before, Velocities<V>& after) {
    const int n = plan.nv;
    const V h = b.dt, per = V(1) / h, twice = per + per, zero(0), half(0.5);
    split_forces(b, q);
    difference(plan, b.q_start, q, after.average);
    for (int i = 0; i < n; i++) after.average[i] = per * after.average[i];

    // what V_n and V_{n+1} = 2 ΔT/Δt − V_n are on the joints' motions
    pose_rates(plan, b.start, b.start_axes, before.v, twist, rates);
    for (int k = 0; k < plan.nodes; k++) {
      const V* rate = rates + (D * D + D) * k;
      V next[D * D + D];
      for (int i = 0; i < D * D; i++)
        next[i] = fma(twice, b.now.rotation[D * D * k + i] - b.start.rotation[D * D * k + i], -rate[i]);
      for (int i = 0; i < D; i++)
        next[D * D + i] = fma(twice, b.now.position[D * k + i] - b.start.position[D * k + i], -rate[D * D + i]);
      pushed(k, b.now, next, sums[k]);
    }
    sum_up();
    for (int i = 0; i < n; i++) {
      impulse[i] = h * rough[i];
      momentum[i] = V(plan.armature[i]) * fma(V(2), after.average[i], -before.v[i]);
    }
    each_freedom([&](int k, int i) {
      momentum[i] += dot<T>(b.axes + S * i, sums[k].torque) + dot<D>(b.axes + S * i + T, sums[k].force);
    });
    for (int i = 0; i < n; i++) momentum[i] -= h * fma(ahead(i), smooth[i], rough[i]);

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
      after.lag[i] = -ahead(i) * (other[i] - (V(1) - share) * impulse[i]);
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
    V mass(0), lost(0), flattest(1);
    for (int k = 0; k < plan.nodes; k++) {
      V x[D], x0[D], middle[D * D];
      times<D>(b.now.rotation + D * D * k, plan.center + D * k, x), times<D>(b.start.rotation + D * D * k, plan.center + D * k, x0);
      mass += V(plan.mass[k]);
      for (int i = 0; i < D; i++) {
        const V fell = (x[i] + b.now.position[D * k + i]) - (x0[i] + b.start.position[D * k + i]);
        lost = fma(V(plan.mass[k]) * V(plan.gravity[i]), fell, lost);
      }
      for (int i = 0; i < D * D; i++) middle[i] = half * (b.now.rotation[D * D * k + i] + b.start.rotation[D * D * k + i]);
      flattest = min(flattest, determinant<D>(middle));
    }
    V g[D];
    for (int i = 0; i < D; i++) g[i] = V(plan.gravity[i]);
    const V strength = max(sqrt(dot<D>(g, g)), V(1)), falls = half * mass * (h * strength) * (h * strength);
    after.gained = last - first - lost - work;
    after.peak = max(before.peak, max(first, last) + falls);
    after.surplus = max(before.surplus + after.gained, V(-RESERVE) * after.peak);
    const V whole_energy = first + last + falls;
    const V gained = after.gained - spurious, surplus = after.surplus - spurious;
    const M excess = (after.gained > V(EXCESS) * whole_energy) & (gained > V(EXCESS) * whole_energy);
    const M overdrawn = (after.surplus > surplus_allowed * after.peak) & (after.gained > V(NOISE) * after.peak) &
                        (surplus > surplus_allowed * after.peak) & (gained > V(NOISE) * after.peak);
    return (flattest < V(FLATTEST)) | (turned > V(FARTHEST)) | excess | overdrawn;
  }

 private:
  V ahead(int i) const { return fma(V(2), V(plan.share[i]), V(-1)); }

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
    for (int i = 0; i < plan.nv; i++) smooth[i] = -smooth[i] / V(plan.share[i]), rough[i] = -rough[i];
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
    V twice(0);
    for (int k = 0; k < plan.nodes; k++) {
      const V* rate = rates + (D * D + D) * k;
      V spread[D * D], speed[D];
      product<D>(rate, plan.second + D * D * k, spread);
      for (int i = 0; i < D * D; i++) twice = fma(spread[i], rate[i], twice);
      times<D>(rate, plan.center + D * k, speed);
      for (int i = 0; i < D; i++) speed[i] += rate[D * D + i];
      twice = fma(V(plan.mass[k]), dot<D>(speed, speed), twice);
    }
    for (int i = 0; i < plan.nv; i++) twice = fma(V(plan.armature[i]) * v[i], v[i], twice);
    return V(0.5) * twice;
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
