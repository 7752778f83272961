// Where the nodes of the tree are at a configuration, and the axes of its degrees of freedom (METHOD §3).
#pragma once
#include "plan.h"
#include "rotations.h"

namespace pbfd {

// Poses of all nodes: rotation [9] and position [3] each.
template <class V> struct Poses {
  V *rotation, *position;
  static Poses in(Arena<V>& arena, Sizes s) { return {arena.take(9 * s.nodes), arena.take(3 * s.nodes)}; }
};

template <class V, class N> inline void place(const Plan<N>& plan, const V* q, Poses<V> out) {
  for (int k = 0; k < plan.nodes; k++) {
    const int up = plan.parent[k], kind = plan.kind[k];
    const N *frame = plan.frame + 9 * k, *origin = plan.origin + 3 * k, *axis = plan.axis + 3 * k;
    V *R = out.rotation + 9 * k, *p = out.position + 3 * k, base[9];
    if (up < 0) {
      for (int i = 0; i < 9; i++) base[i] = V(frame[i]);
      for (int i = 0; i < 3; i++) p[i] = V(origin[i]);
    } else {
      product(out.rotation + 9 * up, frame, base);
      times(out.rotation + 9 * up, origin, p);
      for (int i = 0; i < 3; i++) p[i] += out.position[3 * up + i];
    }
    const V* x = q + plan.q[k];
    if (kind == SLIDE) {
      V along[3];
      times(base, axis, along);
      const V shift = x[0] - V(plan.reference[k]);
      for (int i = 0; i < 3; i++) p[i] = fma(shift, along[i], p[i]);
      for (int i = 0; i < 9; i++) R[i] = base[i];
    } else if (kind == HINGE) {
      // Rodrigues: every row b of the base turns about the axis a, b cos + (a·b)(1 − cos) a + sin b × a
      V sine, cosine;
      sine_cosine(x[0] - V(plan.reference[k]), sine, cosine);
      const V a[3] = {V(axis[0]), V(axis[1]), V(axis[2])};
      for (int i = 0; i < 3; i++) {
        const V* b = base + 3 * i;
        V beside[3];
        cross(b, a, beside);
        const V along = dot(b, a) * (V(1) - cosine);
        for (int j = 0; j < 3; j++) R[3 * i + j] = fma(cosine, b[j], fma(sine, beside[j], along * a[j]));
      }
    } else {
      V turn[9];
      quaternion_matrix(x + (kind == FREE ? 3 : 0), turn);
      product(base, turn, R);
      if (kind == FREE) {  // the world's axes: plan.py takes no others
        for (int i = 0; i < 3; i++) p[i] += x[i];
      }
    }
  }
}

// Unit twists (ω, v at the world's origin) of all degrees of freedom, [6] each, about axes that ride on these poses: those at
// the end of the step, or on its chord, where rotations have shrunk.
template <class V, class N> inline void motion_axes(const Plan<N>& plan, Poses<V> at, V* axes) {
  const V zero(0), one(1);
  for (int k = 0; k < plan.nodes; k++) {
    const V *R = at.rotation + 9 * k, *p = at.position + 3 * k;
    V* s = axes + 6 * plan.v[k];
    const int kind = plan.kind[k];
    if (kind == HINGE) {
      times(R, plan.axis + 3 * k, s);
      cross(p, s, s + 3);
    } else if (kind == SLIDE) {
      s[0] = s[1] = s[2] = zero;
      times(R, plan.axis + 3 * k, s + 3);
    } else {
      if (kind == FREE) {
        for (int i = 0; i < 3; i++, s += 6)
          for (int j = 0; j < 6; j++) s[j] = j == 3 + i ? one : zero;
      }
      for (int i = 0; i < 3; i++, s += 6) {
        for (int j = 0; j < 3; j++) s[j] = R[3 * j + i];
        cross(p, s, s + 3);
      }
    }
  }
}

// q moved by the tangent vector `along` times a.
template <class V, class N> inline void retract(const Plan<N>& plan, const V* q, const V* along, V a, V* out) {
  for (int k = 0; k < plan.nodes; k++) {
    const int kind = plan.kind[k];
    const V *x = q + plan.q[k], *d = along + plan.v[k];
    V* y = out + plan.q[k];
    const int straight = kind == FREE ? 3 : kind == BALL ? 0 : 1;
    for (int i = 0; i < straight; i++) y[i] = fma(a, d[i], x[i]);
    if (kind == HINGE || kind == SLIDE) continue;
    const V turn[3] = {a * d[straight], a * d[straight + 1], a * d[straight + 2]};
    V by[4], to[4];
    quaternion_exp(turn, by);
    quaternion_product(x + straight, by, to);
    const V norm = sqrt(fma(to[0], to[0], fma(to[1], to[1], fma(to[2], to[2], to[3] * to[3]))));
    for (int i = 0; i < 4; i++) y[straight + i] = to[i] / norm;
  }
}

// The tangent vector that takes `from` to `to`.
template <class V, class N> inline void difference(const Plan<N>& plan, const V* from, const V* to, V* out) {
  for (int k = 0; k < plan.nodes; k++) {
    const int kind = plan.kind[k];
    const V *x = from + plan.q[k], *y = to + plan.q[k];
    V* d = out + plan.v[k];
    const int straight = kind == FREE ? 3 : kind == BALL ? 0 : 1;
    for (int i = 0; i < straight; i++) d[i] = y[i] - x[i];
    if (kind == HINGE || kind == SLIDE) continue;
    const V* from_turn = x + straight;
    const V back[4] = {from_turn[0], -from_turn[1], -from_turn[2], -from_turn[3]};
    V between[4];
    quaternion_product(back, y + straight, between);
    quaternion_log(between, d + straight);
  }
}

}  // namespace pbfd
