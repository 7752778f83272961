// Contact of candidates with solids of the world: what is known of a step beforehand, the loads at a configuration, and hazards
// (terms/contact.py, contact/hazards.py).
#pragma once
#include "carriers.h"
#include "kinds.h"
#include "torsion.h"

namespace pbfd {

template <class V, class N, int D> struct Contacts {
  using Scalar = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr int T = turns(D);
  const Plan<N, D>& plan;
  const Candidates<N, D>& candidates;
  const V* grip = nullptr;  // μ [candidates] of the worlds in the lanes
  const Relaxed<V>& relaxed;
  const Laws<V, N, D>& laws;
  Carriers<V>& carriers;
  // what is fixed in a step
  const V* behind = nullptr;  // [3 × anchors] what the anchors are behind by, in the solids' own frames
  Poses<V> before;  // of the nodes at its start
  V per_dt;
  V* share;  // of its normal force that a candidate gives
  V* bounce;  // [uncommon] how far its solid is moved out, of those that throw candidates back
  V* began_at;  // how deep it was at the step's start, beside solids that are not flat, where that is dear
  V* guard;  // [2 + D] 1 where a plane stands for the solid, else 0, and its normal and offset
  // of the nodes at a configuration: the rotation since the start and how it answers a turn, where asked for
  Poses<V> now;
  V *turned_by, *rollings;  // [T], [T × T]
  bool* turned;
  V carried_turn[T], carried_rolling[T * T];  // likewise of the node `turning`, seen from the solid that `turned_on` carries
  int turning, turned_on;

  static int room(Sizes s) {
    return (4 + D) * s.candidates + s.uncommon + T * (1 + T) * s.nodes + (s.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V));
  }
  Contacts(const Plan<N, D>& scene, const Relaxed<V>& easier, const Laws<V, N, D>& all, Carriers<V>& moving, Arena<V>& arena)
      : plan(scene), candidates(scene.contact), relaxed(easier), laws(all), carriers(moving) {
    share = arena.take(plan.candidates), began_at = arena.take(plan.candidates), guard = arena.take((2 + D) * plan.candidates);
    bounce = arena.take(plan.uncommon);
    turned_by = arena.take(T * plan.nodes), rollings = arena.take(T * T * plan.nodes);
    turned = reinterpret_cast<bool*>(arena.take((plan.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V))));
  }

  // The step begins at these poses, and would lead to `free` without contacts. `anew`: which lanes begin it.
  void begin(M anew, Poses<V> start, Poses<V> free, V step) {
    before = start, per_dt = V(1) / step;
    if constexpr (D == 3) carriers.begin(plan.belt, step);
    each_kind(candidates, [&](auto pair, int first, int last) {
      using Surface = typename decltype(pair)::Surface;
      using Support = typename decltype(pair)::Support;
      if (Surface::flat && !Support::wanders) return;
      for (int i = first; i < last; i++) {
        V c[D], room[D * D];
        Beside<V, D> solid;
        origin(i, c);
        beside<Surface>(i, c, solid);
        if constexpr (Support::wanders) share[i] = Support::share(candidates, i, stood(i, room), solid.normal);
        if constexpr (Surface::convex) keep_outside(i, c, solid, free);
        if constexpr (!Surface::flat) began_at[i] = sunk(pair, i, stood(i, room), solid);
      }
    });
    if (laws.throwing) throw_back(anew, free, step);
  }
  // What is fixed in a step while its motion without contacts may be made shorter.
  [[gnu::noinline]] void throw_back(M anew, Poses<V> free, V step) {
    each_kind(candidates, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) {
        const Law<V>* law = laws.at(candidates.law[i]);
        if (!law || !law->throws()) continue;
        V gap[2], c[D], &out = bounce[candidates.law[i]];
        Beside<V, D> solid;
        const V start = -began(pair, i, c, solid);
        const Poses<V> at[] = {free, laws.coasting};
        for (int k = 0; k < 2; k++) center(i, at[k], c), gap[k] = -depth(pair, i, at[k], c, solid);
        out = select(anew, law->bounce(start, gap[0], gap[1], step), out);
      }
    });
  }
  // How far the solid of a candidate is moved out.
  [[gnu::noinline]] V moved_out(int i) const {
    const Law<V>* law = laws.throwing ? laws.at(candidates.law[i]) : nullptr;
    return law && law->throws() ? bounce[candidates.law[i]] : V(0);
  }

  // The nodes are at these poses.
  void look(Poses<V> poses) {
    now = poses;
    for (int k = 0; k < plan.nodes; k++) turned[k] = false;
    turning = -1;
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
        if (laws.throwing) t.depth += moved_out(i);
        t.holding = relaxed.holding(i);
        if (!any((t.depth > V(0)) | (t.holding > V(0)))) continue;
        touch(pair, i, t);
        pbfd::press<Surface::flat, Support>(t, pushes[candidates.carrier[i]]);
      }
    });
  }

  // Adds the torques of torsional friction, a term of its own: it does not set in abruptly, as contacts do.
  [[gnu::noinline]] void resist_spins(Push<V, D>* pushes) {
    if constexpr (D == 3)
      if (laws.torsional) each_kind(candidates, [&](auto pair, int first, int last) {
        using Support = typename decltype(pair)::Support;
        if constexpr (Support::rolls && !Support::wanders)
          for (int i = first; i < last; i++) {
            const Law<V>* law = laws.at(candidates.law[i]);
            if (!law || !law->torsional()) continue;
            Touching<V, D> t;
            center(i, now, t.center);
            t.depth = depth(pair, i, now, t.center, t.solid) + moved_out(i);
            const V pressed = relaxed.pressing(i);
            if (!any((t.depth > V(0)) | (pressed > V(0)))) continue;
            touch(pair, i, t);
            resist_spin<decltype(pair)::Surface::flat>(t, pressed, pushes[candidates.carrier[i]]);
          }
      });
  }

  // What the anchors are behind by after a step of the step's own problem that ended where the nodes are now: w, cut to the stretch;
  // nothing where the contact has opened (terms/anchored_friction.py).
  [[gnu::noinline]] void remember(V* kept) {
    if constexpr (D == 3) {
      for (int j = 0; j < 3 * plan.anchors; j++) kept[j] = V(0);
      each_kind(candidates, [&](auto pair, int first, int last) {
        for (int i = first; i < last; i++)
          if (anchored(i)) keep(pair, i, kept + 3 * candidates.anchor[i]);
      });
    }
  }

  // What is too deep, and who touches something and has turned by more than a quarter turn.
  void look_for_hazards(M& deep, M& far) const {
    each_kind(candidates, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) {
        V c[D];
        Beside<V, D> solid;
        center(i, now, c);
        const V d = depth(pair, i, now, c, solid);
        deep = deep | (d > V(candidates.deep[i])), far = far | ((d > V(0)) & turned_far(i));
      }
    });
  }
  // Whose body has turned by more than a quarter turn in the step.
  M turned_far(int i) const {
    const V *R = now.rotation + D * D * candidates.carrier[i], *R0 = before.rotation + D * D * candidates.carrier[i];
    V traced(0);
    for (int j = 0; j < D * D; j++) traced = fma(R[j], R0[j], traced);
    return traced < V(D - 2);
  }

  // What the normal forces of the step's own problem are where nodes are at these poses, and what lagged friction feels there:
  // visit(candidate, force, felt). raised: solids that throw candidates back are where the step has moved them.
  template <class F> void each_normal_force(Poses<V> at, F&& visit, bool raised) const {
    each_kind(candidates, [&](auto pair, int first, int last) {
      for (int i = first; i < last; i++) {
        V c[D], push, rises;
        Beside<V, D> solid;
        const V start = started(pair, i, c, solid);
        center(i, at, c);
        V firmness = V(candidates.firmness[i]);
        if constexpr (decltype(pair)::Support::wanders) firmness = firmness * share[i];
        const Law<V>* law = laws.at(candidates.law[i]);
        V d = depth(pair, i, at, c, solid);
        if (laws.throwing && raised) firmness = harder(i, firmness), d += moved_out(i);
        normal_force(law, firmness, d, start, per_dt * V(candidates.per_release[i]), push, rises);
        visit(i, push, law ? law->feels(push, d) : push);
      }
    });
  }

  void center(int i, Poses<V> at, V* out) const {
    const int k = candidates.carrier[i];
    times<D>(at.rotation + D * D * k, candidates.position + D * i, out);
    for (int j = 0; j < D; j++) out[j] += at.position[D * k + j];
  }

  // What carries the solid beside a candidate; −1: it stands, and so does its surface.
  int mover(int i) const { return D == 3 && plan.moving > 0 ? plan.mover[i] : -1; }

  // Where a candidate was at the start, and how its body stood [D × D], as the solid has carried them by the end of the step.
  void origin(int i, V* c) const {
    center(i, before, c);
    if constexpr (D == 3)
      if (const int m = mover(i); m >= 0) carriers.carry(m, c);
  }
  const V* stood(int i, V* room) const {
    const V* R = before.rotation + D * D * candidates.carrier[i];
    const int m = mover(i);
    if (m < 0) return R;
    if constexpr (D == 3) carriers.carry_rotation(m, R, room);
    return room;
  }

  // What a point is beside, of a solid as it is at the end of the step.
  template <class Surface> void beside(int i, const V* c, Beside<V, D>& solid) const {
    const int m = mover(i);
    if (m < 0) return Surface::beside(candidates, i, c, solid);
    if constexpr (D == 3) {
      V own[3], n[3];
      carriers.to_own(m, c, own);
      Surface::beside(candidates, i, own, solid);
      for (int j = 0; j < 3; j++) n[j] = solid.normal[j];
      carriers.turn(m, n, solid.normal);
    }
  }
  template <class Surface> void bend(int i, const V* c, const Beside<V, D>& solid, V* out) const {
    const int m = mover(i);
    if (Surface::flat || m < 0) return Surface::bend(candidates, i, c, solid, out);
    if constexpr (D == 3) {
      Beside<V, 3> seen = solid;
      V own[3], bent[9], half[9];
      carriers.to_own(m, c, own), carriers.turn_back(m, solid.normal, seen.normal);
      Surface::bend(candidates, i, own, seen, bent);
      product(carriers.end + 12 * m, bent, half), product_transposed(half, carriers.end + 12 * m, out);
    }
  }

  template <class Pair> V depth(Pair, int i, Poses<V> at, const V* c, Beside<V, D>& solid) const {
    return depth(Pair(), i, at.rotation + D * D * candidates.carrier[i], c, solid);
  }
  // At the start, and where that was.
  template <class Pair> V began(Pair, int i, V* c, Beside<V, D>& solid) const {
    V room[D * D];
    origin(i, c);
    if constexpr (Pair::Support::wanders) return depth(Pair(), i, stood(i, room), c, solid);
    return depth(Pair(), i, before, c, solid);
  }
  // The same in the step that has begun.
  template <class Pair> V started(Pair, int i, V* c, Beside<V, D>& solid) const {
    if constexpr (Pair::Surface::flat) return began(Pair(), i, c, solid);
    origin(i, c);
    return began_at[i];
  }
  template <class Pair> V depth(Pair, int i, const V* R, const V* c, Beside<V, D>& solid) const {
    beside<typename Pair::Surface>(i, c, solid);
    if constexpr (Pair::Surface::convex) {
      const V* plane = guard + (2 + D) * i;
      const M stands = plane[0] > V(0);
      solid.distance = select(stands, dot<D>(plane + 1, c) - plane[1 + D], solid.distance);
      for (int j = 0; j < D; j++) solid.normal[j] = select(stands, plane[1 + j], solid.normal[j]);
    }
    return sunk(Pair(), i, R, solid);
  }
  // How deep it is beside what is known of a solid.
  template <class Pair> V sunk(Pair, int i, const V* R, const Beside<V, D>& solid) const {
    const V reach = Pair::Support::reach(candidates, i, R, solid.normal);
    return reach + V(candidates.margin[i]) - solid.distance;
  }

  // What its normal force stores where the nodes are: C d^(α+1)/(α+1) (Eq. 9), of the solid itself.
  template <class Pair> V stored(Pair, int i) const {
    const V* R = now.rotation + D * D * candidates.carrier[i];
    V c[D], firmness = V(candidates.firmness[i]);
    Beside<V, D> solid;
    center(i, now, c);
    beside<typename Pair::Surface>(i, c, solid);
    if constexpr (Pair::Support::wanders) firmness = firmness * Pair::Support::share(candidates, i, R, solid.normal);
    const V d = max(sunk(Pair(), i, R, solid), V(0));
    const Law<V>* law = laws.at(candidates.law[i]);
    if (!squared(law)) return firmness * power(d, law->exponent + Scalar(1)) / V(law->exponent + Scalar(1));
    return V(1) / V(3) * firmness * d * d * d;
  }

  // The rest of what is to be known of a candidate whose centre and depth are.
  template <class Pair> void touch(Pair, int i, Touching<V, D>& t) {
    const int k = candidates.carrier[i];
    V c[D];
    Beside<V, D> solid;
    t.start = started(Pair(), i, c, solid);
    for (int j = 0; j < D; j++) t.moved[j] = t.center[j] - c[j];
    if constexpr (D == 3)
      if (anchored(i)) {
        V stretched[3];
        Pair::Surface::to_world(candidates, i, behind + 3 * candidates.anchor[i], stretched);
        if (const int m = mover(i); m >= 0) carriers.turn(m, stretched, stretched);
        for (int j = 0; j < 3; j++) t.moved[j] += stretched[j];
      }
    if constexpr (!derived<V>) {
      bend<typename Pair::Surface>(i, t.center, t.solid, t.bend);
      if constexpr (Pair::Surface::convex)
        for (V& x : t.bend) x = select(guard[(2 + D) * i] > V(0), V(0), x);
    }
    Pair::Support::template arm<Pair::Surface::flat>(candidates, i, now.rotation + D * D * k, t.solid.normal, t.bend, t.arm);
    t.firmness = relaxed.firmness * V(candidates.firmness[i]), t.grip = grip[i];
    t.per_range = per_dt * V(candidates.per_release[i]);
    t.per_width = (anchored(i) ? V(1) : per_dt) * V(candidates.per_width[i]) / relaxed.width;
    t.relaxed = &relaxed, t.law = laws.at(candidates.law[i]);
    if (laws.throwing) t.firmness = harder(i, t.firmness);
    if constexpr (Pair::Support::wanders) t.firmness = t.firmness * share[i];
    if (!Pair::Support::rolls) return;
    if (const int m = mover(i); m >= 0) return turn_beside(k, m, t);
    if (!turned[k]) turn(k);
    t.turn = turned_by + T * k, t.rolling = rollings + T * T * k;
  }

 private:
  // Scenes with anchors are seen in space.
  bool anchored(int i) const { return D == 3 && candidates.anchor[i] >= 0; }

  [[gnu::noinline]] V harder(int i, V firmness) const {
    const Law<V>* law = laws.at(candidates.law[i]);
    return law && law->throws() ? law->harder(firmness, bounce[candidates.law[i]]) : firmness;
  }

  template <class Pair> void keep(Pair pair, int i, V* kept) {
    Touching<V, D> t;
    center(i, now, t.center);
    t.depth = depth(pair, i, now, t.center, t.solid) + moved_out(i);
    const M holds = t.depth > V(0);
    if (!any(holds)) return;
    touch(pair, i, t);
    V w[D];
    t.template slip<typename Pair::Support>(w);
    const V part = V(1) / max(V(candidates.per_width[i]) * sqrt(dot<D>(w, w)), V(1));
    for (int j = 0; j < D; j++) w[j] = select(holds, part * w[j], V(0));
    if (const int m = mover(i); m >= 0) carriers.turn_back(m, w, w);
    Pair::Surface::to_own(candidates, i, w, kept);
  }

  [[gnu::noinline]] void turn(int k) {
    rotation_between<D>(now.rotation + D * D * k, before.rotation + D * D * k, turned_by + T * k);
    if constexpr (!derived<V>) log_jacobian<D>(turned_by + T * k, V(-0.5), rollings + T * T * k);
    turned[k] = true;
  }

  // As a solid sees it that is carried along itself.
  [[gnu::noinline]] void turn_beside(int k, int m, Touching<V, D>& t) {
    if constexpr (D == 3)
      if (turning != k || turned_on != m) {
        V began[9];
        carriers.carry_rotation(m, before.rotation + 9 * k, began);
        rotation_between(now.rotation + 9 * k, began, carried_turn);
        if constexpr (!derived<V>) log_jacobian(carried_turn, V(-0.5), carried_rolling);
        turning = k, turned_on = m;
      }
    t.turn = carried_turn, t.rolling = carried_rolling;
  }

  // A point that moves far in one step ends beyond the solid, where its distance knows nothing of what lies between: a plane that
  // touches it where the point is nearest stands for it (contact/surface.py, `Tangent`).
  void keep_outside(int i, const V* c, const Beside<V, D>& solid, Poses<V> free) {
    V end[D], *plane = guard + (2 + D) * i;
    center(i, free, end);
    for (int j = 0; j < D; j++) end[j] = end[j] - c[j], plane[1 + j] = solid.normal[j];
    const V thickness = V(candidates.thickness[candidates.solid[i]]);
    const M led = (solid.distance > V(0)) & (sqrt(dot<D>(end, end)) > fma(V(0.25), thickness, solid.distance));
    plane[0] = select(led, V(1), V(0)), plane[1 + D] = dot<D>(solid.normal, c) - solid.distance;
  }
};

}  // namespace pbfd
