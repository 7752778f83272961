// The balance of forces of a step at any configuration, for those who judge it.
#pragma once
#include "fitted.h"
#include "integrators.h"

namespace pbfd {

// r [nv] and J [nv × nv] at a configuration of the step from q with v under a control. behind: what anchors remember;
// `from`, `to`: where the obstacles that move begin and end.
template <class T, int D>
inline void inspect(const Plan<T, D>& plan, const T* behind, const T* q, const T* v, const T* control, const T* at, T dt,
                    const T* from, const T* to, Arena<T> arena, T* residual, T* matrix) {
  Balance<T, T, D> balance(plan, arena);
  T* room = arena.take(18 * plan.nodes);
  balance.dt = dt, balance.share = T(0.5), balance.contacts.grip = plan.contact.grip, balance.recall(behind);
  fit(plan, 0, dt, balance.fitted);
  for (int j = 0; j < plan.nu; j++) balance.control[j] = control[j];
  balance.carriers.load(0, from, to);
  begin_energy_momentum(balance, q, v, room);
  balance.begin();
  balance.evaluate(at), balance.assemble(at, true);
  for (int j = 0; j < plan.nv; j++) residual[j] = balance.residual[j];
  for (int j = 0; j < plan.nv * plan.nv; j++) matrix[j] = balance.matrix[j];
}

}  // namespace pbfd
