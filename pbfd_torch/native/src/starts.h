// States at t = 0, of second order in the step: stiff forces are felt as they are going to be, at the end of a trial step of
// implicit Euler. As `trial` in stepping/eager.py and `start` in integrators/*.py.
#pragma once
#include "machine.h"

namespace pbfd {

template <class V, class N, int D, class Scheme> struct Starts {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr int W = Kind<V>::lanes;

  const Plan<N, D>& plan;
  Numbers<V>& own;  // of the worlds in the lanes
  Machine<V, N, D, ImplicitEuler<V, N, D>> machine;
  Balance<V, N, D>& balance;
  Momenta<V, N, D> momenta;
  Positions<V> before;  // what the trial sets out from
  typename Scheme::State begun;
  V *v, *end;                  // at t = 0; of the trial
  V *force, *acceleration;     // M a, and a, at t = 0 with the forces of the trial's end
  V *rough, *smooth, *sum, *spare, *drift, *room_to_begin;

  static int room(Sizes s) {
    return Machine<V, N, D, ImplicitEuler<V, N, D>>::room(s) + Momenta<V, N, D>::room(s) + room_for<Positions<V>>(s) +
           room_for<typename Scheme::State>(s) + s.nq + 7 * s.nv + 24 * s.nodes;
  }
  Starts(const Plan<N, D>& scene, Numbers<V>& numbers, Arena<V>& arena)
      : plan(scene), own(numbers), machine(scene, own, arena), balance(machine.newton.balance), momenta(scene, arena) {
    before = taken<Positions<V>>(arena, plan), begun = taken<typename Scheme::State>(arena, plan);
    end = arena.take(plan.nq), v = arena.take(plan.nv), force = arena.take(plan.nv), acceleration = arena.take(plan.nv);
    rough = arena.take(plan.nv), smooth = arena.take(plan.nv), sum = arena.take(plan.nv), spare = arena.take(plan.nv);
    drift = arena.take(6 * plan.nodes), room_to_begin = arena.take(18 * plan.nodes);
  }

  // Worlds first … last − 1, with these speeds [worlds, nv]. trial: their step; `others` is what it is given but q, and is filled
  // here.
  void run(const Journey<T>& trial, const Rules& rules, void* const* others, const T* speeds, void* const* found, int first,
           int last) {
    const T* q = static_cast<const T*>(trial.given[0]);
    T* back = static_cast<T*>(others[0]);
    V dt(0);
    for (int i = 0; i < plan.nv; i++) before.acceleration[i] = V(0);
    for (int i = 0; i < plan.remembered(); i++) before.behind[i] = begun.behind[i] = V(T(i < 3 * plan.anchors ? 0 : -1));
    each_block(first, last, [&] {
      take(q, plan.nq, before.q), take(speeds, plan.nv, v);
      for (int i = 0; i < W; i++) put(dt, i, trial.step(world(i)));
      retract(plan, before.q, v, -dt, before.q_previous);
      give(before.q_previous, plan.nq, back), give(before.acceleration, plan.nv, static_cast<T*>(others[1]));
      give(before.behind, plan.remembered(), static_cast<T*>(others[2]));
    });
    machine.run(trial, rules, first, last);
    balance.relaxed.none(), balance.recall(before.behind);
    each_block(first, last, [&] {
      for (int i = 0; i < W; i++) put(balance.dt, i, trial.step(world(i)));
      take(q, plan.nq, before.q), take(speeds, plan.nv, v), take(back, plan.nq, before.q_previous);
      for (int i = 0; plan.moving > 0 && i < W; i++)
        balance.carriers.load(i, trial.timetable.at(0, world(i)), trial.timetable.at(1 << rules.halvings, world(i)));
      take(static_cast<const T*>(trial.found[0]), plan.nq, end), take(trial.control, plan.nu, balance.control);
      M solved;
      for (int i = 0; i < W; i++) put(solved, i, trial.status[world(i)] <= HALVED);
      feel(solved), complete(solved, begun);
      int k = 0;
      Scheme::State::each(plan, [&](auto member, int width) { give(begun.*member, width, static_cast<T*>(found[k++])); });
    });
  }

 private:
  int block, beyond;  // its first world, and the one after the last of all

  template <class F> void each_block(int first, int last, F&& visit) {
    for (block = first, beyond = last; block < last; block += W) {
      for (int i = 0; own.varied && i < W; i++) own.load(i, int(world(i)));
      visit();
    }
  }
  // Lanes that nobody needs compute too, with the numbers of some world.
  long world(int i) const { return block + i < beyond ? block + i : beyond - 1; }
  void take(const T* array, int width, V* out) const {
    for (int i = 0; i < W; i++)
      for (int j = 0; j < width; j++) put(out[j], i, array[world(i) * width + j]);
  }
  void give(const V* x, int width, T* array) const {
    for (int i = 0; i < W && block + i < beyond; i++)
      for (int j = 0; j < width; j++) array[world(i) * width + j] = lane(x[j], i);
  }

  // M⁻¹ (f − h) at t = 0, with the forces f of the trial's end but for those of an impact; zero where it is unsolved.
  void feel(M solved) {
    Balance<V, N, D>& b = balance;
    V *abrupt = rough, *others = smooth, *by_abrupt = spare, *by_others = acceleration;
    b.share = V(1);
    for (int i = 0; i < plan.nv; i++) b.fitted[i] = V(1);
    machine.scheme.begin(b, before, machine.guess, M(false));
    b.begin();
    place(plan, end, b.now, b.axes);
    forces_by_onset(b, end, abrupt, others, spare);
    bias(sum);
    for (int i = 0; i < plan.nv; i++) others[i] = others[i] - sum[i], by_abrupt[i] = abrupt[i], by_others[i] = others[i];
    factor(tree(plan), momenta.matrix);
    substitute(tree(plan), momenta.matrix, by_abrupt), substitute(tree(plan), momenta.matrix, by_others);
    // an impact within the step has given nothing before it; what holds the others back has, however hard they press
    for (int i = 0; i < plan.nv; i++) sum[i] = b.dt * by_abrupt[i];
    M steady = calm(plan, rates(sum), b.dt);
    for (int i = 0; i < plan.nv; i++) sum[i] = b.dt * by_others[i];
    const V alone = kinetic_energy(plan, rates(sum));
    for (int i = 0; i < plan.nv; i++) sum[i] = b.dt * (by_others[i] + by_abrupt[i]);
    steady = steady | (kinetic_energy(plan, rates(sum)) <= alone);
    for (int i = 0; i < plan.nv; i++) {
      force[i] = select(solved, others[i] + select(steady, abrupt[i], V(0)), V(0));
      acceleration[i] = select(solved, by_others[i] + select(steady, by_abrupt[i], V(0)), V(0));
    }
  }

  // Coriolis, centrifugal and gravity forces h, and M, where the bodies start.
  void bias(V* out) {
    const Poses<V> at = balance.start;
    const V* axes = balance.start_axes;
    twists(plan, axes, v, momenta.twist), drifts(plan, axes, momenta.twist, v, drift);
    for (int k = 0; k < plan.nodes; k++) {
      V changes[D * D + D];
      pose_acceleration<D>(k, at, momenta.twist, drift, changes);
      for (int i = 0; i < D; i++) changes[D * D + i] = changes[D * D + i] - V(plan.gravity[i]);
      momenta.take(k, at, changes);
    }
    for (int i = 0; i < plan.nv; i++) out[i] = V(0);
    momenta.add_to(out, axes), momenta.masses(axes);
  }

  // How fast the poses change at t = 0 that move like this.
  const V* rates(const V* motion) {
    pose_rates(plan, balance.start, balance.start_axes, motion, momenta.twist, momenta.rates);
    return momenta.rates;
  }

  // θ_{−1} = θ_0 − Δt v + ½ Δt² a.
  void complete(M, Positions<V>& out) {
    const V dt = balance.dt;
    for (int i = 0; i < plan.nv; i++)
      out.acceleration[i] = acceleration[i], sum[i] = fma(V(0.5) * dt * dt, acceleration[i], -(dt * v[i]));
    for (int i = 0; i < plan.nq; i++) out.q[i] = before.q[i];
    retract(plan, before.q, sum, V(1), out.q_previous);
  }

  // A past of constant acceleration; how hard things pushed is not known.
  void complete(M, FourPoses<V>& out) {
    using BDF2 = Bdf2<V, N, D>;
    const Poses<V> at = balance.start;
    const V dt = balance.dt, *gained = rates(acceleration);
    V* curved = room_to_begin;
    for (int i = 0; i < 12 * plan.nodes; i++) curved[i] = gained[i];
    twists(plan, balance.start_axes, v, momenta.twist), drifts(plan, balance.start_axes, momenta.twist, v, drift);
    for (int k = 0; k < plan.nodes; k++) {
      V bent[12];
      pose_acceleration<D>(k, at, momenta.twist, drift, bent);
      for (int i = 0; i < 12; i++) curved[12 * k + i] += bent[i];
    }
    const V* speed = rates(v);
    for (int i = 0; i < plan.nq; i++) out.q[i] = before.q[i];
    for (int k = 0; k < plan.nodes; k++)
      for (int i = 0; i < 12; i++)
        BDF2::remember(plan, M(true), k, i, BDF2::entry(at, k, i), speed[12 * k + i], curved[12 * k + i], dt, out);
    for (int i = 0; i < plan.nv; i++) BDF2::remember(plan, M(true), i, v[i], acceleration[i], dt, out);
    out.push[0] = infinite<V>() - infinite<V>();
  }

  // With what rough forces give in the trial, unless that is an impact, and with what smooth ones are late by.
  void complete(M solved, Velocities<V>& out) {
    Balance<V, N, D>& b = balance;
    b.share = V(0.5);
    for (int i = 0; i < W; i++) fit(plan, i, lane(b.dt, i), b.fitted);
    begin_energy_momentum(b, before.q, v, room_to_begin);
    b.begin(), b.press();
    forces_by_share(b, end, rough, smooth, spare);
    for (int i = 0; i < plan.nv; i++) out.push[i] = b.dt * rough[i], sum[i] = b.dt * acceleration[i];
    substitute(tree(plan), momenta.matrix, out.push);
    M known(true);  // what is driven by no number is not driven by the least one
    for (int i = 0; i < plan.nu; i++) known = known & (abs(b.control[i]) <= infinite<V>());
    const V unknown = select(known, V(0), infinite<V>() - infinite<V>());
    const M gains = calm(plan, rates(sum), b.dt), pushes = solved & calm(plan, rates(out.push), b.dt);
    for (int i = 0; i < plan.nv; i++) {
      const V ahead = fma(V(2), b.fitted[i], V(-1)), other = fma(b.dt, force[i] - smooth[i], unknown);
      out.lag[i] = select(gains, -ahead * other, V(0)), out.push[i] = select(pushes, out.push[i], V(0));
    }
    substitute(tree(plan), momenta.matrix, out.lag);
    for (int i = 0; i < plan.nq; i++) out.q[i] = before.q[i];
    for (int i = 0; i < plan.nv; i++) {
      out.v[i] = fma(V(-0.5), out.push[i] + out.lag[i], v[i]);
      out.steady[i] = out.push[i], out.average[i] = v[i];
    }
    out.gained[0] = out.surplus[0] = out.peak[0] = V(0);
  }
};

}  // namespace pbfd
