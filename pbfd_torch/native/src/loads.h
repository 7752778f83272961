// What acts on the nodes, summed up about the world's origin, and its sums over all that a joint moves.
//
// Forces f at points p make the moment [G | g] = −Σ f [pᵀ | 1] (METHOD §3). How they answer a twist (ω, v) of their node, with the
// axes held still: inertia by second moments, contacts by a matrix [6 × 6].
#pragma once
#include "tree.h"

namespace pbfd {

// ω · (Σ p × f) + v · Σ f of minus the forces: the virtual work along a unit twist s.
template <int D, class V> inline V worked(const V* s, const V* moment, const V* force) {
  V torque[turns(D)];
  curl<D>(moment, torque);
  return dot<turns(D)>(s, torque) + dot<D>(s + turns(D), force);
}

// Inertial loads of a node, about the world's origin.
template <class V, int D = 3> struct Pull {
  static constexpr int T = turns(D);
  V torque[T], force[D];
  V turning[T * T];  // tr(K) 1 − K of K = Σ m p p̃ᵀ
  V first[D];        // Σ m p
  bool any;

  void add(const Pull& o) {
    if (!any) {
      *this = o;
      return;
    }
    for (int i = 0; i < T; i++) torque[i] += o.torque[i];
    for (int i = 0; i < D; i++) force[i] += o.force[i], first[i] += o.first[i];
    for (int i = 0; i < T * T; i++) turning[i] += o.turning[i];
  }
};

// How the wrench of masses, m (p moved by a unit twist s) at points p̃, answers s; `lever`: Σ m p̃.
template <class V, int D> inline void answer(const Pull<V, D>& p, V mass, const V* arm, const V* s, V* out) {
  constexpr int T = turns(D);
  V beside[D];
  times<T>(p.turning, s, out);
  lever<D>(arm, s + T, beside);
  for (int i = 0; i < T; i++) out[i] += beside[i];
  swing<D>(s, p.first, beside);
  for (int i = 0; i < D; i++) out[T + i] = fma(mass, s[T + i], beside[i]);
}

// The same from the other side: what a twist s of the wrench's works on.
template <class V, int D> inline void answer_above(const Pull<V, D>& p, V mass, const V* arm, const V* s, V* out) {
  constexpr int T = turns(D);
  V beside[D];
  transposed_times<T>(p.turning, s, out);
  lever<D>(p.first, s + T, beside);
  for (int i = 0; i < T; i++) out[i] += beside[i];
  swing<D>(s, arm, beside);
  for (int i = 0; i < D; i++) out[T + i] = fma(mass, s[T + i], beside[i]);
}

// Contact loads of a node.
template <class V, int D = 3> struct Push {
  static constexpr int S = turns(D) + D;
  V moment[D * D], force[D];
  V stiffness[S * S];
  bool any;  // in some lane

  // Nothing is there until something touches: most nodes of most steps are spared the zeros.
  void open() {
    if (any) return;
    for (V& x : moment) x = V(0);
    for (V& x : force) x = V(0);
    for (V& x : stiffness) x = V(0);
    any = true;
  }
  void add(const Push& o) {
    if (!any) {
      *this = o;
      return;
    }
    for (int i = 0; i < D * D; i++) moment[i] += o.moment[i];
    for (int i = 0; i < D; i++) force[i] += o.force[i];
    for (int i = 0; i < S * S; i++) stiffness[i] += o.stiffness[i];
  }
};

}  // namespace pbfd
