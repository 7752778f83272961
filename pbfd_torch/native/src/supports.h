// What bodies touch with: the arm s from a candidate's centre to the point that touches, p = c + s, and the reach h of the body
// towards the solid (terms/touching.py, terms/supported.py). How they answer goes by the turn ω of the body and the velocity w of the
// centre, by which the normal turns like B w.
//   `rolls`: the slip knows of the body's rotation.   `wanders`: what touches moves over the body as it turns.
#pragma once
#include "candidates.h"

namespace pbfd {

// ∂s/∂ω, ∂s/∂w [9] and ∂h/∂ω, ∂h/∂w [3]; those by ω where it wanders, those by w where the solid is not flat.
template <class V> struct Arm {
  V s[3], reach, by_turn[9], by_shift[9], reach_by_turn[3], reach_by_shift[3];
};

// A point, with a margin perhaps.
struct Point {
  static constexpr bool rolls = false, wanders = false;
  template <class V, class N> static V reach(const Candidates<N>&, int, const V*, const V*) { return V(0); }
  template <bool FLAT, class V, class N>
  static void arm(const Candidates<N>&, int, const V*, const V*, const V*, Arm<V>& out) {
    out.s[0] = out.s[1] = out.s[2] = V(0);
  }
};

// A ball around the centre: s = −ρ n.
struct Ball {
  static constexpr bool rolls = true, wanders = false;
  template <class V, class N> static V reach(const Candidates<N>& c, int i, const V*, const V*) { return V(c.radius[i]); }
  template <bool FLAT, class V, class N>
  static void arm(const Candidates<N>& c, int i, const V*, const V* n, const V* bend, Arm<V>& out) {
    const V back = V(-c.radius[i]);
    for (int j = 0; j < 3; j++) out.s[j] = back * n[j];
    if constexpr (!FLAT)
      for (int j = 0; j < 9; j++) out.by_shift[j] = back * bend[j];
  }
};

}  // namespace pbfd
