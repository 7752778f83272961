// Contact between bodies: the loads that candidates put on both, and hazards (terms/body_contact.py).
//
// A row's loads on the body that gives the points are as those of contact with the world, by the twist W = V₁ − V₂. The other body
// has the opposite ones, and the force turns with both: with A how they answer W,
//   K₁₁ = A,  K₁₂ = −A − D,  K₂₁ = M − A,  K₂₂ = A + D − M,   D V = (p × (ω × f), ω × f),  M V = ((v + ω × p) × f, 0).
#pragma once
#include "slots.h"
#include "touching.h"

namespace pbfd {

// What may be wrong with a step although it is solved (contact/hazards.py).
template <class V> struct Hazards {
  typename Kind<V>::Mask dropped{false}, far{false}, overlapped{false}, deep{false}, turned{false};
  int bits(int i) const {
    return 1 * lane(dropped, i) + 2 * lane(far, i) + 4 * lane(overlapped, i) + 8 * lane(deep, i) + 16 * lane(turned, i);
  }
};

template <class V, class N, int D> struct Meetings {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr double NOWHERE = 1e6;  // [m] how far an empty place is from everything

  const Plan<N, D>& plan;
  const Bodies<T>& bodies;
  const Relaxed<V>& relaxed;
  const Laws<V, N, D>& laws;
  Slots<V, N, D> slots;
  V per_dt;
  // of the nodes at a configuration
  Poses<V> now;
  Push<V, 3>* sums;         // [rows] of what is on the bodies that give the points
  V *turned_by, *rollings;  // [3], [9] of each row where asked for: how the one has turned as the other sees it
  bool* turned;

  static int room(Sizes s) {
    const int rows = D == 3 ? s.bodies.rows : 0;
    return Slots<V, N, D>::room(s) + Slots<V, N, D>::in(int(sizeof(Push<V, 3>)) * rows) + 12 * rows + Slots<V, N, D>::in(rows);
  }
  Meetings(const Plan<N, D>& scene, const Relaxed<V>& easier, const Laws<V, N, D>& all, Arena<V>& arena)
      : plan(scene), bodies(scene.pairing), relaxed(easier), laws(all), slots(scene, arena) {
    const int rows = D == 3 ? bodies.rows : 0;
    sums = reinterpret_cast<Push<V, 3>*>(arena.take(slots.in(int(sizeof(Push<V, 3>)) * rows)));
    turned_by = arena.take(3 * rows), rollings = arena.take(9 * rows);
    turned = reinterpret_cast<bool*>(arena.take(slots.in(rows)));
  }
  bool any_row() const { return D == 3 && slots.active > 0; }
  // What J couples.
  Branches branches() const { return D == 3 && bodies.rows > 0 ? slots.coupling.branches() : tree(plan); }

  // A step of these lanes begins.
  void begin(M which, Poses<V> start, Poses<V> free, V dt, bool sorted) {
    per_dt = V(1) / dt;
    if constexpr (D == 3)
      if (bodies.rows > 0) {
        slots.find(which, start, free, dt, sorted);
        if (laws.throwing) throw_back(which, free, dt);
      }
  }
  [[gnu::noinline]] void throw_back(M which, Poses<V> free, V dt) {
    if constexpr (D == 3) slots.each_row([&](auto pair, int r) {
      const Law<V>* law = laws.at(bodies.law[r]);
      if (!law || !law->throws()) return;
      each_spot(r, [&](Spot<V>& s, int) {
        auto gap = [&](Poses<V> at) {
          V c[3];
          Beside<V, 3> solid;
          return -depth(pair, r, s, at, c, solid);
        };
        const V found = law->bounce(-s.began, gap(free), gap(laws.coasting), dt);
        s.bounce = select(which, select(s.there > V(0), found, V(0)), s.bounce);
      });
    });
  }

  // The nodes are at these poses.
  void look(Poses<V> poses) {
    now = poses;
    for (int k = 0; k < (D == 3 ? slots.active : 0); k++) turned[slots.rows[k]] = false;
  }

  // Adds the loads of what touches.
  void press(Push<V, D>* pushes) {
    if constexpr (D == 3) slots.each_row([&](auto pair, int r) {
      using Pair = decltype(pair);
      sums[r].any = false;
      each_spot(r, [&](Spot<V>& s, int held) {
        Touching<V, 3> t;
        t.depth = depth(pair, r, s, now, t.center, t.solid) + s.bounce, t.holding = holding(s, held);
        if (!any((t.depth > V(0)) | (t.holding > V(0)))) return;
        touch(pair, r, s, t);
        pbfd::press<Pair::Surface::flat, typename Pair::Support>(t, sums[r]);
      });
      if (!sums[r].any) return;
      if (const int k = slots.on_tree(bodies.first[r]); k >= 0) pushes[k].add(sums[r]);
      if (const int k = slots.on_tree(bodies.second[r]); k >= 0) push_back(sums[r], pushes[k]);
    });
  }

  // Adds what couples the bodies in J; axes [6] of all dofs.
  void couple(const V* axes, V* matrix) const {
    if constexpr (D == 3)
      for (int k = 0; k < slots.active; k++) {
        const int r = slots.rows[k], a = slots.on_tree(bodies.first[r]), b = slots.on_tree(bodies.second[r]);
        if (!sums[r].any || a < 0 || b < 0) continue;
        V there[36], back[36], turned[36], moved[36];
        turning(sums[r], turned, moved);
        for (int i = 0; i < 36; i++)
          there[i] = -(sums[r].stiffness[i] + turned[i]), back[i] = moved[i] - sums[r].stiffness[i];
        add(axes, a, b, there, matrix), add(axes, b, a, back, matrix);
      }
  }

  // See `Contacts`.
  template <class F> void each_normal_force(Poses<V> at, F&& visit, bool raised) const {
    if constexpr (D == 3) slots.each_row([&](auto pair, int r) {
      each_spot(r, [&](Spot<V>& s, int held) {
        V c[3], push, rises, firmness = V(slots.laws(r)[0]);
        Beside<V, 3> solid;
        const Law<V>* law = laws.at(bodies.law[r]);
        if constexpr (decltype(pair)::Support::wanders) firmness = firmness * s.share;
        const V bounce = raised ? s.bounce : V(0), d = depth(pair, r, s, at, c, solid) + bounce;
        normal_force(law, law ? law->harder(firmness, bounce) : firmness, d, s.began, per_dt * V(slots.laws(r)[3]), push, rises);
        visit(held, push, law ? law->feels(push, d) : push);
      });
    });
  }

  // Too deep; turned by more than a quarter turn where something touches; gone further than was looked; overlapping at the start by
  // more than the slack; dropped.
  void look_for_hazards(Hazards<V>& seen) const {
    if constexpr (D == 3) {
      if (bodies.rows == 0) return;
      seen.dropped = slots.dropped > V(0);
      slots.each_row([&](auto pair, int r) {
        each_spot(r, [&](Spot<V>& s, int) {
          V c[3];
          Beside<V, 3> solid;
          const V d = depth(pair, r, s, now, c, solid);
          seen.deep = seen.deep | (d > V(slots.laws(r)[2])), seen.turned = seen.turned | ((d > V(0)) & turned_far(r));
          seen.overlapped = seen.overlapped | ((s.there > V(0)) & (s.began > V(bodies.slack[bodies.group[r]])));
        });
      });
      for (int g = 0; g < bodies.groups; g++)
        for (int l = 0; l < bodies.links; l++)
          seen.far = seen.far | (slots.travel(g, l, slots.before, now) > slots.reach[g * bodies.links + l]);
    }
  }
  // Of a row whose bodies have turned by more than a quarter turn in the step.
  M turned_far(int r) const {
    M found(false);
    for (int k : {slots.on_tree(bodies.first[r]), slots.on_tree(bodies.second[r])}) {
      if (k < 0) continue;
      V traced(0);
      for (int j = 0; j < 9; j++) traced = fma(now.rotation[9 * k + j], slots.before.rotation[9 * k + j], traced);
      found = found | (traced < V(1));
    }
    return found;
  }

  bool anchored(int r) const { return bodies.memory[bodies.group[r]] >= 0; }

  // What anchors remember after a step of the step's own problem that ended where the nodes are now, see `Contacts::remember`: each
  // lane of its own candidates, in its own slots.
  [[gnu::noinline]] void remember(V* memory) {
    if constexpr (D == 3) {
      if (bodies.remembered == 0) return;
      for (int j = 0; j < bodies.remembered; j++)
        memory[3 * plan.anchors + j] = V(T(j % NUMBERS_OF_AN_ANCHOR == NUMBERS_OF_AN_ANCHOR - 1 ? -1 : 0));
      slots.each_row([&](auto pair, int r) {
        if (!anchored(r)) return;
        each_spot(r, [&](Spot<V>& s, int) { keep(pair, r, s, memory + bodies.memory[bodies.group[r]]); });
      });
    }
  }

  // What lagged friction feels; a lane without this candidate has never been asked.
  V holding(const Spot<V>& s, int held) const { return select(s.there > V(0), relaxed.holding(held), V(0)); }

  // visit(spot, its number among all candidates)
  template <class F> void each_spot(int r, F&& visit) const {
    for (int j = 0; j < slots.most[r]; j++) visit(slots.spot[SPOTS * r + j], plan.candidates + SPOTS * r + j);
  }

  template <class Pair> V depth(Pair, int r, const Spot<V>& s, Poses<V> at, V* c, Beside<V, 3>& solid) const {
    V own[3], n[3];
    slots.center(r, s, at, c), slots.seen(r, at, c, own);
    Pair::Surface::beside(s, slots.solid(r), own, solid);
    for (int j = 0; j < 3; j++) n[j] = solid.normal[j];
    times(slots.rotation(at, bodies.second[r]), n, solid.normal);
    V depth = V(slots.radius(r)) - solid.distance;
    if constexpr (Pair::Support::wanders)
      depth = sunk<typename Pair::Support>(
          s, slots.curved(r), slots.standing(at, bodies.first[r]), slots.standing(at, bodies.second[r]), c, solid);
    return select(s.there > V(0), depth, V(-NOWHERE));
  }

  // The rest of what is to be known of a candidate whose centre and depth are.
  template <class Pair> void touch(Pair, int r, const Spot<V>& s, Touching<V, 3>& t) {
    using Surface = typename Pair::Surface;
    const V *R = slots.rotation(now, bodies.second[r]), *p = slots.position(now, bodies.second[r]);
    V carried[3];
    const V start[3] = {s.start[0] - s.anchor[0], s.start[1] - s.anchor[1], s.start[2] - s.anchor[2]};
    times(R, start, carried);
    for (int j = 0; j < 3; j++) t.moved[j] = t.center[j] - (carried[j] + p[j]);
    t.start = s.began;
    if constexpr (!Surface::flat && !Pair::Support::leans) {
      Beside<V, 3> seen = t.solid;
      V own[3], bend[9], half[9];
      slots.seen(r, now, t.center, own), transposed_times(R, t.solid.normal, seen.normal);
      Surface::bend(s, slots.solid(r), own, seen, bend);
      product(R, bend, half), product_transposed(half, R, t.bend);
    }
    if constexpr (Pair::Support::rolls) {
      if constexpr (Pair::Support::wanders)
        reach_out<typename Pair::Support>(
            s, slots.curved(r), slots.standing(now, bodies.first[r]), slots.standing(now, bodies.second[r]), t.center, t.solid,
            t.bend, t.arm);
      else
        Ball::arm<Surface::flat>(V(slots.radius(r)), t.solid.normal, t.bend, t.arm);
      if (!turned[r]) turn(r);
      t.turn = turned_by + 3 * r, t.rolling = rollings + 9 * r;
    } else {
      for (V& x : t.arm.s) x = V(0);
    }
    const N* law = slots.laws(r);
    t.firmness = relaxed.firmness * V(law[0]), t.grip = V(law[1]);
    t.per_range = per_dt * V(law[3]), t.per_width = (anchored(r) ? V(1) : per_dt) * V(law[4]) / relaxed.width;
    t.relaxed = &relaxed, t.law = laws.at(bodies.law[r]);
    if constexpr (Pair::Support::wanders) t.firmness = t.firmness * s.share;
    if (t.law) t.firmness = t.law->harder(t.firmness, s.bounce);
  }
  // s alone.
  template <class Pair> void arm(Pair, int r, const Spot<V>& s, const Beside<V, 3>& solid, V* out) const {
    if constexpr (Pair::Support::wanders)
      arm_of(s, slots.curved(r), slots.standing(now, bodies.first[r]), solid, out);
    else
      for (int j = 0; j < 3; j++) out[j] = V(-slots.radius(r)) * solid.normal[j];
  }

 private:
  template <class Pair> void keep(Pair pair, int r, const Spot<V>& s, V* memory) {
    Touching<V, 3> t;
    V u[3], seen[3], kept[3], off[3], x[3], F[9];
    t.depth = depth(pair, r, s, now, t.center, t.solid);
    touch(pair, r, s, t);
    t.template slip<typename Pair::Support>(u);
    const M holds = t.depth > V(0);
    const V part = select(holds, V(1) / max(V(slots.laws(r)[4]) * sqrt(dot(u, u)), V(1)), V(0));
    for (int j = 0; j < 3; j++) u[j] = part * u[j];
    const T* frames = slots.own_frames(r);
    transposed_times(slots.rotation(now, bodies.second[r]), u, seen);
    for (int j = 0; j < 9; j++) F[j] = V(frames[12 + j]);
    transposed_times(F, seen, kept);
    for (int j = 0; j < 9; j++) F[j] = V(frames[j]);
    for (int j = 0; j < 3; j++) off[j] = s.position[j] - V(frames[9 + j]);
    transposed_times(F, off, x);
    const V number = select(holds, V(T(bodies.danger[r])), V(-1));
    for (int i = 0; i < Kind<V>::lanes; i++) {
      if (!(lane(s.there, i) > T(0))) continue;
      V* out = memory + NUMBERS_OF_AN_ANCHOR * int(lane(s.slot, i));
      for (int j = 0; j < 3; j++) put(out[j], i, lane(kept[j], i)), put(out[3 + j], i, lane(x[j], i));
      put(out[6], i, lane(number, i));
    }
  }

  // How the one body has turned since the start as the other one sees it, in the world's axes now.
  [[gnu::noinline]] void turn(int r) {
    const int a = bodies.first[r], b = bodies.second[r];
    V between[9], carried[9], back[9];
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) back[3 * j + k] = slots.rotation(slots.before, b)[3 * k + j];
    product(back, slots.rotation(slots.before, a), between), product(slots.rotation(now, b), between, carried);
    rotation_between(slots.rotation(now, a), carried, turned_by + 3 * r);
    log_jacobian(turned_by + 3 * r, V(-0.5), rollings + 9 * r);
    turned[r] = true;
  }

  // D and M, of minus the forces f in `sum`.
  static void turning(const Push<V, 3>& sum, V* turned, V* moved) {
    const V *G = sum.moment, *f = sum.force, zero(0), round = trace(G);
    for (int i = 0; i < 36; i++) turned[i] = moved[i] = zero;
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) {
        const V around = i == j ? round : zero;
        turned[6 * i + j] = G[3 * i + j] - around, moved[6 * i + j] = around - G[3 * j + i];
      }
    const V F[9] = {zero, -f[2], f[1], f[2], zero, -f[0], -f[1], f[0], zero};  // −[f]×
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) turned[6 * (3 + i) + j] = moved[6 * i + 3 + j] = F[3 * i + j];
  }
  static void push_back(const Push<V, 3>& sum, Push<V, 3>& out) {
    V turned[36], moved[36];
    turning(sum, turned, moved), out.open();
    for (int i = 0; i < 9; i++) out.moment[i] -= sum.moment[i];
    for (int i = 0; i < 3; i++) out.force[i] -= sum.force[i];
    for (int i = 0; i < 36; i++) out.stiffness[i] += sum.stiffness[i] + (turned[i] - moved[i]);
  }

  // matrix_ij += s_iᵀ K s_j of the dofs i that move a node and j that move another one.
  void add(const V* axes, int node, int other, const V* K, V* matrix) const {
    each_dof(plan, other, [&](int j) {
      V answer[6];
      times<6>(K, axes + 6 * j, answer);
      each_dof(plan, node, [&](int i) { matrix[plan.nv * i + j] += dot<6>(axes + 6 * i, answer); });
    });
  }
};

}  // namespace pbfd
