// What a direction promises: the work of the forces along it, φ(a) = r(q ⊕ a d) · d, without walking through the tree again, as
// balance/outlook.py and terms/contact_outlook.py. Contacts see their points move on parabolas; the rest changes linearly.
#pragma once
#include "integrators.h"

namespace pbfd {

// A contact that may touch along the direction.
template <class V> struct Coming {
  V depth, start, sinks, faster, stiffness, mu, size, along, square, cube, fourth;
};

// A limit that may be reached.
template <class V> struct Stop {
  V past, speed, start, stiffness;
};

template <class V, class N, int D = 3> struct Outlook {
  static constexpr int T = turns(D), S = T + D;
  Coming<V>* coming;
  Stop<V>* stops;
  V *twist, *drift;  // [6] per node
  int contacts = 0, limits = 0;
  V base, slope;  // of what changes linearly
  V per_range, per_width, per_limit_range;

  static int room(Sizes s) {
    return int(sizeof(Coming<V>) / sizeof(V)) * s.candidates + int(sizeof(Stop<V>) / sizeof(V)) * 2 * s.nv + 12 * s.nodes;
  }
  Outlook(Sizes s, Arena<V>& arena) {
    coming = reinterpret_cast<Coming<V>*>(arena.take(int(sizeof(Coming<V>) / sizeof(V)) * s.candidates));
    stops = reinterpret_cast<Stop<V>*>(arena.take(int(sizeof(Stop<V>) / sizeof(V)) * 2 * s.nv));
    twist = arena.take(6 * s.nodes), drift = arena.take(6 * s.nodes);
  }

  // Along d from q, where the work is `work` and its slope dᵀJd is `curve`. `where`: for which lanes it counts.
  void look(const Balance<V, N, D>& b, const V* q, const V* d, V work, V curve, typename Kind<V>::Mask where) {
    const Plan<N, D>& plan = b.plan;
    const V zero(0);
    base = work, slope = curve, contacts = limits = 0;
    const V per_dt = V(1) / b.dt;
    per_range = per_dt * V(N(1) / plan.release[0]), per_width = per_dt * V(N(1) / plan.slip_speed[0]);
    per_limit_range = per_dt * V(N(1) / plan.limit_release[0]);
    twists(plan, b.axes, d, twist);
    drifts(plan, b.axes, d);
    for (int i = 0; i < plan.candidates; i++) {
      const int k = plan.carrier[i];
      V c[D], before[D], n[D];
      const V radius = V(plan.radius[i]), reach = radius + V(plan.margin[i]);
      const V depth = reach - height(plan, i, b.now, c);
      for (int j = 0; j < D; j++) n[j] = V(plan.normal[D * i + j]);
      const V *t = twist + S * k, *e = drift + S * k;
      V v[D], a[D], bent[D];
      swing<D>(t, c, v), swing<D>(e, c, a);
      for (int j = 0; j < D; j++) v[j] += t[T + j], a[j] += e[T + j];
      swing<D>(t, v, bent);
      for (int j = 0; j < D; j++) a[j] += bent[j];
      const V sinks = -dot<D>(v, n), faster = -dot<D>(a, n);
      if (!any((depth + max(sinks, zero) + V(0.5) * max(faster, zero) > zero) & where)) continue;
      Coming<V>& out = coming[contacts++];
      out.depth = depth, out.start = reach - height(plan, i, b.start, before), out.sinks = sinks, out.faster = faster;
      out.stiffness = V(plan.firmness[i]), out.mu = V(plan.grip[i]);
      V moved[D], first[D], second[D];
      for (int j = 0; j < D; j++) moved[j] = c[j] - before[j];
      if (any(plan.radius[i] > N(0))) {  // the surface moves by φ × s beside its centre, s = −ρ n
        V *phi = b.rolls + 3 * k, beside[D];
        if (!b.turned[k]) rotation_between<D>(b.now.rotation + D * D * k, b.start.rotation + D * D * k, phi), b.turned[k] = true;
        swing<D>(phi, n, beside);
        for (int j = 0; j < D; j++) moved[j] = fma(-radius, beside[j], moved[j]);
        swing<D>(t, n, beside);
        for (int j = 0; j < D; j++) v[j] = fma(-radius, beside[j], v[j]);
        swing<D>(e, n, beside);
        for (int j = 0; j < D; j++) a[j] = fma(-radius, beside[j], a[j]);
      }
      const V lifted = dot<D>(moved, n);
      for (int j = 0; j < D; j++) {
        moved[j] = fma(-lifted, n[j], moved[j]);
        first[j] = fma(sinks, n[j], v[j]), second[j] = fma(faster, n[j], a[j]);
      }
      out.size = dot<D>(moved, moved), out.along = dot<D>(moved, first);
      out.square = dot<D>(first, first) + dot<D>(moved, second), out.cube = dot<D>(first, second);
      out.fourth = dot<D>(second, second);
      V df;
      base -= of_contact(out, zero, df);
      slope -= df;
    }
    for (int k = 0; k < plan.nodes; k++) {
      if (plan.kind[k] != HINGE && plan.kind[k] != SLIDE) continue;
      const int i = plan.v[k], c = plan.q[k];
      if (!any(plan.limit[i] > N(0))) continue;
      for (int side = 0; side < 2; side++) {
        const V sign = side ? V(1) : V(-1), bound = side ? V(plan.upper[i]) : V(plan.lower[i]);
        const V past = sign * (q[c] - bound), speed = sign * d[i];
        if (!any(((past > zero) | (past + speed > zero)) & where)) continue;
        Stop<V>& out = stops[limits++];
        out = {past, speed, max(sign * (b.q_start[c] - bound), zero), V(plan.limit[i])};
        V df;
        base -= of_limit(out, zero, df);
        slope -= df;
      }
    }
  }

  // φ and dφ/da at a length.
  V work(V a, V& df) const {
    V f = fma(a, slope, base), d;
    df = slope;
    for (int i = 0; i < contacts; i++) f += of_contact(coming[i], a, d), df += d;
    for (int i = 0; i < limits; i++) f += of_limit(stops[i], a, d), df += d;
    return f;
  }

 private:
  // V̇ = Σ ṡ_i d_i, ṡ_i = ad(V_carrier) s_i, of all nodes.
  void drifts(const Plan<N, D>& plan, const V* axes, const V* d) {
    for (int k = 0; k < plan.nodes; k++) {
      V carrier[S];
      for (int a = 0; a < S; a++) {
        carrier[a] = plan.parent[k] < 0 ? V(0) : twist[S * plan.parent[k] + a];
        drift[S * k + a] = plan.parent[k] < 0 ? V(0) : drift[S * plan.parent[k] + a];
      }
      const int first = plan.v[k], last = first + freedoms(plan.kind[k]), rotation = plan.kind[k] == FREE ? first + 3 : first;
      for (int j = first; j < rotation; j++) carrier[T + j - first] += d[j];  // its translation carries its rotation
      for (int j = rotation; j < last; j++) {
        const V* s = axes + S * j;
        V moved[D], back[D];
        swing<D>(carrier, s + T, moved), swing<D>(s, carrier + T, back);
        for (int a = 0; a < D; a++) drift[S * k + T + a] = fma(d[j], moved[a] - back[a], drift[S * k + T + a]);
        if constexpr (D == 3) {
          V turned[3];
          cross(carrier, s, turned);
          for (int a = 0; a < 3; a++) drift[S * k + a] = fma(d[j], turned[a], drift[S * k + a]);
        }
      }
    }
  }

  V of_contact(const Coming<V>& c, V a, V& df) const {
    const V deep = c.depth + a * fma(V(0.5) * a, c.faster, c.sinks), speed = fma(a, c.faster, c.sinks);
    V push, rises, factor, falls;
    release_law(c.stiffness, deep, c.start, per_range, push, rises);
    const V square = c.size + a * (V(2) * c.along + a * (c.square + a * (c.cube + V(0.25) * a * c.fourth)));
    slip_law(sqrt(max(square, V(0))), per_width, factor, falls);
    const V on = c.along + a * (c.square + a * (V(1.5) * c.cube + V(0.5) * a * c.fourth));
    const V further = c.square + a * (V(3) * c.cube + V(1.5) * a * c.fourth);
    const V drags = (rises * speed * factor + push * falls * on) * on + push * factor * further;
    df = rises * speed * speed + push * c.faster + c.mu * drags;
    return push * speed + c.mu * push * factor * on;
  }

  V of_limit(const Stop<V>& s, V a, V& df) const {
    V push, rises;
    release_law(s.stiffness, fma(a, s.speed, s.past), s.start, per_limit_range, push, rises);
    df = rises * s.speed * s.speed;
    return push * s.speed;
  }
};

}  // namespace pbfd
