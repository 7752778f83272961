// How the problem that a lane solves may be easier than its step, as `BalanceObjective.widened`, `softened`, `shortened`, `lagged`.
#pragma once
#include "plan.h"

namespace pbfd {

template <class V> struct Relaxed {
  V width, firmness;  // multiples of the friction's width, and of the stiffness of contacts and limits
  V length;           // share of the step's length that inertia knows of
  typename Kind<V>::Mask lagged;  // whose friction feels the normal forces `held` [candidates], whatever the depth is now
  bool lagging;                   // any lane's
  V *held, *pressed;  // `pressed`: the normal forces themselves, for torsional friction

  void none() { width = firmness = length = V(1), lagged = typename Kind<V>::Mask(false), lagging = false; }

  V holding(int i) const { return lagging ? select(lagged, held[i], V(0)) : V(0); }
  V pressing(int i) const { return lagging ? select(lagged, pressed[i], V(0)) : V(0); }
  void hold(typename Kind<V>::Mask which, int i, V force, V felt) {
    pressed[i] = select(which, force, pressed[i]), held[i] = select(which, felt, held[i]);
  }
  // From the normal force of the depth (or the depth itself), and its slope, to what friction feels of them.
  void felt(V holding, V& push, V& rises) const {
    if (!lagging) return;
    push = select(lagged, holding, push), rises = select(lagged, V(0), rises);
  }
};

}  // namespace pbfd
