// The state after an energy–momentum step, and what it has gained beyond the forces' work, as integrators/energy_momentum.py.
#pragma once
#include "runge_kutta.h"
#include "state.h"

namespace pbfd {

constexpr double FLATTEST = 0.3, FARTHEST = 2.0, EXCESS = 1e-2, NOISE = 1e-4, RESERVE = 1e-2;
constexpr double SMOOTH_GAIN = 0.25;  // of what a step gains of velocity: where halving it changes more, something strikes within
constexpr double PATIENCE = 3, FAST = 1.9106729782512120;  // halvings; 2 cos(.3 rad), of the trace of a rotation by so much

// Attributes as of `Velocities` in Python, [nq], [nv] each, three energies, and its memory.
template <class V> struct Velocities {
  V *q, *v, *push, *steady, *lag, *average, *gained, *surplus, *peak, *behind;
  template <class F> static void each(Sizes s, F&& visit) {
    using X = Velocities;
    visit(&X::q, s.nq), visit(&X::v, s.nv), visit(&X::push, s.nv), visit(&X::steady, s.nv), visit(&X::lag, s.nv);
    visit(&X::average, s.nv), visit(&X::gained, 1), visit(&X::surplus, 1), visit(&X::peak, 1);
    visit(&X::behind, s.remembered());
  }
};

template <class V, class N, int D = 3> struct EnergyMomentum {
  using M = typename Kind<V>::Mask;
  using State = Velocities<V>;
  static constexpr int easier = 1;    // inertia at the end of the step, as the paper has it
  static constexpr bool fits = true;  // springs, damping and actuators may be taken at a share of the step
  static constexpr bool extrapolates = true;  // its error has an even expansion in the step
  static constexpr bool leaps = true;  // where nothing touches it may be made without solving anything
  static double share(int eased) { return eased ? 1.0 : 0.5; }

  const Plan<N, D>& plan;
  V surplus_allowed;  // of the largest kinetic energy so far
  Momenta<V, N, D> momenta;
  Leap<V, N, D> leap;
  V *momentum, *impulse, *smooth, *rough, *other, *total, *room_to_begin;

  static int room(Sizes s) { return Momenta<V, N, D>::room(s) + Leap<V, N, D>::room(s) + 18 * s.nodes + 6 * s.nv; }
  EnergyMomentum(const Plan<N, D>& scene, Arena<V>& arena)
      : plan(scene), surplus_allowed(1e-3), momenta(scene, arena), leap(scene, momenta, arena) {
    momentum = arena.take(plan.nv), impulse = arena.take(plan.nv), smooth = arena.take(plan.nv), rough = arena.take(plan.nv);
    other = arena.take(plan.nv), total = arena.take(plan.nv);
    room_to_begin = arena.take(18 * plan.nodes);
  }

  void ask(const Rules& rules) { surplus_allowed = V(typename Kind<V>::Scalar(rules.surplus)); }

  // At t_n.
  void velocity(const State& x, V, V* out) const {
    for (int i = 0; i < plan.nv; i++) out[i] = fma(V(0.5), x.steady[i] + x.lag[i], x.v[i]);
  }

  // How fast poses change at t_n, where the nodes are and the velocity is known.
  void speeds(const State&, Poses<V> now, const V* axes, const V* velocity, V, V* out) {
    pose_rates(plan, now, axes, velocity, momenta.twist, out);
  }

  // What is fixed in the step from a state, and where it may end.
  void begin(Balance<V, N, D>& b, const State& before, V* guess, M) {
    begin_energy_momentum(b, before.q, before.v, room_to_begin);
    retract(plan, before.q, before.average, b.dt, guess);
  }

  // The state of some lanes as steps of another length see it, at the same place with the same velocity.
  void resize(M which, V dt, V other_dt, State& x) const {
    const V share = other_dt / dt;
    for (int i = 0; i < plan.nv; i++) {
      const V steady = share * x.steady[i], lag_ = share * x.lag[i];
      x.v[i] = select(which, x.v[i] + V(0.5) * (x.steady[i] - steady + x.lag[i] - lag_), x.v[i]);
      x.steady[i] = select(which, steady, x.steady[i]), x.lag[i] = select(which, lag_, x.lag[i]);
      x.push[i] = select(which, share * x.push[i], x.push[i]);
    }
  }

  // How often a step had better be halved before it is made easier, if that which ended like this is unsolved or refused.
  V halves(const Balance<V, N, D>& b, Sight<V, N, D>& sight, const State& after, M solved) const {
    M held = sight.pushes(b, b.q_start), fast(false);
    held = held | sight.pushes(b, b.q_target);
    held = held | sight.pushes(b, after.q);  // the last look, which `fast` goes by
    for (int k = 0; k < plan.nodes; k++) {
      V traced(0);
      for (int j = 0; j < D * D; j++)
        traced = fma(sight.there.rotation[D * D * k + j], b.start.rotation[D * D * k + j], traced);
      fast = fast | ((traced < V(FAST + (D - 2))) & (V(plan.mass[k]) > V(0)));
    }
    const M overdrawn = (after.surplus[0] > surplus_allowed * after.peak[0]) & (after.gained[0] > V(NOISE) * after.peak[0]);
    return select(solved & overdrawn & fast, V(PATIENCE), select(held, V(0), V(1)));
  }

  // From the state before to that after a step that ended at q, where `b` has been evaluated; which lanes refuse it. Where inertia
  // works at the end of the step, the state after it has the step's average velocity, and what the forces that are not early give.
  M advance(Balance<V, N, D>& b, const V* q, const State& before, State& after, M eased) {
    const int n = plan.nv;
    const V h = b.dt, per = V(1) / h, zero(0), half(0.5);
    const M on_chord = !eased;
    forces_by_share(b, q, rough, smooth, other);
    difference(plan, b.q_start, q, after.average);
    for (int i = 0; i < n; i++) after.average[i] = per * after.average[i];

    // what V_n and V_{n+1} = 2 ΔT/Δt − V_n are on the joints' motions; at the end of the step, ΔT/Δt and half its fall
    const V twice = select(on_chord, V(2), V(1)), less = select(on_chord, V(-1), zero), fall = select(on_chord, zero, half * h);
    V* rates = momenta.rates;
    pose_rates(plan, b.start, b.start_axes, before.v, momenta.twist, rates);
    for (int k = 0; k < plan.nodes; k++) {
      const V* rate = rates + (D * D + D) * k;
      V next[D * D + D];
      for (int i = 0; i < D * D; i++)
        next[i] = fma(twice * per, b.now.rotation[D * D * k + i] - b.start.rotation[D * D * k + i], less * rate[i]);
      for (int i = 0; i < D; i++) {
        const V kept = fma(less, rate[D * D + i], fall * V(plan.gravity[i]));
        next[D * D + i] = fma(twice * per, b.now.position[D * k + i] - b.start.position[D * k + i], kept);
      }
      momenta.take(k, b.now, next);
    }
    for (int i = 0; i < n; i++) {
      impulse[i] = h * rough[i];
      momentum[i] = V(plan.armature[i]) * fma(twice, after.average[i], less * before.v[i]);
    }
    momenta.add_to(momentum, b.axes);
    for (int i = 0; i < n; i++) {
      const V ahead = early(b, i);
      momentum[i] += h * select(on_chord, -fma(ahead, smooth[i], rough[i]), half * (V(1) - ahead) * smooth[i]);
    }

    V* matrix = momenta.matrix;
    momenta.masses(b.axes);
    for (int i = 0; i < n; i++) {
      V row(0);
      for (int j = 0; j < n; j++) row = fma(matrix[i * n + j], before.v[j], row);
      other[i] = momentum[i] - row - h * smooth[i];
      after.v[i] = momentum[i], after.push[i] = impulse[i];
    }
    factor(tree(plan), matrix);
    substitute(tree(plan), matrix, after.v), substitute(tree(plan), matrix, after.push);
    V kept(0), whole(0);
    for (int i = 0; i < n; i++) kept = fma(impulse[i], before.push[i], kept), whole = fma(impulse[i], after.push[i], whole);
    const V share = clamped(kept / select(whole > zero, whole, V(1)), zero, V(1));
    for (int i = 0; i < n; i++) {
      after.lag[i] = -early(b, i) * (other[i] - (V(1) - share) * impulse[i]);
      after.steady[i] = share * after.push[i];
    }
    substitute(tree(plan), matrix, after.lag);

    return account(b, before, after, on_chord);
  }

  M pushed(const State& x) const {
    M found(false);
    for (int i = 0; i < plan.nv; i++) found = found | (abs(x.push[i]) > V(0));
    return found;
  }
  V speed(const State& x, int i) const { return fma(V(0.5), x.steady[i] + x.lag[i], x.v[i]); }

  // (4 x(Δt/2) − x(Δt))/3 of lanes at the end of two halves, and 2 x(Δt/2) − x(Δt) where something has pressed and halving changes
  // little of what the step from `base` gains: of configurations and momenta, so that what is kept of these is kept. coarse,
  // coarse_speed: of the whole step; at, axes: room.
  void extrapolate(M which, M pressed, const V* coarse, const V* coarse_speed, const State& base, State& x, Poses<V> at, V* axes) {
    if (!any(which)) return;
    const V share = select(pressed, V(1), V(1.0 / 3));
    for (int i = 0; i < plan.nv; i++) {
      total[i] = speed(x, i);
      impulse[i] = total[i] - coarse_speed[i], rough[i] = total[i] - speed(base, i);
    }
    place(plan, coarse, at, axes), carry(coarse_speed, at, axes, other);
    place(plan, x.q, at, axes), carry(total, at, axes, momentum);
    const M steadily = momenta.kinetic(at, axes, impulse) <= V(SMOOTH_GAIN * SMOOTH_GAIN) * momenta.kinetic(at, axes, rough);
    which = which & (steadily | !pressed);
    carry(x.push, at, axes, impulse), carry(x.steady, at, axes, rough), carry(x.lag, at, axes, smooth);
    for (int i = 0; i < plan.nv; i++) momentum[i] = fma(share, momentum[i] - other[i], momentum[i]);
    difference(plan, coarse, x.q, other), retract(plan, x.q, other, share, room_to_begin);
    place(plan, room_to_begin, at, axes), carry(total, at, axes, other), momenta.masses(axes);
    factor(tree(plan), momenta.matrix);
    for (V* p : {momentum, impulse, rough, smooth}) substitute(tree(plan), momenta.matrix, p);
    for (int i = 0; i < plan.nv; i++) {
      x.push[i] = select(which, impulse[i], x.push[i]), x.steady[i] = select(which, rough[i], x.steady[i]);
      x.lag[i] = select(which, smooth[i], x.lag[i]);
      x.v[i] = select(which, fma(V(-0.5), x.steady[i] + x.lag[i], momentum[i]), x.v[i]);
    }
    for (int i = 0; i < plan.nq; i++) x.q[i] = select(which, room_to_begin[i], x.q[i]);
  }

  // The state of lanes after an explicit step.
  void land(M which, V dt, const State& before, State& after) {
    difference(plan, before.q, leap.q, other);
    for (int i = 0; i < plan.nv; i++) {
      after.v[i] = select(which, leap.v[i], after.v[i]), after.lag[i] = select(which, leap.lag[i], after.lag[i]);
      after.push[i] = select(which, V(0), after.push[i]), after.steady[i] = select(which, V(0), after.steady[i]);
      after.average[i] = select(which, other[i] / dt, after.average[i]);
    }
    after.gained[0] = select(which, V(0), after.gained[0]), after.surplus[0] = select(which, before.surplus[0], after.surplus[0]);
    after.peak[0] = select(which, before.peak[0], after.peak[0]);
  }

 private:
  // The momenta of bodies and rotors that move with v.
  void carry(const V* v, Poses<V> at, const V* axes, V* out) {
    pose_rates(plan, at, axes, v, momenta.twist, momenta.rates);
    for (int k = 0; k < plan.nodes; k++) momenta.take(k, at, momenta.rates + (D * D + D) * k);
    for (int i = 0; i < plan.nv; i++) out[i] = V(plan.armature[i]) * v[i];
    momenta.add_to(out, axes);
  }

  // What the step has gained beyond the forces' work, into the state after it; which lanes refuse it. It has no derivatives.
  M account(const Balance<V, N, D>& b, const State& before, State& after, M on_chord) {
    if constexpr (derived<V>) {
      after.gained[0] = after.surplus[0] = after.peak[0] = V(0);
      return M(false);
    }
    const int n = plan.nv;
    const V h = b.dt, half(0.5);
    for (int i = 0; i < n; i++) total[i] = fma(half, before.steady[i], before.v[i]);
    const V first = momenta.kinetic(b.start, b.start_axes, total);
    for (int i = 0; i < n; i++) total[i] = fma(half, after.steady[i], after.v[i]);
    const V last = momenta.kinetic(b.now, b.axes, total);
    V work(0), spurious(0), turned(0);
    for (int i = 0; i < n; i++) {
      work = fma(h * (rough[i] + smooth[i]), after.average[i], work);
      spurious = fma(h * b.residual[i], after.average[i], spurious);
      turned = max(turned, abs(h * after.average[i]) * V(plan.turns[i]));
    }
    V lost(0), flattest(1);
    for (int k = 0; k < plan.nodes; k++) {
      V x[D], x0[D], middle[D * D];
      times<D>(b.now.rotation + D * D * k, plan.center + D * k, x), times<D>(b.start.rotation + D * D * k, plan.center + D * k, x0);
      for (int i = 0; i < D; i++) {
        const V fell = (x[i] + b.now.position[D * k + i]) - (x0[i] + b.start.position[D * k + i]);
        lost = fma(V(plan.mass[k]) * V(plan.gravity[i]), fell, lost);
      }
      for (int i = 0; i < D * D; i++) middle[i] = half * (b.now.rotation[D * D * k + i] + b.start.rotation[D * D * k + i]);
      flattest = min(flattest, determinant<D>(middle));
    }
    const V falls = falling_energy(plan, h), energy = last - first - lost - work;
    const V peak = max(before.peak[0], max(first, last) + falls), sum = max(before.surplus[0] + energy, V(-RESERVE) * peak);
    after.gained[0] = energy, after.peak[0] = peak, after.surplus[0] = sum;
    const V whole_energy = first + last + falls, gained = energy - spurious, surplus = sum - spurious;
    const M excess = (energy > V(EXCESS) * whole_energy) & (gained > V(EXCESS) * whole_energy);
    const M overdrawn = (sum > surplus_allowed * peak) & (energy > V(NOISE) * peak) & (surplus > surplus_allowed * peak) &
                        (gained > V(NOISE) * peak);
    return on_chord & ((flattest < V(FLATTEST)) | (turned > V(FARTHEST)) | excess | overdrawn);
  }

  // The share of smooth forces that comes early.
  V early(const Balance<V, N, D>& b, int i) const { return fma(V(2), b.fitted[i], V(-1)); }
};

}  // namespace pbfd
