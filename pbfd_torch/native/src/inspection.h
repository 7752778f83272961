// The balance of forces of a step at any configuration, for those who judge it.
#pragma once
#include "integrators.h"

namespace pbfd {

// States and configurations of all worlds, [count, worlds] each, and what comes out.
template <class T> struct BalanceArrays {
  const T *q, *v, *control, *grip, *at;
  T *residual, *matrix;
};

// r and J of worlds first … last − 1.
template <class V, class N>
inline void inspect(
    const Plan<N>& plan, const BalanceArrays<typename Kind<V>::Scalar>& a, int worlds, int first, int last, V dt, Arena<V>& arena) {
  using T = typename Kind<V>::Scalar;
  constexpr int W = Kind<V>::lanes;
  Balance<V, N> balance(plan, arena);
  V *q = arena.take(plan.nq), *v = arena.take(plan.nv), *at = arena.take(plan.nq), *room = arena.take(18 * plan.nodes);
  balance.dt = dt, balance.contacts.own_grip = a.grip;
  for (int world = first; world < last; world += W) {
    auto load = [&](const T* from, int count, V* to) {
      for (int i = 0; i < W; i++)
        for (int j = 0; j < count; j++) put(to[j], i, from[j * worlds + (world + i < last ? world + i : first)]);
    };
    load(a.q, plan.nq, q), load(a.v, plan.nv, v), load(a.control, plan.nu, balance.control), load(a.at, plan.nq, at);
    for (int i = 0; i < W; i++) balance.contacts.load(i, world + i < last ? world + i : first, worlds);
    begin_energy_momentum(balance, q, v, room);
    balance.evaluate(at), balance.assemble(at, true);
    for (int i = 0; i < W && world + i < last; i++) {
      for (int j = 0; j < plan.nv; j++) a.residual[j * worlds + world + i] = lane(balance.residual[j], i);
      for (int j = 0; j < plan.nv * plan.nv; j++) a.matrix[j * worlds + world + i] = lane(balance.matrix[j], i);
    }
  }
}

}  // namespace pbfd
