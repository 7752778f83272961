// What is asked of an integrator's steps, and what it keeps from one to the next: a state is a struct of pointers to arrays, and
// `State::each(sizes, visit)` visits (member, width) in the order of the interface, q first.
#pragma once
#include "plan.h"

namespace pbfd {

struct Rules {
  double tolerance;             // of ‖r/scale‖
  double surplus, share, jump;  // see `EnergyMomentum`, `Variational`, `Bdf2`
  int halvings, evaluations;    // how often a step may be halved; at most, with all that is tried
  double accuracy, shortest;    // of steps that each world chooses the length of, see frames.h; 0: their length is given
  double trust;                 // of explicit steps, see `RungeKutta`; 0: there are none
};

template <class State> inline int room_for(Sizes s) {
  int count = 0;
  State::each(s, [&](auto, int width) { count += width; });
  return count;
}

template <class State, class V> inline State taken(Arena<V>& arena, Sizes s) {
  State x;
  State::each(s, [&](auto member, int width) { x.*member = arena.take(width); });
  return x;
}

template <class State, class M> inline void copy(Sizes s, M which, const State& from, State& to) {
  if (!any(which)) return;
  State::each(s, [&](auto member, int width) {
    for (int i = 0; i < width; i++) (to.*member)[i] = select(which, (from.*member)[i], (to.*member)[i]);
  });
}

}  // namespace pbfd
