// The lane machine: every pass makes one evaluation for all lanes, and a lane that has ended its step takes the next world at once
// (the paper's Fig. 3).
#pragma once
#include "energy_momentum.h"

namespace pbfd {

constexpr int TOO_DEEP = 8, TURNED_FAR = 16;
constexpr double TOO_FAR = 0.02;  // [rad or m] past a limit

// Arrays of all worlds, one value after the other for each coordinate: [count, worlds].
template <class T> struct StepArrays {
  const T *q, *v, *push, *steady, *lag, *average, *gained, *surplus, *peak, *control;
  T *q_out, *v_out, *push_out, *steady_out, *lag_out, *average_out, *gained_out, *surplus_out, *peak_out;
  T *residual_norm;
  int *status, *evaluations, *iterations, *refused, *hazards;
};

template <class V, class N> struct Machine {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr int W = Kind<V>::lanes;

  const Plan<N>& plan;
  Newton<V, N> newton;
  EnergyMomentum<V, N> scheme;
  Velocities<V> before, after;
  V *q, *guess, *room_to_begin;

  static int room(Sizes s) {
    return Newton<V, N>::room(s) + EnergyMomentum<V, N>::room(s) + 10 * s.nv + 2 * s.nq + 18 * s.nodes;
  }
  Machine(const Plan<N>& scene, Arena<V>& arena)
      : plan(scene), newton(scene, arena), scheme(scene, arena), before(Velocities<V>::in(arena, scene)),
        after(Velocities<V>::in(arena, scene)) {
    q = arena.take(plan.nq), guess = arena.take(plan.nq), room_to_begin = arena.take(18 * plan.nodes);
  }

  // One energy–momentum step of worlds first … last − 1.
  void run(const StepArrays<T>& a, int worlds, int first, int last, T dt, T tolerance, int most) {
    int at[W];
    int next = first;
    M fresh(false);
    newton.running = M(false);
    newton.tolerance = V(tolerance), newton.most = V(T(most)), newton.balance.dt = V(dt);
    for (int i = 0; i < W; i++) {
      at[i] = next < last ? next++ : -1;
      load(a, worlds, i, at[i] < 0 ? first : at[i]);
      put(fresh, i, at[i] >= 0);
    }
    while (true) {
      set_out(fresh);
      do newton.pass();
      while (!enough(at, next < last));
      newton.balance.evaluate(newton.trial);  // running lanes look again; the others are where their step has ended
      const M refused = scheme.advance(newton.balance, newton.q, before, after);
      M deep, far;
      look_for_hazards(deep, far);
      bool left = false;
      for (int i = 0; i < W; i++) {
        const bool done = at[i] >= 0 && !lane(newton.running, i);
        put(fresh, i, false);
        if (done) {
          store(a, worlds, i, at[i], lane(refused, i), TOO_DEEP * lane(deep, i) + TURNED_FAR * lane(far, i));
          at[i] = next < last ? next++ : -1;
          if (at[i] >= 0) load(a, worlds, i, at[i]), put(fresh, i, true);
        }
        left |= at[i] >= 0;
      }
      if (!left) return;
    }
  }

 private:
  // Lanes are served together: what it costs to end a step is the same for one lane and for all.
  bool enough(const int* at, bool more) const {
    int ended = 0, busy = 0;
    for (int i = 0; i < W; i++) {
      if (at[i] < 0) continue;
      busy += lane(newton.running, i), ended += !lane(newton.running, i);
    }
    return busy == 0 || (more && 2 * ended >= W);
  }

  // Of contacts and limits (contact/hazards.py).
  void look_for_hazards(M& deep, M& far) const {
    deep = far = M(false);
    newton.balance.contacts.look_for_hazards(deep, far);
    for (int k = 0; k < plan.nodes; k++) {
      if (plan.kind[k] != HINGE && plan.kind[k] != SLIDE) continue;
      const int i = plan.v[k];
      const V x = newton.q[plan.q[k]], past = max(V(plan.lower[i]) - x, x - V(plan.upper[i]));
      deep = deep | ((past > V(TOO_FAR)) & (V(plan.limit[i]) > V(0)));
    }
  }

  void set_out(M fresh) {
    if (!any(fresh)) return;
    begin_energy_momentum(newton.balance, q, before.v, room_to_begin);  // of lanes on their way too: the same again
    retract(plan, q, before.average, newton.balance.dt, guess);
    newton.begin(fresh, guess);
  }

  template <class F> void each(const StepArrays<T>& a, F&& move) {
    move(a.v, a.v_out, before.v, after.v), move(a.push, a.push_out, before.push, after.push);
    move(a.steady, a.steady_out, before.steady, after.steady), move(a.lag, a.lag_out, before.lag, after.lag);
    move(a.average, a.average_out, before.average, after.average);
  }
  void load(const StepArrays<T>& a, int worlds, int i, int world) {
    newton.balance.contacts.load(i, world, worlds);
    for (int j = 0; j < plan.nq; j++) put(q[j], i, a.q[j * worlds + world]);
    each(a, [&](const T* from, T*, V* to, V*) {
      for (int j = 0; j < plan.nv; j++) put(to[j], i, from[j * worlds + world]);
    });
    for (int j = 0; j < plan.nu; j++) put(newton.balance.control[j], i, a.control[j * worlds + world]);
    put(before.gained, i, a.gained[world]), put(before.surplus, i, a.surplus[world]), put(before.peak, i, a.peak[world]);
  }
  void store(const StepArrays<T>& a, int worlds, int i, int world, bool refused, int hazards) {
    for (int j = 0; j < plan.nq; j++) a.q_out[j * worlds + world] = lane(newton.q[j], i);
    each(a, [&](const T*, T* to, V*, V* from) {
      for (int j = 0; j < plan.nv; j++) to[j * worlds + world] = lane(from[j], i);
    });
    a.gained_out[world] = lane(after.gained, i), a.surplus_out[world] = lane(after.surplus, i);
    a.peak_out[world] = lane(after.peak, i);
    a.residual_norm[world] = lane(newton.error, i);
    a.status[world] = int(lane(newton.status, i)), a.evaluations[world] = int(lane(newton.evaluations, i));
    a.iterations[world] = int(lane(newton.iterations, i)), a.refused[world] = refused, a.hazards[world] = hazards;
  }
};

}  // namespace pbfd
