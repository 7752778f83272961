// What bodies that move have: momenta on the motions of the joints, mass matrix, kinetic energy, as balance/dynamics.py.
#pragma once
#include "integrators.h"

namespace pbfd {

template <class V, class N, int D = 3> struct Momenta {
  static constexpr int T = turns(D), S = T + D;
  const Plan<N, D>& plan;
  V *twist, *rates;  // room for how nodes move, [6] and [12] each
  V* matrix;         // M [nv × nv]
  Pull<V, D>* sums;

  static int room(Sizes s) { return s.nodes * (6 + 12 + int(sizeof(Pull<V, D>) / sizeof(V))) + s.nv * s.nv; }
  Momenta(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene) {
    twist = arena.take(6 * plan.nodes), rates = arena.take(12 * plan.nodes), matrix = arena.take(plan.nv * plan.nv);
    sums = reinterpret_cast<Pull<V, D>*>(arena.take(plan.nodes * int(sizeof(Pull<V, D>) / sizeof(V))));
  }

  // The moment of the momenta of a node whose pose changes at `rate`.
  void take(int k, Poses<V> at, const V* rate) {
    Pull<V, D>& out = sums[k];
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

  // All nodes have been taken: ⟨S Ṫ, ∂T/∂θ⟩ of their rates Ṫ, added to what is there.
  void add_to(V* out, const V* axes) {
    for (int k = plan.nodes - 1; k > 0; k--)
      if (plan.parent[k] >= 0) sums[plan.parent[k]].add(sums[k]);
    each_freedom([&](int k, int i) { out[i] += dot<T>(axes + S * i, sums[k].torque) + dot<D>(axes + S * i + T, sums[k].force); });
  }

  // M where they are.
  void masses(const V* axes) {
    const int n = plan.nv;
    for (int i = 0; i < n * n; i++) matrix[i] = V(0);
    each_freedom([&](int k, int j) {
      const Pull<V, D>& p = sums[k];
      V below[S];
      answer(p, V(plan.carried[k]), p.first, axes + S * j, below);
      for (int up = k; up >= 0; up = plan.parent[up])
        for (int i = plan.v[up]; i < (up == k ? j + 1 : plan.v[up] + freedoms(plan.kind[up])); i++)
          matrix[i * n + j] = matrix[j * n + i] = dot<S>(axes + S * i, below);
      matrix[j * n + j] += V(plan.armature[j]);
    });
  }

  // Of bodies that move with v, and of their rotors.
  V kinetic(Poses<V> at, const V* axes, const V* v) {
    pose_rates(plan, at, axes, v, twist, rates);
    V rotors(0);
    for (int i = 0; i < plan.nv; i++) rotors = fma(V(plan.armature[i]) * v[i], v[i], rotors);
    return fma(V(0.5), rotors, kinetic_energy(plan, rates));
  }

 private:
  template <class F> void each_freedom(F&& visit) const {
    for (int k = 0; k < plan.nodes; k++)
      for (int i = plan.v[k]; i < plan.v[k] + freedoms(plan.kind[k]); i++) visit(k, i);
  }
};

}  // namespace pbfd
