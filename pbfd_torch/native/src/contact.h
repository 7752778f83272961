// Contact of candidates with solids at rest: what is known of a step beforehand, the loads at a configuration, and hazards
// (terms/contact.py, contact/hazards.py).
#pragma once
#include "kinds.h"
#include "touching.h"

namespace pbfd {

template <class V, class N, int D> struct Contacts {
  static constexpr int T = turns(D);
  using M = typename Kind<V>::Mask;
  const Plan<N, D>& plan;
  const Candidates<N, D>& candidates;
  const Relaxed<V>& relaxed;
  // what is fixed in a step
  Poses<V> before;  // of the nodes at its start
  V dt;
  // of the nodes at a configuration: the rotation since the start and how it answers a turn, where asked for
  Poses<V> now;
  V *turned_by, *rollings;  // [T], [T × T]
  bool* turned;

  static int room(Sizes s) {
    return T * (1 + T) * s.nodes + (s.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V));
  }
  Contacts(const Plan<N, D>& scene, const Relaxed<V>& easier, Arena<V>& arena)
      : plan(scene), candidates(scene.contact), relaxed(easier) {
    turned_by = arena.take(T * plan.nodes), rollings = arena.take(T * T * plan.nodes);
    turned = reinterpret_cast<bool*>(arena.take((plan.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V))));
  }

  // The step begins at these poses.
  void begin(Poses<V> start, V step) { before = start, dt = step; }

  // The nodes are at these poses.
  void look(Poses<V> poses) {
    now = poses;
    for (int k = 0; k < plan.nodes; k++) turned[k] = false;
  }

  // Adds the loads of what touches.
  void press(Push<V, D>* pushes) {
    each_kind(candidates, [&](auto pair, int first, int last) {
      using Surface = typename decltype(pair)::Surface;
      using Support = typename decltype(pair)::Support;
      for (int i = first; i < last; i++) {
        Touching<V, D> t;
        center(i, now, t.center);
        t.depth = depth(pair, i, now, t.center, t.solid);
        t.holding = relaxed.holding(i);
        if (!any((t.depth > V(0)) | (t.holding > V(0)))) continue;
        touch(pair, i, t);
        pbfd::press<Surface, Support>(t, pushes[candidates.carrier[i]]);
      }
    });
  }

  // What is too deep, and who touches something and has turned by more than a quarter turn.
  void look_for_hazards(M& deep, M& far) const {
    each_kind(candidates, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) {
        const int at = D * D * candidates.carrier[i];
        const V *R = now.rotation + at, *R0 = before.rotation + at;
        V c[D], traced(0);
        Beside<V, D> solid;
        center(i, now, c);
        const V d = depth(pair, i, now, c, solid);
        for (int j = 0; j < D * D; j++) traced = fma(R[j], R0[j], traced);
        deep = deep | (d > V(candidates.deep[i])), far = far | ((d > V(0)) & (traced < V(D - 2)));
      }
    });
  }

  // What the normal forces of the step's own problem are where nodes are at these poses: visit(candidate, force).
  template <class F> void each_normal_force(Poses<V> at, F&& visit) const {
    each_kind(candidates, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) {
        V c[D], push, rises;
        Beside<V, D> solid;
        center(i, before, c);
        const V start = depth(pair, i, before, c, solid);
        center(i, at, c);
        releasing(V(candidates.firmness[i]), depth(pair, i, at, c, solid), start, V(candidates.release[i]) * dt, push, rises);
        visit(i, push);
      }
    });
  }

  void center(int i, Poses<V> at, V* out) const {
    const int k = candidates.carrier[i];
    times<D>(at.rotation + D * D * k, candidates.position + D * i, out);
    for (int j = 0; j < D; j++) out[j] += at.position[D * k + j];
  }

  template <class Pair> V depth(Pair, int i, Poses<V> at, const V* c, Beside<V, D>& solid) const {
    Pair::Surface::beside(candidates, i, c, solid);
    const V reach = Pair::Support::reach(candidates, i, at.rotation + D * D * candidates.carrier[i], solid.normal);
    return reach + V(candidates.margin[i]) - solid.distance;
  }

  // The rest of what is to be known of a candidate whose centre and depth are.
  template <class Pair> void touch(Pair, int i, Touching<V, D>& t) {
    const int k = candidates.carrier[i];
    V c[D];
    Beside<V, D> solid;
    center(i, before, c);
    t.start = depth(Pair(), i, before, c, solid);
    for (int j = 0; j < D; j++) t.moved[j] = t.center[j] - c[j];
    Pair::Surface::bend(candidates, i, t.center, t.solid, t.bend);
    Pair::Support::template arm<Pair::Surface::flat>(candidates, i, now.rotation + D * D * k, t.solid.normal, t.bend, t.arm);
    t.firmness = relaxed.firmness * V(candidates.firmness[i]), t.grip = V(candidates.grip[i]);
    t.range = V(candidates.release[i]) * dt, t.width = V(candidates.slip_speed[i]) * dt * relaxed.width;
    t.relaxed = &relaxed;
    if (!Pair::Support::rolls) return;
    V *turn = turned_by + T * k, *rolling = rollings + T * T * k;
    t.turn = turn, t.rolling = rolling;
    if (turned[k]) return;
    rotation_between<D>(now.rotation + D * D * k, before.rotation + D * D * k, turn);
    log_jacobian<D>(turn, V(-0.5), rolling);
    turned[k] = true;
  }
};

}  // namespace pbfd
