// Torsional friction of a candidate with a radius: the torque τ = −ℓμ N s(|y|) y n, y = ϕ·n the turn about the normal over the step
// (terms/torsional_friction.py). In a plane nothing turns about a normal.
//
// By (ω, w), as in touching.h: δy = n·δϕ + ϕ·B w.
#pragma once
#include "touching.h"

namespace pbfd {

// `pressed`: N where the friction is lagged.
template <bool FLAT, class V> [[gnu::noinline]] void resist_spin(const Touching<V, 3>& t, V pressed, Push<V, 3>& out) {
  const V *n = t.solid.normal, half(0.5);
  V push, rises, factor, falls, turns[3], shifts[9];
  normal_force(t.law, t.firmness, t.depth, t.start, t.per_range, push, rises);
  t.relaxed->felt(pressed, push, rises);
  const V y = dot(t.turn, n);
  slip_law(abs(y), t.law->per_turn, factor, falls);
  const V limit = t.law->patch * push, torque = limit * factor * y;

  out.open();
  // as if of forces on material points, with the moment −½[τ]×; a torque answers ½[τ]× less
  const V turned[9] = {V(0), -n[2], n[1], n[2], V(0), -n[0], -n[1], n[0], V(0)}, moment = half * torque;
  for (int a = 0; a < 9; a++) out.moment[a] = fma(moment, turned[a], out.moment[a]);
  if constexpr (derived<V>) return;
  const V fades = t.law->patch * rises * factor * y;
  const V stiffens = limit * fma(falls * y, y, factor);

  transposed_times(t.rolling, n, turns);
  for (int b = 0; b < 3; b++) {  // w
    V grows = -(fades * n[b]), tilted(0);
    if constexpr (!FLAT) {
      for (int j = 0; j < 3; j++) tilted = fma(t.turn[j], t.bend[3 * j + b], tilted);
      grows = fma(stiffens, tilted, t.solid.steepness * grows);
    }
    for (int a = 0; a < 3; a++) shifts[3 * a + b] = FLAT ? n[a] * grows : fma(torque, t.bend[3 * a + b], n[a] * grows);
  }

  for (int a = 0; a < 3; a++) {
    V *row = out.stiffness + 6 * a, beside[3];
    lever<3>(t.center, shifts + 3 * a, beside);
    for (int b = 0; b < 3; b++) {
      row[b] += fma(n[a] * stiffens, turns[b], fma(moment, turned[3 * a + b], beside[b]));
      row[3 + b] += shifts[3 * a + b];
    }
  }
}

}  // namespace pbfd
