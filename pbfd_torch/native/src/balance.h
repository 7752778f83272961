// The balance of forces of one step at one configuration: residual r and exact Jacobian J (METHOD §3), as balance/assembly.py and
// balance/chords.py.
//
// For a dof i at or above dof j, with sums over all that j's joint moves: loads at the end of the step give
//   r_i = s_i · W,  J_ij = s_iᵀ A s_j + s_iᵀ B s_j,  J_ji = s_jᵀ A s_i + s_iᵀ B s_j;
// inertia on the chord, s̄ the twists there, w its share and A with what bends them (inertia.h),
//   r_i = s̄_i · W,  ∂r_i/∂θ_j = s̄_iᵀ A s_j + w s_j · Y_i.
#pragma once
#include "carriers.h"
#include "contact.h"
#include "inertia.h"
#include "joints.h"
#include "meetings.h"
#include "pushes.h"

namespace pbfd {

template <class V, class N, int D = 3> struct Balance {
  static constexpr int T = turns(D), S = T + D;  // a twist (ω, v)
  const Plan<N, D>& plan;
  // what is fixed in a step
  Poses<V> start, target;
  V *start_axes, *q_start, *q_target, *control, *limits, *fitted;
  V dt, weight, share;  // share = 1: inertia works at the end of the step
  V inert;                  // κ over the square of the length that inertia knows of
  Relaxed<V> relaxed;
  Hold<V, D>* holds;
  V* arms;  // κ Σ m p̃ of all that a node moves
  // at the configuration
  Poses<V> now;
  V *axes, *chord_axes, *chord, *residual, *slopes, *matrix;
  Pull<V, D>* pulls;
  Push<V, D>* pushes;
  Carriers<V> carriers;
  Laws<V, N, D> laws;
  Contacts<V, N, D> contacts;
  Meetings<V, N, D> meetings;

  template <class X> static constexpr int in_registers(int count) { return int((count * sizeof(X) + sizeof(V) - 1) / sizeof(V)); }
  static int room(Sizes s) {  // in V, for the arena
    return s.nodes * (3 * (D * D + D) + 2 * D) + in_registers<Hold<V, D>>(s.nodes) + in_registers<Pull<V, D>>(s.nodes) +
           in_registers<Push<V, D>>(s.nodes) + Laws<V, N, D>::room(s) + Contacts<V, N, D>::room(s) +
           Meetings<V, N, D>::room(s) + 2 * s.nq + s.nu +
           (3 * S + 4 + s.nv) * s.nv + 2 * held(s) + Carriers<V>::room(s);
  }
  static int held(Sizes s) { return s.candidates + SPOTS * s.bodies.rows; }
  template <class X> static X* taken(Arena<V>& arena, int count) {
    return reinterpret_cast<X*>(arena.take(in_registers<X>(count)));
  }

  Balance(const Plan<N, D>& scene, Arena<V>& arena)
      : plan(scene), carriers(scene, arena), laws(scene, relaxed, arena), contacts(scene, relaxed, laws, carriers, arena),
        meetings(scene, relaxed, laws, arena) {
    start = Poses<V>::template in<D>(arena, plan), target = Poses<V>::template in<D>(arena, plan);
    now = Poses<V>::template in<D>(arena, plan);
    start.carriers = carriers.start, target.carriers = now.carriers = carriers.end;
    start_axes = arena.take(S * plan.nv), axes = arena.take(S * plan.nv), chord_axes = arena.take(S * plan.nv);
    q_start = arena.take(plan.nq), q_target = arena.take(plan.nq), control = arena.take(plan.nu);
    fitted = arena.take(plan.nv), relaxed.held = arena.take(held(plan)), relaxed.pressed = arena.take(held(plan));
    relaxed.none();
    limits = arena.take(plan.nv), arms = arena.take(D * plan.nodes), chord = arena.take(D * plan.nodes);
    residual = arena.take(plan.nv), slopes = arena.take(plan.nv), matrix = arena.take(plan.nv * plan.nv);
    holds = taken<Hold<V, D>>(arena, plan.nodes), pulls = taken<Pull<V, D>>(arena, plan.nodes);
    pushes = taken<Push<V, D>>(arena, plan.nodes);
    part();
  }
  void part() {
    for (int i = 0; i < plan.nv * plan.nv; i++) matrix[i] = V(0);  // dofs on different branches stay uncoupled
  }
  Branches branches() const { return meetings.branches(); }

  // The start and its axes, the target, κ, w and what is relaxed are known. `anew`: which lanes begin a step here that they did not
  // begin before; `sorted`: see `Meetings`.
  void begin(typename Kind<V>::Mask anew = true, bool sorted = false) {
    inert = weight / (relaxed.length * relaxed.length);
    for (int k = 0; k < plan.nodes; k++)
      if (heavy(k)) hold(plan, k, inert, share, start, target, holds[k]);
    carry();
    stiffen_limits(plan, steps(), limits);
    laws.begin(dt), laws.coast(target, dt);
    contacts.begin(anew, start, target, dt);
    meetings.begin(anew, start, target, dt, sorted);
    if (meetings.slots.changed) part(), meetings.slots.changed = false;
  }

  // r at q; J by `assemble`.
  void evaluate(const V* q) {
    place(plan, q, now, axes);
    for (int k = 0; k < plan.nodes; k++) to_chord(k);
    pull_all();
    press();
    for (int i = 0; i < plan.nv; i++) residual[i] = slopes[i] = V(0);
    joint_loads(plan, steps(), q, residual, slopes);
    for (int k = 0; k < plan.nodes; k++)
      for (int j = plan.v[k]; j < plan.v[k] + freedoms(plan.kind[k]); j++) {
        const V* s = chord_axes + S * j;
        residual[j] += dot<T>(s, pulls[k].torque) + dot<D>(s + T, pulls[k].force);
      }
    add_pushed(residual);
  }

  // What contacts, torsional friction and forces from outside do where the nodes are.
  void press() {
    gather([&] { touch(), push(); });
  }
  // What these put on the nodes, summed up over all that each joint moves.
  template <class F> void gather(F&& put) {
    for (int k = 0; k < plan.nodes; k++) pushes[k].any = false;
    put();
    for (int k = plan.nodes - 1; k > 0; k--)
      if (plan.parent[k] >= 0 && pushes[k].any) pushes[plan.parent[k]].add(pushes[k]);
  }
  void touch() {
    contacts.look(now), contacts.press(pushes);
    meetings.look(now), meetings.press(pushes);
  }
  // What does not set in abruptly; contacts have looked.
  void push() {
    if constexpr (D == 3) push_from_outside(plan, now, pushes), contacts.resist_spins(pushes);
  }
  bool pushed() const { return D == 3 && (plan.pushes > 0 || laws.torsional); }
  // Adds the residual of what has been gathered.
  void add_pushed(V* out) const {
    for (int k = 0; k < plan.nodes; k++)
      for (int j = plan.v[k]; pushes[k].any && j < plan.v[k] + freedoms(plan.kind[k]); j++)
        out[j] += worked<D>(axes + S * j, pushes[k].moment, pushes[k].force);
  }

  // J, or with `curved` false the stiffness: J without how the axes turn under the forces. After it J needs another `evaluate`.
  void assemble(const V* q, bool curved) {
    if (!curved) let_go(now), pull_all();
    if (meetings.any_row()) uncouple();
    for (int k = 0; k < plan.nodes; k++) {
      const Pull<V, D>& pull = pulls[k];
      const Push<V, D>& push = pushes[k];
      const V mass = inert * V(plan.carried[k]), *arm = arms + D * k;
      const int first = plan.v[k], last = first + freedoms(plan.kind[k]);
      for (int i = first; i < last; i++)
        for (int j = first; j < last; j++) matrix[plan.nv * i + j] = i == j ? slopes[j] : V(0);
      V bends[T * T] = {}, torque[T] = {};
      if (push.any && curved) resistance<D>(push.moment, bends);
      if (curved) {  // about the joint
        lever<D>(chord + D * k, pull.force, torque);
        for (int i = 0; i < T; i++) torque[i] = pull.torque[i] - torque[i];
      }
      for (int j = first; j < last; j++) {
        // what works on the axes above: of inertia on those on the chord, of the rest on those at the end; what j's own axis feels
        // of a motion above; and how it is turned by it
        const V *s = axes + S * j, *s_chord = chord_axes + S * j;
        V inertial[S], felt[S], turning[S] = {}, pressed[S] = {}, bent[T] = {};
        answer(pull, mass, arm, s, inertial);
        answer_above(pull, mass, arm, s_chord, felt);
        if (curved) {
          turn_axis(k, j, torque, turning);
          for (int a = 0; a < S; a++) felt[a] += turning[a];
        }
        if (push.any) {
          times<S>(push.stiffness, s, pressed);
          V from_above[S];
          transposed_times<S>(push.stiffness, s, from_above);
          for (int a = 0; a < S; a++) felt[a] += from_above[a];
          if (curved) {
            bend(bends, push.force, s, bent);
            for (int a = 0; a < T; a++) felt[a] += bent[a];
          }
        }
        for (int i = first; i < last; i++) {
          V& entry = matrix[plan.nv * i + j];
          entry += along(chord_axes + S * i, inertial);
          if (push.any) entry += along(axes + S * i, pressed);
        }
        if (push.any && curved)
          for (int a = 0; a < T; a++) pressed[a] += bent[a];
        for (int a = j - first; a < plan.depth[j]; a++) {
          const int i = plan.above[plan.nv * j + a];
          V& entry = matrix[plan.nv * i + j];
          entry = along(chord_axes + S * i, inertial);
          if (push.any) entry += along(axes + S * i, pressed);
          matrix[plan.nv * j + i] = along(axes + S * i, felt);
        }
        if (curved) within(k, j, push.any ? bent : nullptr, turning);
      }
      if constexpr (D == 3)
        if (plan.kind[k] == BALL || plan.kind[k] == FREE) {
          if (curved) lose_half_the_torque(k);
          turning_loads(plan, k, steps(), q, static_cast<V*>(nullptr), matrix);
        }
    }
    meetings.couple(axes, matrix);
    if (!curved) let_go(target);
  }

  // See `Contacts`.
  template <class F> void each_normal_force(Poses<V> at, F&& visit, bool raised = true) const {
    contacts.each_normal_force(at, visit, raised), meetings.each_normal_force(at, visit, raised);
  }

  // What anchors remember of the start of the step; and at its end, where the nodes are now and the contacts have looked.
  void recall(const V* memory) { contacts.behind = memory, meetings.slots.behind = memory; }
  void remember(V* memory) { contacts.remember(memory), meetings.remember(memory); }

  JointStep<V> steps() const { return {q_start, q_target, control, limits, fitted, dt, inert, relaxed}; }

 private:
  // What bodies that touch each other fill in.
  void uncouple() {
    const Branches all = branches();
    for (int j = 0; j < plan.nv; j++)
      for (int a = 0; a < all.depth[j]; a++) {
        const int i = all.above[plan.nv * j + a];
        matrix[plan.nv * i + j] = matrix[plan.nv * j + i] = V(0);
      }
  }
  bool heavy(int k) const { return any(plan.mass[k] > N(0)); }
  static V along(const V* a, const V* b) { return dot<S>(a, b); }

  // Masses are held at places between the start and `other`.
  void let_go(Poses<V> other) {
    for (int k = 0; k < plan.nodes; k++)
      if (heavy(k)) hold_by(plan, k, inert, share, start, other, holds[k]);
    carry();
  }
  void carry() {
    for (int k = 0; k < plan.nodes; k++)
      for (int i = 0; i < D; i++) arms[D * k + i] = heavy(k) ? holds[k].held[i] : V(0);
    for (int k = plan.nodes - 1; k > 0; k--)
      for (int i = 0; plan.parent[k] >= 0 && i < D; i++) arms[D * plan.parent[k] + i] += arms[D * k + i];
  }

  void pull_all() {
    for (int k = 0; k < plan.nodes; k++) {
      pulls[k] = {};  // a joint may only lead to others, or to nothing
      if (!heavy(k)) continue;
      pulls[k].any = true;
      pull(plan, k, inert, share, holds[k], now, pulls[k]);
    }
    for (int k = plan.nodes - 1; k > 0; k--)
      if (plan.parent[k] >= 0) pulls[plan.parent[k]].add(pulls[k]);
  }

  // Where joint k is on the chord, and the axes that ride on it there, where rotations have shrunk.
  void to_chord(int k) {
    V* p = chord + D * k;
    for (int i = 0; i < D; i++) p[i] = blended(share, start.position[D * k + i], now.position[D * k + i]);
    const int first = plan.v[k], turning = first + straight(plan.kind[k]), last = first + freedoms(plan.kind[k]);
    for (int j = first; j < last; j++) {
      const V *s0 = start_axes + S * j, *s1 = axes + S * j;
      V* s = chord_axes + S * j;
      for (int a = 0; a < (j < turning ? S : T); a++) s[a] = blended(share, s0[a], s1[a]);
      if (j >= turning) about<D>(p, s, s + T);
    }
  }

  // B of contacts, what turns the axes above: Gᵀ ω − tr G ω − g × v.
  static void bend(const V* bends, const V* force, const V* s, V* out) {
    V beside[T];
    transposed_times<T>(bends, s, out);
    lever<D>(force, s + T, beside);
    for (int i = 0; i < T; i++) out[i] = -(out[i] + beside[i]);
  }

  // w Y_j: what turning the axis of j on the chord does, by the twists that move it; `torque` about joint k there.
  void turn_axis(int k, int j, const V* torque, V* out) const {
    const V *s = axes + S * j, *force = pulls[k].force;
    for (int a = 0; a < S; a++) out[a] = V(0);
    if (plan.kind[k] == SLIDE) {
      lever<D>(s + T, force, out);
    } else if (j >= plan.v[k] + straight(plan.kind[k])) {
      swing<D>(chord_axes + S * j, force, out + T);
      lever<D>(now.position + D * k, out + T, out);
      if constexpr (D == 3) add_cross(s, torque, out);
    }
    for (int a = 0; a < S; a++) out[a] *= share;
  }

  // Within one joint: its own axes turn too, those of a free joint's translation do not.
  void within(int k, int j, const V* bent, const V* turning) {
    const int n = plan.nv, first = plan.v[k], rotation = plan.kind[k] == FREE ? first + 3 : first;
    if (j < rotation) return;
    for (int i = first; i < first + freedoms(plan.kind[k]); i++) {
      const V* t = axes + S * i;
      if (bent && i >= rotation) {
        const V half = V(0.5) * dot<T>(t, bent);
        matrix[i * n + j] += half;
        matrix[j * n + i] += half;
      }
      matrix[j * n + i] += along(t, turning);
    }
  }

  // The chord's slopes are those of components along the body's own axes; the exponential chart's are less by ½ [r]×.
  void lose_half_the_torque(int k) {
    const int n = plan.nv, i = plan.v[k] + straight(plan.kind[k]);
    V r[3];
    for (int a = 0; a < 3; a++) {
      const V* s = chord_axes + S * (i + a);
      r[a] = V(0.5) * (dot<T>(s, pulls[k].torque) + dot<D>(s + T, pulls[k].force));
    }
    matrix[i * n + i + 1] += r[2];
    matrix[i * n + i + 2] -= r[1];
    matrix[(i + 1) * n + i] -= r[2];
    matrix[(i + 1) * n + i + 2] += r[0];
    matrix[(i + 2) * n + i] += r[1];
    matrix[(i + 2) * n + i + 1] -= r[0];
  }
};

}  // namespace pbfd
