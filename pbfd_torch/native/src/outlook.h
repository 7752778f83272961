// What a direction promises: the work of the forces along it, φ(a) = r(q ⊕ a d) · d, without walking through the tree again, as
// balance/outlook.py and terms/contact_outlook.py. Contacts see their points move on parabolas; the rest changes linearly.
#pragma once
#include "integrators.h"

namespace pbfd {

// A contact that may touch along the direction.
template <class V> struct Coming {
  V depth, start, steepness, sinks, faster, stiffness, mu, holding, per_range, per_width, size, along, square, cube, fourth;
  int law;  // −1: the usual one
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
  int count = 0, limits = 0;
  V base, slope;  // of what changes linearly
  V limit_release, dt;
  double close;  // which part of the work may be left: where bodies couple, evaluations cost much more than looking well
  const Relaxed<V>* relaxed;
  const Law<V>* laws;

  static int room(Sizes s) {
    return int(sizeof(Coming<V>) / sizeof(V)) * Balance<V, N, D>::held(s) + int(sizeof(Stop<V>) / sizeof(V)) * 2 * s.nv + 12 * s.nodes;
  }
  Outlook(Sizes s, Arena<V>& arena) : close(s.bodies.rows > 0 ? 0.01 : 0.2) {
    coming = reinterpret_cast<Coming<V>*>(arena.take(int(sizeof(Coming<V>) / sizeof(V)) * Balance<V, N, D>::held(s)));
    stops = reinterpret_cast<Stop<V>*>(arena.take(int(sizeof(Stop<V>) / sizeof(V)) * 2 * s.nv));
    twist = arena.take(6 * s.nodes), drift = arena.take(6 * s.nodes);
  }

  // Along d from q, where the work is `start` and its slope dᵀJd is `curve`. `where`: for which lanes it counts.
  void look(Balance<V, N, D>& b, const V* q, const V* d, V start, V curve, typename Kind<V>::Mask where) {
    const Plan<N, D>& plan = b.plan;
    const V zero(0);
    count = limits = 0, base = slope = zero;
    limit_release = V(plan.limit_release[0]), dt = b.dt, relaxed = &b.relaxed, laws = b.laws.law;
    twists(plan, b.axes, d, twist);
    drifts(plan, b.axes, twist, d, drift);
    each_kind(plan.contact, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) foresee(b.contacts, pair, i, where);
    });
    if constexpr (D == 3)
      b.meetings.slots.each_row([&](auto pair, int r) {
        b.meetings.each_spot(r, [&](Spot<V>& spot, int held) { foresee(b.meetings, pair, r, spot, held, where); });
      });
    for (int k = 0; k < plan.nodes; k++) {
      if (plan.kind[k] != HINGE && plan.kind[k] != SLIDE) continue;
      const int i = plan.v[k], c = plan.q[k];
      if (!any(b.limits[i] > zero)) continue;
      for (int side = 0; side < 2; side++) {
        const V sign = side ? V(1) : V(-1), bound = side ? V(plan.upper[i]) : V(plan.lower[i]);
        const V past = sign * (q[c] - bound), speed = sign * d[i];
        if (!any(((past > zero) | (past + speed > zero)) & where)) continue;
        Stop<V>& out = stops[limits++];
        out = {past, speed, max(sign * (b.q_start[c] - bound), zero), relaxed->firmness * b.limits[i]};
      }
    }
    V known;
    base = start - work(zero, known), slope = curve - known;
  }

  // φ and dφ/da at a length.
  V work(V a, V& df) const {
    V f = fma(a, slope, base), d;
    df = slope;
    for (int i = 0; i < count; i++) f += of_contact(coming[i], a, d), df += d;
    for (int i = 0; i < limits; i++) f += of_limit(stops[i], a, d), df += d;
    return f;
  }

 private:
  // A candidate whose surface moves on a parabola, c + s with s held on the body; the normal is held but for the depth.
  template <class Pair> void foresee(Contacts<V, N, D>& contacts, Pair pair, int i, typename Kind<V>::Mask where) {
    using Surface = typename Pair::Surface;
    using Support = typename Pair::Support;
    constexpr bool simple = Surface::flat && !Support::wanders;  // its depth knows nothing of the body's rotation
    const int k = contacts.candidates.carrier[i];
    const V zero(0), *t = twist + S * k, *e = drift + S * k;
    Touching<V, D> at;
    const V *c = at.center, *n = at.solid.normal;
    contacts.center(i, contacts.now, at.center);
    at.depth = contacts.depth(pair, i, contacts.now, c, at.solid);
    if (contacts.laws.throwing) at.depth += contacts.moved_out(i);
    V v[D], a[D];
    move(k, c, v, a);
    if constexpr (!simple) {
      contacts.touch(pair, i, at);
      add_swing<D>(t, at.arm.s, v), add_swing<D>(e, at.arm.s, a);
    }
    if constexpr (Support::wanders) {
      const V bulge = Support::bulge(contacts.candidates, i, contacts.now.rotation + D * D * k, n, at.arm, t);
      for (int j = 0; j < D; j++) a[j] = fma(-bulge, n[j], a[j]);
    }
    const V sinks = -dot<D>(v, n), faster = -dot<D>(a, n);
    V deepens = faster;
    if constexpr (!Surface::flat) {
      V tilt[D];
      times<D>(at.bend, v, tilt);
      deepens -= dot<D>(tilt, v);
    }
    at.holding = relaxed->holding(i);
    const V grows = at.solid.steepness * (max(sinks, zero) + V(0.5) * max(deepens, zero));
    if (!any(((at.depth + grows > zero) | (at.holding > zero)) & where)) return;
    if constexpr (simple) {
      contacts.touch(pair, i, at);
      if constexpr (Support::rolls) add_swing<D>(t, at.arm.s, v), add_swing<D>(e, at.arm.s, a);
    }
    come<Support>(at, v, a, sinks, faster, deepens);
  }

  // A candidate between bodies, as the one of the solid sees it.
  template <class Pair>
  void foresee(Meetings<V, N, D>& meetings, Pair pair, int r, const Spot<V>& spot, int held, typename Kind<V>::Mask where) {
    const V zero(0);
    Touching<V, 3> at;
    at.depth = meetings.depth(pair, r, spot, meetings.now, at.center, at.solid) + spot.bounce;
    at.holding = meetings.holding(spot, held);
    V v[3], a[3], v_other[3], a_other[3], w[3], spin[3];
    const V *c = at.center, *n = at.solid.normal;
    const int first = meetings.slots.on_tree(meetings.bodies.first[r]), second = meetings.slots.on_tree(meetings.bodies.second[r]);
    move(first, c, v, a), move(second, c, v_other, a_other);
    for (int j = 0; j < 3; j++) {
      w[j] = second < 0 ? zero : V(-2) * twist[S * second + j];
      spin[j] = (first < 0 ? zero : twist[S * first + j]) + V(0.5) * w[j];
      v[j] -= v_other[j], a[j] -= a_other[j];
    }
    add_cross(w, v, a);  // Coriolis: seen from a turning body
    meetings.arm(pair, r, spot, at.solid, v_other);
    add_cross(spin, v_other, v);
    const V sinks = -dot(v, n), faster = -dot(a, n);
    if (!any(((at.depth + at.solid.steepness * (max(sinks, zero) + V(0.5) * max(faster, zero)) > zero) | (at.holding > zero)) & where) &&
        (Pair::Surface::flat || Pair::Support::leans))
      return;
    meetings.touch(pair, r, spot, at);
    V deepens = faster;
    if constexpr (!Pair::Surface::flat && !Pair::Support::leans) {
      V tilt[3];
      times(at.bend, v, tilt);
      deepens -= dot(tilt, v);
      const V grows = at.solid.steepness * (max(sinks, zero) + V(0.5) * max(deepens, zero));
      if (!any(((at.depth + grows > zero) | (at.holding > zero)) & where)) return;
    }
    come<typename Pair::Support>(at, v, a, sinks, faster, deepens);
  }
  // How fast a point on a node moves, and gets faster.
  void move(int k, const V* c, V* v, V* a) const {
    if (k < 0) {
      for (int j = 0; j < D; j++) v[j] = a[j] = V(0);
      return;
    }
    const V *t = twist + S * k, *e = drift + S * k;
    swing<D>(t, c, v), swing<D>(e, c, a);
    for (int j = 0; j < D; j++) v[j] += t[T + j], a[j] += e[T + j];
    add_swing<D>(t, v, a);
  }

  template <class Support> void come(const Touching<V, D>& at, const V* v, const V* a, V sinks, V faster, V deepens) {
    Coming<V>& out = coming[count++];
    out.depth = at.depth, out.start = at.start, out.sinks = sinks, out.faster = deepens, out.steepness = at.solid.steepness;
    out.stiffness = at.firmness, out.mu = at.grip, out.holding = at.holding, out.per_range = at.per_range, out.per_width = at.per_width;
    out.law = at.law ? int(at.law - laws) : -1;
    V u[D];
    at.template travel<Support>(u);
    slide(out, u, at.solid.normal, v, a, faster);
  }

  // How the square of the slip grows that is now what u has along the plane, of a surface that moves like this.
  [[gnu::noinline]] static void slide(Coming<V>& out, V* u, const V* n, const V* v, const V* a, V faster) {
    V first[D], second[D];
    const V lifted = dot<D>(u, n);
    for (int j = 0; j < D; j++) {
      u[j] = fma(-lifted, n[j], u[j]);
      first[j] = fma(out.sinks, n[j], v[j]), second[j] = fma(faster, n[j], a[j]);
    }
    out.size = dot<D>(u, u), out.along = dot<D>(u, first);
    out.square = dot<D>(first, first) + dot<D>(u, second), out.cube = dot<D>(first, second);
    out.fourth = dot<D>(second, second);
  }

  V of_contact(const Coming<V>& c, V a, V& df) const {
    if (c.law >= 0) return of_uncommon(c, laws + c.law, a, df);
    const V deep = fma(c.steepness * a, fma(V(0.5) * a, c.faster, c.sinks), c.depth), speed = fma(a, c.faster, c.sinks);
    V push, rises, factor, falls;
    release_law(c.stiffness, deep, c.start, c.per_range, push, rises);
    const V square = c.size + a * (V(2) * c.along + a * (c.square + a * (c.cube + V(0.25) * a * c.fourth)));
    slip_law(sqrt(max(square, V(0))), c.per_width, factor, falls);
    const V on = c.along + a * (c.square + a * (V(1.5) * c.cube + V(0.5) * a * c.fourth));
    const V further = c.square + a * (V(3) * c.cube + V(1.5) * a * c.fourth);
    V pressed = push, firmer = rises;
    relaxed->felt(c.holding, pressed, firmer);
    const V grows = c.steepness * speed, drags = (firmer * grows * factor + pressed * falls * on) * on + pressed * factor * further;
    df = rises * grows * speed + push * c.faster + c.mu * drags;
    return push * speed + c.mu * pressed * factor * on;
  }

  [[gnu::noinline]] V of_uncommon(const Coming<V>& c, const Law<V>* law, V a, V& df) const {
    const V deep = fma(c.steepness * a, fma(V(0.5) * a, c.faster, c.sinks), c.depth), speed = fma(a, c.faster, c.sinks);
    V push, rises;
    normal_force(law, c.stiffness, deep, c.start, c.per_range, push, rises);
    const V square = c.size + a * (V(2) * c.along + a * (c.square + a * (c.cube + V(0.25) * a * c.fourth)));
    const V on = c.along + a * (c.square + a * (V(1.5) * c.cube + V(0.5) * a * c.fourth));
    const V further = c.square + a * (V(3) * c.cube + V(1.5) * a * c.fourth), grows = c.steepness * speed;
    Grasp<V> g;
    friction(law, *relaxed, c.mu, c.per_width, c.holding, push, rises, deep, sqrt(max(square, V(0))), g);
    const V slope = (rises + g.lift_by_depth) * grows + g.lift_by_size * on;
    df = slope * speed + (push + g.lift) * c.faster + (g.by_depth * grows + g.by_size * on) * on + g.drag * further;
    return (push + g.lift) * speed + g.drag * on;
  }

  V of_limit(const Stop<V>& s, V a, V& df) const {
    V push, rises;
    release_law(s.stiffness, fma(a, s.speed, s.past), s.start, per_return(limit_release, s.start, dt), push, rises);
    df = rises * s.speed * s.speed;
    return push * s.speed;
  }
};

}  // namespace pbfd
