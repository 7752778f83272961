// Generalised forces at a configuration but for inertia, by their kinds, as `_Forces` in integrators/energy_momentum.py and
// `BalanceObjective.forces`. The balance has been begun, and its nodes are there.
#pragma once
#include "balance.h"

namespace pbfd {

// What loads of some kinds on joints do. slopes: [nv] of room.
template <int LOADS, class V, class N, int D> inline void forces_of(const Balance<V, N, D>& b, const V* q, V* out, V* slopes) {
  for (int i = 0; i < b.plan.nv; i++) out[i] = slopes[i] = V(0);  // slopes are not asked for
  joint_loads<LOADS>(b.plan, b.steps(), q, out, slopes);
}

// Rough ones, of all that pushes, limits and dry friction; and smooth ones, of what is `Fitted`, as if taken whole.
template <class V, class N, int D>
inline void forces_by_share(const Balance<V, N, D>& b, const V* q, V* rough, V* smooth, V* slopes) {
  forces_of<SMOOTH>(b, q, smooth, slopes), forces_of<ROUGH>(b, q, rough, slopes);
  b.add_pushed(rough);
  for (int i = 0; i < b.plan.nv; i++) smooth[i] = -smooth[i] / b.fitted[i], rough[i] = -rough[i];
}

// Abrupt ones, of contacts and limits, and the others. The pushes are found anew.
template <class V, class N, int D> inline void forces_by_onset(Balance<V, N, D>& b, const V* q, V* abrupt, V* others, V* slopes) {
  forces_of<LIMITS>(b, q, abrupt, slopes), forces_of<SMOOTH | DRY>(b, q, others, slopes);
  b.gather([&] { b.touch(); }), b.add_pushed(abrupt);
  b.gather([&] { b.push(); }), b.add_pushed(others);
  for (int i = 0; i < b.plan.nv; i++) abrupt[i] = -abrupt[i], others[i] = -others[i];
}

}  // namespace pbfd
