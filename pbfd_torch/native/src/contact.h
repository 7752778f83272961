// Contact of candidates with solids at rest: what is known of a step beforehand, the loads at a configuration, and hazards
// (terms/contact.py, contact/hazards.py).
#pragma once
#include "kinds.h"
#include "touching.h"

namespace pbfd {

template <class V, class N> struct Contacts {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  const Plan<N>& plan;
  const Candidates<N>& candidates;
  // of the worlds in the lanes
  const T* own_grip = nullptr;  // [candidates, worlds], where worlds differ
  V* grip;                      // μ [candidates]
  // what is fixed in a step
  Poses<V> before;  // of the nodes at its start
  V dt;
  V* share;  // of its normal force that a candidate gives
  V* guard;  // [5] 1 where a plane stands for the solid, else 0, and its normal and offset
  // of the nodes at a configuration: the rotation since the start and how it answers a turn, where asked for
  Poses<V> now;
  V *turns, *rollings;  // [3], [9]
  bool* turned;

  static int room(Sizes s) {
    return 7 * s.candidates + 12 * s.nodes + (s.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V));
  }
  Contacts(const Plan<N>& scene, Arena<V>& arena) : plan(scene), candidates(scene.contact) {
    grip = arena.take(plan.candidates), share = arena.take(plan.candidates), guard = arena.take(5 * plan.candidates);
    turns = arena.take(3 * plan.nodes), rollings = arena.take(9 * plan.nodes);
    turned = reinterpret_cast<bool*>(arena.take((plan.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V))));
    for (int i = 0; i < plan.candidates; i++) grip[i] = V(candidates.grip[i]);
  }

  // A lane takes a world, of so many.
  void load(int i, int world, int worlds) {
    if (!own_grip) return;
    for (int j = 0; j < plan.candidates; j++) put(grip[j], i, own_grip[j * worlds + world]);
  }

  // The step begins at these poses, and would lead to `free` without contacts.
  void begin(Poses<V> start, Poses<V> free, V step) {
    before = start, dt = step;
    each_kind(candidates, [&](auto pair, int first, int last) {
      using Surface = typename decltype(pair)::Surface;
      using Support = typename decltype(pair)::Support;
      if (!Surface::convex && !Support::wanders) return;
      for (int i = first; i < last; i++) {
        V c[3];
        Beside<V> solid;
        center(i, before, c);
        Surface::beside(candidates, i, c, solid);
        if constexpr (Support::wanders)
          share[i] = Support::share(candidates, i, before.rotation + 9 * candidates.carrier[i], solid.normal);
        if constexpr (Surface::convex) keep_outside(i, c, solid, free);
      }
    });
  }

  // The nodes are at these poses.
  void look(Poses<V> poses) {
    now = poses;
    for (int k = 0; k < plan.nodes; k++) turned[k] = false;
  }

  // Adds the loads of what touches.
  void press(Push<V>* pushes) {
    each_kind(candidates, [&](auto pair, int first, int last) {
      using Surface = typename decltype(pair)::Surface;
      using Support = typename decltype(pair)::Support;
      for (int i = first; i < last; i++) {
        Touching<V> t;
        center(i, now, t.center);
        t.depth = depth(pair, i, now, t.center, t.solid);
        if (!any(t.depth > V(0))) continue;
        touch(pair, i, t);
        pbfd::press<Surface::flat, Support>(t, pushes[candidates.carrier[i]]);
      }
    });
  }

  // What is too deep, and who touches something and has turned by more than a quarter turn.
  void look_for_hazards(M& deep, M& far) const {
    each_kind(candidates, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) {
        const V *R = now.rotation + 9 * candidates.carrier[i], *R0 = before.rotation + 9 * candidates.carrier[i];
        V c[3], traced(0);
        Beside<V> solid;
        center(i, now, c);
        const V d = depth(pair, i, now, c, solid);
        for (int j = 0; j < 9; j++) traced = fma(R[j], R0[j], traced);
        deep = deep | (d > V(candidates.deep[i])), far = far | ((d > V(0)) & (traced < V(1)));
      }
    });
  }

  void center(int i, Poses<V> at, V* out) const {
    const int k = candidates.carrier[i];
    times(at.rotation + 9 * k, candidates.position + 3 * i, out);
    for (int j = 0; j < 3; j++) out[j] += at.position[3 * k + j];
  }

  template <class Pair> V depth(Pair, int i, Poses<V> at, const V* c, Beside<V>& solid) const {
    Pair::Surface::beside(candidates, i, c, solid);
    if constexpr (Pair::Surface::convex) {
      const V* plane = guard + 5 * i;
      const M stands = plane[0] > V(0);
      solid.distance = select(stands, dot(plane + 1, c) - plane[4], solid.distance);
      for (int j = 0; j < 3; j++) solid.normal[j] = select(stands, plane[1 + j], solid.normal[j]);
    }
    const V reach = Pair::Support::reach(candidates, i, at.rotation + 9 * candidates.carrier[i], solid.normal);
    return reach + V(candidates.margin[i]) - solid.distance;
  }

  // The rest of what is to be known of a candidate whose centre and depth are.
  template <class Pair> void touch(Pair, int i, Touching<V>& t) {
    const int k = candidates.carrier[i];
    V c[3];
    Beside<V> solid;
    center(i, before, c);
    t.start = depth(Pair(), i, before, c, solid);
    for (int j = 0; j < 3; j++) t.moved[j] = t.center[j] - c[j];
    Pair::Surface::bend(candidates, i, t.center, t.solid, t.bend);
    if constexpr (Pair::Surface::convex)
      for (V& x : t.bend) x = select(guard[5 * i] > V(0), V(0), x);
    Pair::Support::template arm<Pair::Surface::flat>(candidates, i, now.rotation + 9 * k, t.solid.normal, t.bend, t.arm);
    t.firmness = V(candidates.firmness[i]), t.grip = grip[i];
    t.range = V(candidates.release[i]) * dt, t.width = V(candidates.slip_speed[i]) * dt;
    if constexpr (Pair::Support::wanders) t.firmness = t.firmness * share[i];
    if (!Pair::Support::rolls) return;
    if (!turned[k]) turn(k);
    t.turn = turns + 3 * k, t.rolling = rollings + 9 * k;
  }

 private:
  [[gnu::noinline]] void turn(int k) {
    rotation_between(now.rotation + 9 * k, before.rotation + 9 * k, turns + 3 * k);
    log_jacobian(turns + 3 * k, V(-0.5), rollings + 9 * k);
    turned[k] = true;
  }

  // A point that moves far in one step ends beyond the solid, where its distance knows nothing of what lies between: a plane that
  // touches it where the point is nearest stands for it (contact/surface.py, `Tangent`).
  void keep_outside(int i, const V* c, const Beside<V>& solid, Poses<V> free) {
    V end[3], *plane = guard + 5 * i;
    center(i, free, end);
    for (int j = 0; j < 3; j++) end[j] = end[j] - c[j], plane[1 + j] = solid.normal[j];
    const V thickness = V(candidates.thickness[candidates.solid[i]]);
    const M led = (solid.distance > V(0)) & (sqrt(dot(end, end)) > fma(V(0.25), thickness, solid.distance));
    plane[0] = select(led, V(1), V(0)), plane[4] = dot(solid.normal, c) - solid.distance;
  }
};

}  // namespace pbfd
