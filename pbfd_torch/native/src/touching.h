// The force of a candidate that touches, and how it answers (terms/touching.py): N n − G u at p = c + s, where u = (1 − nnᵀ) m is what
// it slips over the step, m = c − c₀ + ϕ × s (METHOD §4), ϕ the rotation since its start.
//
// What moves is told by (ω, w), w the velocity of the centre: n answers with B w, s and h as supports.h says, the depth with
// −δd = ‖∇φ‖ n·w − δh.
#pragma once
#include "friction.h"
#include "loads.h"
#include "release.h"
#include "supports.h"
#include "surfaces.h"

namespace pbfd {

template <class V> struct Touching {
  V center[3], moved[3];  // c, c − c₀
  Beside<V> solid;
  V bend[9];
  Arm<V> arm;
  V depth, start;          // at the end of the step and at its beginning
  V firmness, grip, range, width;  // C⊥, μ; release speed and slip speed × Δt
  const V *turn, *rolling;  // ϕ [3], and how it answers ω [9]; null where nothing rolls

  // m [3]
  template <class Support> void travel(V* out) const {
    for (int j = 0; j < 3; j++) out[j] = moved[j];
    if constexpr (Support::rolls) add_cross(turn, arm.s, out);
  }
};

// `FLAT`: the normal does not turn, and the depth is the distance itself.
template <bool FLAT, class Support, class V> [[gnu::noinline]] void press(const Touching<V>& t, Push<V>& out) {
  const V zero(0), *n = t.solid.normal, *s = t.arm.s, *c = t.center;
  V m[3], u[3], p[3], f[3];
  t.template travel<Support>(m);
  const V lifted = dot(m, n);
  for (int j = 0; j < 3; j++) u[j] = fma(-lifted, n[j], m[j]), p[j] = Support::rolls ? c[j] + s[j] : c[j];
  V push, rises, factor, falls;
  releasing(t.firmness, t.depth, t.start, t.range, push, rises);
  slip_factor(sqrt(dot(u, u)), t.width, factor, falls);
  const V drag = t.grip * push * factor, by_depth = t.grip * rises * factor, by_size = t.grip * push * falls;
  for (int j = 0; j < 3; j++) f[j] = fma(push, n[j], -(drag * u[j]));

  // answers: −δf [3] of a motion that makes the slip grow by `slips` and the depth fall by `sinks`, but for what the normal's turn does
  auto answer = [&](const V* slips, V sinks, V* a) {
    const V resists = fma(by_size, dot(u, slips), -(by_depth * sinks)), presses = rises * sinks;
    for (int j = 0; j < 3; j++) a[j] = fma(n[j], presses, fma(drag, slips[j], u[j] * resists));
  };
  V by_turn[18], by_shift[18];  // of the torque about the world's origin and of the force, each [3 × 3]
  auto wrench = [&](int b, const V* a, const V* wandered, V* column) {
    V torque[3];
    cross(p, a, torque);
    if (wandered) add_cross(f, wandered, torque);
    for (int j = 0; j < 3; j++) column[3 * j + b] = torque[j], column[9 + 3 * j + b] = a[j];
  };
  for (int b = 0; b < 3; b++) {  // w
    V slips[3], a[3], sinks = n[b];
    if constexpr (FLAT) {
      for (int j = 0; j < 3; j++) slips[j] = fma(-n[b], n[j], V(j == b));
      answer(slips, sinks, a);
      wrench(b, a, nullptr, by_shift);
    } else {
      V tilt[3], shifted[3], move[3];
      sinks = t.solid.steepness * sinks;
      for (int j = 0; j < 3; j++) tilt[j] = t.bend[3 * j + b], shifted[j] = t.arm.by_shift[3 * j + b], move[j] = V(j == b);
      add_cross(t.turn, shifted, move);
      if constexpr (Support::wanders) sinks = sinks - t.arm.reach_by_shift[b];
      const V along = dot(n, move) + dot(m, tilt);
      for (int j = 0; j < 3; j++) slips[j] = fma(-along, n[j], fma(-lifted, tilt[j], move[j]));
      answer(slips, sinks, a);
      for (int j = 0; j < 3; j++) a[j] = fma(-push, tilt[j], a[j]);
      wrench(b, a, shifted, by_shift);
    }
  }
  if constexpr (Support::rolls) {
    const V beside[9] = {zero, -s[2], s[1], s[2], zero, -s[0], -s[1], s[0], zero};  // a material point at p would move by ω × s
    for (int b = 0; b < 3; b++) {  // ω
      const V column[3] = {t.rolling[b], t.rolling[3 + b], t.rolling[6 + b]};
      V slips[3], a[3], wandered[3] = {beside[b], beside[3 + b], beside[6 + b]}, sinks = zero;
      cross(column, s, slips);
      if constexpr (Support::wanders) {
        V shifted[3];
        for (int j = 0; j < 3; j++) shifted[j] = t.arm.by_turn[3 * j + b], wandered[j] += shifted[j];
        add_cross(t.turn, shifted, slips);
        sinks = -t.arm.reach_by_turn[b];
      }
      const V along = dot(n, slips);
      for (int j = 0; j < 3; j++) slips[j] = fma(-along, n[j], slips[j]);
      answer(slips, sinks, a);
      wrench(b, a, wandered, by_turn);
    }
  }

  out.open();
  for (int j = 0; j < 3; j++) {
    out.force[j] -= f[j];
    for (int b = 0; b < 3; b++) out.moment[3 * j + b] = fma(-f[j], p[b], out.moment[3 * j + b]);
  }
  for (int j = 0; j < 6; j++) {  // w = v + ω × c
    V* row = out.stiffness + 6 * j;
    const V* shift = by_shift + 3 * j;
    add_cross(c, shift, row);
    for (int b = 0; b < 3; b++) row[3 + b] += shift[b];
    if constexpr (Support::rolls)
      for (int b = 0; b < 3; b++) row[b] += by_turn[3 * j + b];
  }
}

}  // namespace pbfd
