// What bodies touch with: the arm s from a candidate's centre to the point that touches, p = c + s, and the reach h of the body
// towards the solid (terms/touching.py, terms/supported.py). How they answer goes by the turn ω of the body and the velocity w of the
// centre, by which the normal turns like B w.
//   `rolls`: the slip knows of the body's rotation.   `wanders`: what touches moves over the body as it turns.
#pragma once
#include "candidates.h"

namespace pbfd {

// ∂s/∂ω, ∂s/∂w and ∂h/∂ω, ∂h/∂w; those by ω where it wanders, those by w where the solid is not flat.
template <class V, int D> struct Arm {
  static constexpr int T = turns(D);
  V s[D], reach, by_turn[D * T], by_shift[D * D], reach_by_turn[T], reach_by_shift[D];
};

// A point, with a margin perhaps.
struct Point {
  static constexpr bool rolls = false, wanders = false;
  template <class V, class N, int D> static V reach(const Candidates<N, D>&, int, const V*, const V*) { return V(0); }
  template <bool FLAT, class V, class N, int D>
  static void arm(const Candidates<N, D>&, int, const V*, const V*, const V*, Arm<V, D>& out) {
    for (int j = 0; j < D; j++) out.s[j] = V(0);
  }
};

// A ball around the centre: s = −ρ n.
struct Ball {
  static constexpr bool rolls = true, wanders = false;
  template <class V, class N, int D> static V reach(const Candidates<N, D>& c, int i, const V*, const V*) { return V(c.radius[i]); }
  template <bool FLAT, class V, class N, int D>
  static void arm(const Candidates<N, D>& c, int i, const V*, const V* n, const V* bend, Arm<V, D>& out) {
    const V back = V(-c.radius[i]);
    for (int j = 0; j < D; j++) out.s[j] = back * n[j];
    if constexpr (!FLAT)
      for (int j = 0; j < D * D; j++) out.by_shift[j] = back * bend[j];
  }
};

}  // namespace pbfd
