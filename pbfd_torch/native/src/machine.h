// The lane machine: every pass makes one evaluation for all lanes, and a lane that has ended its step takes the next one of its world,
// or another world, at once (the paper's Fig. 3).
#pragma once
#include "energy_momentum.h"
#include "standstill.h"

namespace pbfd {

constexpr int TOO_DEEP = 8, TURNED_FAR = 16;
constexpr double TOO_FAR = 0.02;  // [rad or m] past a limit

// What one call is asked for: arrays as interface.h has them.
template <class T> struct Journey {
  int worlds, steps;
  bool held;
  int* made;
  const T *q, *v, *push, *steady, *lag, *average, *gained, *surplus, *peak, *control;
  T *q_out, *v_out, *push_out, *steady_out, *lag_out, *average_out, *gained_out, *surplus_out, *peak_out;
  T* residual_norm;
  int *status, *evaluations, *iterations, *refused, *hazards;
};

template <class V, class N, int D = 3> struct Machine {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr int W = Kind<V>::lanes;

  const Plan<N, D>& plan;
  Newton<V, N, D> newton;
  EnergyMomentum<V, N, D> scheme;
  Velocities<V> before, after;
  V *q, *guess, *velocity, *room_to_begin;

  static int room(Sizes s) {
    return Newton<V, N, D>::room(s) + EnergyMomentum<V, N, D>::room(s) + 11 * s.nv + 2 * s.nq + 18 * s.nodes;
  }
  Machine(const Plan<N, D>& scene, Arena<V>& arena)
      : plan(scene), newton(plan, arena), scheme(plan, arena), before(Velocities<V>::in(arena, plan)),
        after(Velocities<V>::in(arena, plan)) {
    q = arena.take(plan.nq), guess = arena.take(plan.nq), velocity = arena.take(plan.nv);
    room_to_begin = arena.take(18 * plan.nodes);
  }

  // The steps of worlds first … last − 1 that they have not made yet. A world whose step is not solved, or is refused, stops there.
  void run(const Journey<T>& to, int first, int last, T dt, T tolerance, int most) {
    journey = &to, next = first, end = last;
    newton.running = M(false);
    newton.tolerance = V(tolerance), newton.most = V(T(most)), newton.balance.dt = V(dt);
    M fresh = able = M(false);
    for (int i = 0; i < W; i++) put(fresh, i, board(i));
    while (any_aboard()) {
      set_out(fresh);
      do newton.pass();
      while (!enough());
      fresh = arrive();
    }
  }

 private:
  const Journey<T>* journey;
  int next, end;  // worlds that no lane has taken yet
  int world[W];   // of each lane; −1: none
  int step[W];    // of that world
  M able;         // who could set out

  bool any_aboard() const {
    for (int i = 0; i < W; i++)
      if (world[i] >= 0) return true;
    return false;
  }

  // A lane takes the next world that has steps to make; whether there is one.
  bool board(int i) {
    while (next < end && journey->made[next] >= journey->steps) next++;
    // a lane without a world has the start of some world: idle lanes compute too
    const bool found = next < end;
    const int from = found ? next++ : end - 1;
    world[i] = found ? from : -1, step[i] = journey->made[from];
    load(i, from), steer(i, from);
    return found;
  }

  // Lanes are served together: what it costs to end a step is the same for one lane and for all.
  bool enough() const {
    int ended = 0, busy = 0;
    bool more = next < end;
    for (int i = 0; i < W; i++) {
      if (world[i] < 0) continue;
      const bool runs = lane(newton.running, i);
      busy += runs, ended += !runs, more = more || (!runs && step[i] + 1 < journey->steps);
    }
    return busy == 0 || (more && 2 * ended >= W);
  }

  // Lanes set out on their step: those on their way find the same again.
  void set_out(M fresh) {
    if (!any(fresh)) return;
    Balance<V, N, D>& b = newton.balance;
    for (int i = 0; i < plan.nv; i++) velocity[i] = scheme.velocity(before, i);
    const M fits = near(q, plan.nq) & slow(plan, velocity, b.dt) & finite(b.control, plan.nu);
    able = (able & !fresh) | (fits & fresh);
    begin_energy_momentum(b, q, before.v, room_to_begin);
    retract(plan, q, before.average, b.dt, guess);
    // from NaN nothing is near, and the search ends at its start
    for (int i = 0; i < plan.nq; i++) guess[i] = select(fits, guess[i], infinite<V>() - infinite<V>());
    newton.begin(fresh, guess);
    for (int i = 0; i < plan.nq; i++) newton.retreat[i] = select(fits | !fresh, newton.retreat[i], guess[i]);
  }

  // Lanes whose step has ended go on with the next one, or with another world; who sets out now.
  M arrive() {
    if (!newton.settled) newton.balance.evaluate(newton.trial);
    const M refused = scheme.advance(newton.balance, newton.q, before, after);
    M deep, far;
    look_for_hazards(deep, far);
    for (int i = 0; i < plan.nv; i++) velocity[i] = scheme.velocity(after, i);
    const M lost = !(able & near(newton.q, plan.nq) & finite(velocity, plan.nv) & (newton.status < V(NON_FINITE)));
    const M solved = newton.status <= V(SOLVED);
    const M ended = aboard() & !newton.running, gone = ended & lost;
    if (any(gone)) still(gone);
    M fresh(false), goes_on(false);
    for (int i = 0; i < W; i++) {
      if (!lane(ended, i)) continue;
      const bool stays = lane(gone, i), stops = !stays && (lane(refused, i) || !lane(solved, i));
      store(i);
      report(i, stays ? NON_FINITE : int(lane(newton.status, i)), !stays && lane(refused, i),
             stays ? 0 : TOO_DEEP * lane(deep, i) + TURNED_FAR * lane(far, i));
      const bool last = step[i] + 1 == journey->steps;
      if (!stops) step[i]++;
      journey->made[world[i]] = step[i];
      if (stops || last)
        put(fresh, i, board(i));
      else
        put(fresh, i, true), put(goes_on, i, true), steer(i, world[i]);
    }
    if (any(goes_on)) go_on(goes_on);
    return fresh;
  }

  M aboard() const {
    M there(false);
    for (int i = 0; i < W; i++) put(there, i, world[i] >= 0);
    return there;
  }

  // Worlds that got lost are where they were.
  void still(M gone) {
    for (int i = 0; i < plan.nq; i++) newton.q[i] = select(gone, q[i], newton.q[i]);
    each([&](V* from, V* to) {
      for (int i = 0; i < plan.nv; i++) to[i] = select(gone, from[i], to[i]);
    });
    after.gained = select(gone, before.gained, after.gained), after.surplus = select(gone, before.surplus, after.surplus);
    after.peak = select(gone, before.peak, after.peak);
  }
  void go_on(M which) {
    for (int i = 0; i < plan.nq; i++) q[i] = select(which, newton.q[i], q[i]);
    each([&](V* to, V* from) {
      for (int i = 0; i < plan.nv; i++) to[i] = select(which, from[i], to[i]);
    });
    before.gained = select(which, after.gained, before.gained), before.surplus = select(which, after.surplus, before.surplus);
    before.peak = select(which, after.peak, before.peak);
  }
  template <class F> void each(F&& visit) {
    visit(before.v, after.v), visit(before.push, after.push), visit(before.steady, after.steady);
    visit(before.lag, after.lag), visit(before.average, after.average);
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

  // Between a lane and the arrays.
  void steer(int i, int from) {
    const int last = journey->steps - 1, now = step[i] < last ? step[i] : last;
    const long row = (journey->held ? 0 : long(now) * journey->worlds) + from;
    for (int j = 0; j < plan.nu; j++) put(newton.balance.control[j], i, journey->control[row * plan.nu + j]);
  }
  void load(int i, int from) {
    newton.balance.contacts.load(i, from);
    const Journey<T>& a = *journey;
    auto read = [&](const T* array, V* to, int count) {
      for (int j = 0; j < count; j++) put(to[j], i, array[long(from) * count + j]);
    };
    read(a.q, q, plan.nq), read(a.v, before.v, plan.nv), read(a.push, before.push, plan.nv);
    read(a.steady, before.steady, plan.nv), read(a.lag, before.lag, plan.nv), read(a.average, before.average, plan.nv);
    read(a.gained, &before.gained, 1), read(a.surplus, &before.surplus, 1), read(a.peak, &before.peak, 1);
  }
  void store(int i) const {
    const Journey<T>& a = *journey;
    const Velocities<V>& x = after;
    const long to = long(step[i]) * a.worlds + world[i];
    auto write = [&](const V* values, T* array, int count) {
      for (int j = 0; j < count; j++) array[to * count + j] = lane(values[j], i);
    };
    write(newton.q, a.q_out, plan.nq), write(x.v, a.v_out, plan.nv), write(x.push, a.push_out, plan.nv);
    write(x.steady, a.steady_out, plan.nv), write(x.lag, a.lag_out, plan.nv), write(x.average, a.average_out, plan.nv);
    write(&x.gained, a.gained_out, 1), write(&x.surplus, a.surplus_out, 1), write(&x.peak, a.peak_out, 1);
  }
  void report(int i, int status, bool refused, int hazards) const {
    const Journey<T>& a = *journey;
    const long at = long(step[i]) * a.worlds + world[i];
    a.residual_norm[at] = lane(newton.error, i), a.status[at] = status;
    a.evaluations[at] = int(lane(newton.evaluations, i)), a.iterations[at] = int(lane(newton.iterations, i));
    a.refused[at] = refused, a.hazards[at] = hazards;
  }
};

}  // namespace pbfd
