// What acts on the nodes, summed up about the world's origin, and its sums over all that a joint moves.
//
// Forces f at points p make the moment [G | g] = −Σ f [pᵀ | 1] (METHOD §3). How they answer a twist (ω, v) of their node, with the
// axes held still: inertia by second moments, contacts by a matrix [6 × 6].
#pragma once
#include "tree.h"

namespace pbfd {

// ω · (Σ p × f) + v · Σ f of minus the forces: the virtual work along a unit twist s.
template <class V> inline V worked(const V* s, const V* moment, const V* force) {
  const V torque[3] = {moment[7] - moment[5], moment[2] - moment[6], moment[3] - moment[1]};
  return dot(s, torque) + dot(s + 3, force);
}

// Inertial loads of a node. Their work is done on the chord of the step, or at its end: then both are one.
template <class V> struct Pull {
  V moment[9], force[3];  // [G | g] of points on the chord
  V at_end[9];            // G of the points at the step's end
  V second[9];            // Σ m p p̄ᵀ, p at the end, p̄ on the chord
  V first[3], on_chord[3], mass;  // Σ m p, Σ m p̄, Σ m

  // How the wrench on the points of the chord answers a unit twist s = (ω, v) of the node: A s.
  void answer(const V* s, V* out) const {
    const V *w = s, *v = s + 3, sum = trace(second);
    times(second, w, out);
    for (int i = 0; i < 3; i++) out[i] = fma(sum, w[i], -out[i]), out[3 + i] = mass * v[i];
    add_cross(on_chord, v, out);
    add_cross(w, first, out + 3);
  }
  void clear() {
    for (V& x : moment) x = V(0);
    for (V& x : at_end) x = V(0);
    for (V& x : second) x = V(0);
    for (int i = 0; i < 3; i++) force[i] = first[i] = on_chord[i] = V(0);
    mass = V(0);
  }
  void add(const Pull& o) {
    for (int i = 0; i < 9; i++) moment[i] += o.moment[i], at_end[i] += o.at_end[i], second[i] += o.second[i];
    for (int i = 0; i < 3; i++) force[i] += o.force[i], first[i] += o.first[i], on_chord[i] += o.on_chord[i];
    mass += o.mass;
  }
};

// Contact loads of a node.
template <class V> struct Push {
  V moment[9], force[3];
  V stiffness[36];
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
    open();
    for (int i = 0; i < 9; i++) moment[i] += o.moment[i];
    for (int i = 0; i < 3; i++) force[i] += o.force[i];
    for (int i = 0; i < 36; i++) stiffness[i] += o.stiffness[i];
  }
};

}  // namespace pbfd
