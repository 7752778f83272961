// Where the nodes of the tree are at a configuration, and the axes of its degrees of freedom (METHOD §3).
#pragma once
#include "plan.h"
#include "rotations.h"

namespace pbfd {

// Poses of all nodes: rotation [D × D] and position [D] each; and of the obstacles that move, as they are then.
template <class V> struct Poses {
  V *rotation, *position;
  const V* carriers = nullptr;  // [12] each
  template <int D = 3> static Poses in(Arena<V>& arena, Sizes s) { return {arena.take(D * D * s.nodes), arena.take(D * s.nodes)}; }
};

// The velocity that a turning ω about p gives what is at the world's origin: p × ω.
template <int D, class V> inline void about(const V* p, const V* w, V* out) {
  swing<D>(w, p, out);
  for (int i = 0; i < D; i++) out[i] = -out[i];
}

// Where all nodes are at q, and the unit twists (ω, v at the world's origin) of all degrees of freedom, [turns(D) + D] each.
template <class V, class N, int D> inline void place(const Plan<N, D>& plan, const V* q, Poses<V> out, V* axes) {
  constexpr int T = turns(D), S = T + D;
  const V zero(0), one(1);
  for (int k = 0; k < plan.nodes; k++) {
    const int up = plan.parent[k], kind = plan.kind[k];
    const N *frame = plan.frame + D * D * k, *origin = plan.origin + D * k;
    V *R = out.rotation + D * D * k, *p = out.position + D * k, *s = axes + S * plan.v[k], turned[D * D];
    const V *base = turned, *x = q + plan.q[k];
    if (up < 0) {
      for (int i = 0; i < D * D; i++) turned[i] = V(frame[i]);
      for (int i = 0; i < D; i++) p[i] = V(origin[i]);
    } else {
      const V *R_up = out.rotation + D * D * up, *p_up = out.position + D * up;
      if (plan.plain[k])
        base = R_up;
      else
        product<D>(R_up, frame, turned);
      times<D>(R_up, origin, p);
      for (int i = 0; i < D; i++) p[i] += p_up[i];
    }
    if (kind == SLIDE) {
      const V shift = x[0] - V(plan.reference[k]);
      for (int i = 0; i < T; i++) s[i] = zero;
      for (int i = 0; i < D; i++) s[T + i] = base[D * i + D - 1], p[i] = fma(shift, s[T + i], p[i]);
      for (int i = 0; i < D * D; i++) R[i] = base[i];
    } else if (kind == HINGE) {
      V sine, cosine;
      const V angle = x[0] - V(plan.reference[k]);
      sine_cosine(D == 3 ? angle : V(plan.sense[k]) * angle, sine, cosine);
      for (int i = 0; i < D; i++) {
        const V a = base[D * i], b = base[D * i + 1];
        R[D * i] = fma(cosine, a, sine * b), R[D * i + 1] = fma(cosine, b, -(sine * a));
        if constexpr (D == 3) R[D * i + 2] = s[i] = base[D * i + 2];
      }
      if constexpr (D == 2) s[0] = V(plan.sense[k]);
      about<D>(p, s, s + T);
    } else if constexpr (D == 3) {
      V turn[9];
      quaternion_matrix(x + (kind == FREE ? 3 : 0), turn);
      product(base, turn, R);
      if (kind == FREE) {  // the world's axes: plan.py takes no others
        for (int i = 0; i < 3; i++) p[i] += x[i];
        for (int i = 0; i < 3; i++, s += 6)
          for (int j = 0; j < 6; j++) s[j] = j == 3 + i ? one : zero;
      }
      for (int i = 0; i < 3; i++, s += 6) {
        for (int j = 0; j < 3; j++) s[j] = R[3 * j + i];
        about<3>(p, s, s + 3);
      }
    }
  }
}

// q moved by the tangent vector `along` times a.
template <class V, class N, int D> inline void retract(const Plan<N, D>& plan, const V* q, const V* along, V a, V* out) {
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
template <class V, class N, int D> inline void difference(const Plan<N, D>& plan, const V* from, const V* to, V* out) {
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
