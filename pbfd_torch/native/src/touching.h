// The force of a candidate that touches, and how it answers (terms/touching.py): N n − G u at p = c + s, where u = (1 − nnᵀ) m is what
// it slips over the step, m = c − c₀ + ϕ × s + a (METHOD §4), ϕ the rotation since its start and a what an anchor is behind by.
//
// What moves is told by (ω, w), w the velocity of the centre: n answers with B w, s and h as supports.h says, the depth with
// −δd = ‖∇φ‖ n·w − δh.
#pragma once
#include "laws.h"
#include "loads.h"
#include "supports.h"
#include "surfaces.h"

namespace pbfd {

template <class V, int D> struct Touching {
  V center[D], moved[D];  // c, c − c₀ + a
  Beside<V, D> solid;
  V bend[D * D];
  Arm<V, D> arm;
  V depth, start;          // at the end of the step and at its beginning
  V firmness, grip, per_range, per_width;  // C⊥, μ; 1 / (release speed × Δt) and 1/ε
  V holding;                               // what friction feels where it is lagged, see `Law`
  const Law<V>* law;                       // null: the usual one
  const Relaxed<V>* relaxed;
  const V *turn, *rolling;  // ϕ, and how it answers ω; null where nothing rolls

  // m
  template <class Support> void travel(V* out) const {
    for (int j = 0; j < D; j++) out[j] = moved[j];
    if constexpr (Support::rolls) add_swing<D>(turn, arm.s, out);
  }
  // u
  template <class Support> void slip(V* out) const {
    travel<Support>(out);
    const V lifted = dot<D>(out, solid.normal);
    for (int j = 0; j < D; j++) out[j] = fma(-lifted, solid.normal[j], out[j]);
  }
};

// m and its part along n, u, p and f; N and ∂N/∂d; and what holds it, which is in N already.
template <class V, int D> struct Force {
  V m[D], lifted, u[D], p[D], f[D], push, rises;
  Grasp<V> grasp;
};

template <class Support, class V, int D> inline void force(const Touching<V, D>& t, Force<V, D>& out) {
  const V *n = t.solid.normal, *s = t.arm.s, *c = t.center;
  t.template travel<Support>(out.m);
  out.lifted = dot<D>(out.m, n);
  for (int j = 0; j < D; j++) out.u[j] = fma(-out.lifted, n[j], out.m[j]), out.p[j] = Support::rolls ? c[j] + s[j] : c[j];
  normal_force(t.law, t.firmness, t.depth, t.start, t.per_range, out.push, out.rises);
  friction(t.law, *t.relaxed, t.grip, t.per_width, t.holding, out.push, out.rises, t.depth, sqrt(dot<D>(out.u, out.u)), out.grasp);
  out.push += out.grasp.lift, out.rises += out.grasp.lift_by_depth;
  for (int j = 0; j < D; j++) out.f[j] = fma(out.push, n[j], -(out.grasp.drag * out.u[j]));
}

// How the force answers. `FLAT`: the normal does not turn, and the depth is the distance itself.
template <bool FLAT, class Support, class V, int D>
[[gnu::always_inline]] inline void stiffen(const Touching<V, D>& t, const Force<V, D>& at, Push<V, D>& out) {
  constexpr int T = turns(D), S = T + D;
  const V zero(0), *n = t.solid.normal, *s = t.arm.s, *c = t.center;
  const V *m = at.m, *u = at.u, *p = at.p, *f = at.f, lifted = at.lifted, push = at.push, rises = at.rises, drag = at.grasp.drag;
  const V by_depth = at.grasp.by_depth, by_size = at.grasp.by_size, lifts = at.grasp.lift_by_size;

  // answers: −δf of a motion that makes the slip grow by `slips` and the depth fall by `sinks`, but for what the normal's turn does
  auto answer = [&](const V* slips, V sinks, V* a) {
    const V grows = dot<D>(u, slips);
    const V resists = fma(by_size, grows, -(by_depth * sinks)), presses = fma(-lifts, grows, rises * sinks);
    for (int j = 0; j < D; j++) a[j] = fma(n[j], presses, fma(drag, slips[j], u[j] * resists));
  };
  V by_turn[S * T], by_shift[S * D];  // of the torque about the world's origin and of the force
  auto wrench = [&](int b, int columns, const V* a, const V* wandered, V* out) {
    V torque[T], pulled[T];
    lever<D>(p, a, torque);
    if (wandered) lever<D>(f, wandered, pulled);
    for (int j = 0; j < T; j++) out[columns * j + b] = wandered ? torque[j] + pulled[j] : torque[j];
    for (int j = 0; j < D; j++) out[columns * (T + j) + b] = a[j];
  };
  for (int b = 0; b < D; b++) {  // w
    V slips[D], a[D], sinks = n[b];
    if constexpr (FLAT) {
      for (int j = 0; j < D; j++) slips[j] = fma(-n[b], n[j], V(j == b));
      answer(slips, sinks, a);
      wrench(b, D, a, nullptr, by_shift);
    } else {
      V tilt[D], shifted[D], move[D];
      sinks = t.solid.steepness * sinks;
      for (int j = 0; j < D; j++) tilt[j] = t.bend[D * j + b], shifted[j] = t.arm.by_shift[D * j + b], move[j] = V(j == b);
      add_swing<D>(t.turn, shifted, move);
      if constexpr (Support::wanders) sinks = sinks - t.arm.reach_by_shift[b];
      const V along = dot<D>(n, move) + dot<D>(m, tilt);
      for (int j = 0; j < D; j++) slips[j] = fma(-along, n[j], fma(-lifted, tilt[j], move[j]));
      answer(slips, sinks, a);
      for (int j = 0; j < D; j++) a[j] = fma(-push, tilt[j], a[j]);
      wrench(b, D, a, shifted, by_shift);
    }
  }
  if constexpr (Support::rolls) {
    V carried[D * T];  // a material point at p would move by ω × s
    arms<D>(s, carried);
    for (int b = 0; b < T; b++) {  // ω
      V column[T], slips[D], a[D], wandered[D], tilt[D], sinks = zero;
      for (int j = 0; j < T; j++) column[j] = t.rolling[T * j + b];
      for (int j = 0; j < D; j++) wandered[j] = -carried[T * j + b];
      swing<D>(column, s, slips);
      if constexpr (Support::wanders) {
        V shifted[D];
        for (int j = 0; j < D; j++) shifted[j] = t.arm.by_turn[T * j + b], wandered[j] += shifted[j];
        add_swing<D>(t.turn, shifted, slips);
        sinks = -t.arm.reach_by_turn[b];
      }
      V along = dot<D>(n, slips);
      if constexpr (Support::leans) {
        for (int j = 0; j < D; j++) tilt[j] = t.arm.tilt[T * j + b];
        along += dot<D>(m, tilt);
      }
      for (int j = 0; j < D; j++) slips[j] = fma(-along, n[j], Support::leans ? fma(-lifted, tilt[j], slips[j]) : slips[j]);
      answer(slips, sinks, a);
      if constexpr (Support::leans)
        for (int j = 0; j < D; j++) a[j] = fma(-push, tilt[j], a[j]);
      wrench(b, T, a, wandered, by_turn);
    }
  }

  for (int j = 0; j < S; j++) {  // w = v + ω × c
    V *row = out.stiffness + S * j, turned[T];
    const V* shift = by_shift + D * j;
    lever<D>(c, shift, turned);
    for (int b = 0; b < T; b++) row[b] += turned[b];
    for (int b = 0; b < D; b++) row[T + b] += shift[b];
    if constexpr (Support::rolls)
      for (int b = 0; b < T; b++) row[b] += by_turn[T * j + b];
  }
}

template <bool FLAT, class Support, class V, int D> [[gnu::noinline]] void press(const Touching<V, D>& t, Push<V, D>& out) {
  Force<V, D> at;
  force<Support>(t, at);
  out.open();
  for (int j = 0; j < D; j++) {
    out.force[j] -= at.f[j];
    for (int b = 0; b < D; b++) out.moment[D * j + b] = fma(-at.f[j], at.p[b], out.moment[D * j + b]);
  }
  if constexpr (!derived<V>) stiffen<FLAT, Support>(t, at, out);
}

}  // namespace pbfd
