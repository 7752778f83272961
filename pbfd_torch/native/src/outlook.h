// What a direction promises: the work of the forces along it, φ(a) = r(q ⊕ a d) · d, without walking through the tree again, as
// balance/outlook.py and terms/contact_outlook.py. Contacts see their points move on parabolas; the rest changes linearly.
#pragma once
#include "integrators.h"

namespace pbfd {

// A contact that may touch along the direction.
template <class V> struct Coming {
  V depth, start, sinks, faster, stiffness, mu, holding, size, along, square, cube, fourth;
};

// A limit that may be reached.
template <class V> struct Stop {
  V past, speed, start, stiffness;
};

template <class V, class N> struct Outlook {
  Coming<V>* coming;
  Stop<V>* stops;
  V *twist, *drift;  // [6] per node
  int contacts = 0, limits = 0;
  V base, slope;  // of what changes linearly
  V range, width, limit_range;
  const Relaxed<V>* relaxed;

  static int room(Sizes s) {
    return int(sizeof(Coming<V>) / sizeof(V)) * s.candidates + int(sizeof(Stop<V>) / sizeof(V)) * 2 * s.nv + 12 * s.nodes;
  }
  Outlook(Sizes s, Arena<V>& arena) {
    coming = reinterpret_cast<Coming<V>*>(arena.take(int(sizeof(Coming<V>) / sizeof(V)) * s.candidates));
    stops = reinterpret_cast<Stop<V>*>(arena.take(int(sizeof(Stop<V>) / sizeof(V)) * 2 * s.nv));
    twist = arena.take(6 * s.nodes), drift = arena.take(6 * s.nodes);
  }

  // Along d from q, where the work is `work` and its slope dᵀJd is `curve`. `where`: for which lanes it counts.
  void look(const Balance<V, N>& b, const V* q, const V* d, V work, V curve, typename Kind<V>::Mask where) {
    const Plan<N>& plan = b.plan;
    const V zero(0);
    base = work, slope = curve, contacts = limits = 0;
    relaxed = &b.relaxed, range = V(plan.release[0]) * b.dt, width = V(plan.slip_speed[0]) * b.dt * relaxed->width;
    limit_range = V(plan.limit_release[0]) * b.dt;
    twists(plan, b.axes, d, twist);
    drifts(plan, b.axes, d);
    for (int i = 0; i < plan.candidates; i++) {
      const int k = plan.carrier[i];
      V c[3], before[3], n[3];
      const V radius = V(plan.radius[i]), reach = radius + V(plan.margin[i]);
      const V depth = reach - height(plan, i, b.now, c);
      for (int j = 0; j < 3; j++) n[j] = V(plan.normal[3 * i + j]);
      const V *t = twist + 6 * k, *e = drift + 6 * k;
      V v[3], a[3];
      cross(t, c, v);
      for (int j = 0; j < 3; j++) v[j] += t[3 + j];
      cross(e, c, a);
      for (int j = 0; j < 3; j++) a[j] += e[3 + j];
      add_cross(t, v, a);
      const V sinks = -dot(v, n), faster = -dot(a, n);
      const V holding = relaxed->holding(i);
      if (!any(((depth + max(sinks, zero) + V(0.5) * max(faster, zero) > zero) | (holding > zero)) & where)) continue;
      Coming<V>& out = coming[contacts++];
      out.depth = depth, out.start = reach - height(plan, i, b.start, before), out.sinks = sinks, out.faster = faster;
      out.stiffness = relaxed->firmness * V(plan.firmness[i]), out.mu = V(plan.grip[i]), out.holding = holding;
      V moved[3], first[3], second[3];
      for (int j = 0; j < 3; j++) moved[j] = c[j] - before[j];
      if (any(radius > zero)) {  // the surface moves by φ × s beside its centre, s = −ρ n
        V phi[3], beside[3];
        rotation_between(b.now.rotation + 9 * k, b.start.rotation + 9 * k, phi);
        cross(phi, n, beside);
        for (int j = 0; j < 3; j++) moved[j] = fma(-radius, beside[j], moved[j]);
        cross(t, n, beside);
        for (int j = 0; j < 3; j++) v[j] = fma(-radius, beside[j], v[j]);
        cross(e, n, beside);
        for (int j = 0; j < 3; j++) a[j] = fma(-radius, beside[j], a[j]);
      }
      const V lifted = dot(moved, n);
      for (int j = 0; j < 3; j++) {
        moved[j] = fma(-lifted, n[j], moved[j]);
        first[j] = fma(sinks, n[j], v[j]), second[j] = fma(faster, n[j], a[j]);
      }
      out.size = dot(moved, moved), out.along = dot(moved, first);
      out.square = dot(first, first) + dot(moved, second), out.cube = dot(first, second), out.fourth = dot(second, second);
      V df;
      base -= of_contact(out, zero, df);
      slope -= df;
    }
    for (int k = 0; k < plan.nodes; k++) {
      if (plan.kind[k] != HINGE && plan.kind[k] != SLIDE) continue;
      const int i = plan.v[k], c = plan.q[k];
      for (int side = 0; side < 2; side++) {
        const V sign = side ? V(1) : V(-1), bound = side ? V(plan.upper[i]) : V(plan.lower[i]);
        const V past = sign * (q[c] - bound), speed = sign * d[i];
        if (!any(((past > zero) | (past + speed > zero)) & where)) continue;
        Stop<V>& out = stops[limits++];
        out = {past, speed, max(sign * (b.q_start[c] - bound), zero), relaxed->firmness * V(plan.limit[i])};
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
  void drifts(const Plan<N>& plan, const V* axes, const V* d) {
    for (int k = 0; k < plan.nodes; k++) {
      V carrier[6];
      for (int a = 0; a < 6; a++) {
        carrier[a] = plan.parent[k] < 0 ? V(0) : twist[6 * plan.parent[k] + a];
        drift[6 * k + a] = plan.parent[k] < 0 ? V(0) : drift[6 * plan.parent[k] + a];
      }
      const int first = plan.v[k], last = first + freedoms(plan.kind[k]);
      if (plan.kind[k] == FREE)  // its translation carries its rotation
        for (int a = 0; a < 3; a++) carrier[3 + a] += d[first + a];
      for (int j = first; j < last; j++) {
        if (plan.kind[k] == FREE && j < first + 3) continue;
        const V* s = axes + 6 * j;
        V turned[3], moved[3];
        cross(carrier, s, turned);
        cross(carrier, s + 3, moved);
        add_cross(carrier + 3, s, moved);
        for (int a = 0; a < 3; a++) {
          drift[6 * k + a] = fma(d[j], turned[a], drift[6 * k + a]);
          drift[6 * k + 3 + a] = fma(d[j], moved[a], drift[6 * k + 3 + a]);
        }
      }
    }
  }

  V of_contact(const Coming<V>& c, V a, V& df) const {
    const V deep = c.depth + a * fma(V(0.5) * a, c.faster, c.sinks), speed = fma(a, c.faster, c.sinks);
    V push, rises, factor, falls;
    releasing(c.stiffness, deep, c.start, range, push, rises);
    const V square = c.size + a * (V(2) * c.along + a * (c.square + a * (c.cube + V(0.25) * a * c.fourth)));
    slip_factor(sqrt(max(square, V(0))), width, factor, falls);
    const V on = c.along + a * (c.square + a * (V(1.5) * c.cube + V(0.5) * a * c.fourth));
    const V further = c.square + a * (V(3) * c.cube + V(1.5) * a * c.fourth);
    V pressed = push, firmer = rises;
    relaxed->felt(c.holding, pressed, firmer);
    const V drags = (firmer * speed * factor + pressed * falls * on) * on + pressed * factor * further;
    df = rises * speed * speed + push * c.faster + c.mu * drags;
    return push * speed + c.mu * pressed * factor * on;
  }

  V of_limit(const Stop<V>& s, V a, V& df) const {
    V push, rises;
    releasing(s.stiffness, fma(a, s.speed, s.past), s.start, limit_range, push, rises);
    df = rises * s.speed * s.speed;
    return push * s.speed;
  }
};

}  // namespace pbfd
