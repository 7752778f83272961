// The balance of forces of one step at one configuration: residual r and exact Jacobian J (METHOD §3), as balance/assembly.py and
// balance/chords.py.
//
// For a dof i at or above dof j, with sums over all that j's joint moves: loads at the end of the step give
//   r_i = s_i · W,  J_ij = s_iᵀ A s_j + s_iᵀ B s_j,  J_ji = s_jᵀ A s_i + s_iᵀ B s_j;
// inertia on the chord, s̄ the twists there and w its share,
//   r_i = s̄_i · W,  ∂r_i/∂θ_j = s̄_iᵀ (A + w B) s_j + w s_j · Y_i.
#pragma once
#include "contact.h"
#include "inertia.h"
#include "joints.h"

namespace pbfd {

template <class V, class N> struct Balance {
  const Plan<N>& plan;
  // what is fixed in a step
  Poses<V> start, target;
  V *q_start, *q_target, *control, *fitted;
  V dt, weight, share;  // share = 1: inertia works at the end of the step
  V inert;              // κ over the square of the length that inertia knows of
  Relaxed<V> relaxed;
  bool on_chord;
  // at the configuration
  Poses<V> now, chord;
  V *axes, *chord_axes, *residual, *matrix, *turns;
  Pull<V>* pulls;
  Push<V>* pushes;
  bool* turned;

  static int room(Sizes s) {  // in V, for the arena
    const int loads = int((sizeof(Pull<V>) + sizeof(Push<V>)) / sizeof(V)) + 3;
    return s.nodes * (48 + 3 + loads) + 2 * s.nq + s.nu + 14 * s.nv + s.nv * s.nv + s.candidates;
  }

  Balance(const Plan<N>& scene, Arena<V>& arena) : plan(scene) {
    start = Poses<V>::in(arena, plan), target = Poses<V>::in(arena, plan);
    now = Poses<V>::in(arena, plan), chord = Poses<V>::in(arena, plan);
    q_start = arena.take(plan.nq), q_target = arena.take(plan.nq), control = arena.take(plan.nu);
    fitted = arena.take(plan.nv), relaxed.held = arena.take(plan.candidates);
    relaxed.none();
    axes = arena.take(6 * plan.nv), chord_axes = arena.take(6 * plan.nv);
    residual = arena.take(plan.nv), matrix = arena.take(plan.nv * plan.nv), turns = arena.take(3 * plan.nodes);
    pulls = reinterpret_cast<Pull<V>*>(arena.take(plan.nodes * int(sizeof(Pull<V>) / sizeof(V))));
    pushes = reinterpret_cast<Push<V>*>(arena.take(plan.nodes * int((sizeof(Push<V>) + sizeof(V) - 1) / sizeof(V))));
    turned = reinterpret_cast<bool*>(arena.take((plan.nodes * int(sizeof(bool)) + int(sizeof(V)) - 1) / int(sizeof(V))));
  }

  // All of it at q; the matrix by `assemble`.
  void evaluate(const V* q) {
    place(plan, q, now);
    motion_axes(plan, now, axes);
    if (on_chord) {
      for (int i = 0; i < 9 * plan.nodes; i++)
        chord.rotation[i] = fma(share, now.rotation[i] - start.rotation[i], start.rotation[i]);
      for (int i = 0; i < 3 * plan.nodes; i++)
        chord.position[i] = fma(share, now.position[i] - start.position[i], start.position[i]);
      motion_axes(plan, chord, chord_axes);
    }
    for (int k = 0; k < plan.nodes; k++) {
      pushes[k].any = false;
      if (any(V(plan.mass[k]) > V(0)))
        pull(plan, k, inert, share, start, target, now, pulls[k]);
      else
        pulls[k].clear();  // a joint that only leads to others
    }
    contacts(plan, ContactStep<V>{start, dt, relaxed}, now, pushes, turns, turned);
    for (int k = plan.nodes - 1; k > 0; k--)
      if (plan.parent[k] >= 0) {
        pulls[plan.parent[k]].add(pulls[k]);
        if (pushes[k].any) pushes[plan.parent[k]].add(pushes[k]);
      }
    for (int i = 0; i < plan.nv; i++) residual[i] = V(0);
    joint_loads(plan, steps(), q, residual, static_cast<V*>(nullptr));
    for (int k = 0; k < plan.nodes; k++)
      for (int j = plan.v[k]; j < plan.v[k] + freedoms(plan.kind[k]); j++) {
        residual[j] += worked(inertial_axis(j), pulls[k].moment, pulls[k].force);
        if (pushes[k].any) residual[j] += worked(axes + 6 * j, pushes[k].moment, pushes[k].force);
      }
  }

  // J, or with `curved` false the stiffness: J without how the axes turn under the forces.
  void assemble(const V* q, bool curved) {
    const int n = plan.nv;
    for (int i = 0; i < n * n; i++) matrix[i] = V(0);
    for (int k = 0; k < plan.nodes; k++) {
      const Pull<V>& pull = pulls[k];
      const Push<V>& push = pushes[k];
      const int first = plan.v[k], last = first + freedoms(plan.kind[k]);
      for (int j = first; j < last; j++) {
        const V *s = axes + 6 * j, *s_chord = inertial_axis(j);
        V below[6], above[6], bent[3] = {};  // A s_j, Aᵀ s̄_j, and what turns the axes above under the forces
        answer(pull, s, curved && on_chord, below);
        answer_above(pull, s_chord, curved && on_chord, above);
        V below_push[6] = {}, above_push[6] = {};
        if (push.any)
          for (int a = 0; a < 6; a++) {
            below_push[a] = above_push[a] = V(0);
            for (int b = 0; b < 6; b++) {
              below_push[a] = fma(push.stiffness[6 * a + b], s[b], below_push[a]);
              above_push[a] = fma(push.stiffness[6 * b + a], s[b], above_push[a]);
            }
          }
        V turning[6] = {};
        if (curved && on_chord) turn_axis(k, j, turning);
        if (curved) bend(k, s, bent);
        for (int up = k; up >= 0; up = plan.parent[up]) {
          const int from = plan.v[up], to = up == k ? last : from + freedoms(plan.kind[up]);
          for (int i = from; i < to; i++) {
            const V *t = axes + 6 * i, *t_chord = inertial_axis(i);
            V upper = along(t_chord, below);
            if (push.any) upper += along(t, below_push);
            matrix[i * n + j] += upper;
            if (up == k) continue;  // the row of j itself comes with i and j exchanged
            V lower = along(t, above);
            if (push.any) lower += along(t, above_push);
            if (curved) {
              const V carried = dot(t, bent);
              matrix[i * n + j] += carried;
              lower += carried;
              if (on_chord) lower = fma(share, along(t, turning), lower);
            }
            matrix[j * n + i] += lower;
          }
        }
        if (curved) within(k, j, first, last, bent, turning);
      }
    }
    if (curved && on_chord) lose_half_the_torque();
    joint_loads(plan, steps(), q, static_cast<V*>(nullptr), matrix);
  }

  JointStep<V> steps() const { return {q_start, q_target, control, fitted, dt, inert, relaxed}; }

 private:
  const V* inertial_axis(int j) const { return (on_chord ? chord_axes : axes) + 6 * j; }
  static V along(const V* a, const V* b) { return dot(a, b) + dot(a + 3, b + 3); }

  // A s, or (A + w B) s where the points move on the chord.
  void answer(const Pull<V>& p, const V* s, bool moved, V* out) const {
    p.answer(s, out);
    if (!moved) return;
    const V *w = s, *v = s + 3;
    V torque[3], beside[3];
    const V whole = trace(p.at_end);
    transposed_times(p.at_end, w, torque);
    cross(p.force, v, beside);
    for (int i = 0; i < 3; i++) out[i] = fma(share, torque[i] - whole * w[i] - beside[i], out[i]);
  }

  // Aᵀ s̄, or (A + w B)ᵀ s̄.
  void answer_above(const Pull<V>& p, const V* s, bool moved, V* out) const {
    const V *w = s, *v = s + 3, sum = trace(p.second);
    transposed_times(p.second, w, out);
    for (int i = 0; i < 3; i++) out[i] = fma(sum, w[i], -out[i]), out[3 + i] = p.mass * v[i];
    add_cross(p.first, v, out);
    add_cross(w, p.on_chord, out + 3);
    if (!moved) return;
    V torque[3], beside[3];
    const V whole = trace(p.at_end);
    times(p.at_end, w, torque);
    cross(p.force, w, beside);
    for (int i = 0; i < 3; i++) {
      out[i] = fma(share, torque[i] - whole * w[i], out[i]);
      out[3 + i] = fma(share, beside[i], out[3 + i]);
    }
  }

  // Bᵀ of loads at the end of the step: Gᵀ ω − tr G ω − g × v.
  void bend(int k, const V* s, V* out) const {
    for (int i = 0; i < 3; i++) out[i] = V(0);
    if (!on_chord) add_bend(pulls[k].moment, pulls[k].force, s, out);
    if (pushes[k].any) add_bend(pushes[k].moment, pushes[k].force, s, out);
  }
  static void add_bend(const V* moment, const V* force, const V* s, V* out) {
    V turned_[3], beside[3];
    const V sum = trace(moment);
    transposed_times(moment, s, turned_);
    cross(force, s + 3, beside);
    for (int i = 0; i < 3; i++) out[i] += turned_[i] - sum * s[i] - beside[i];
  }

  // Y_j: what turning the axis of j on the chord does, by the twists that move it.
  void turn_axis(int k, int j, V* out) const {
    const V *s = axes + 6 * j, *at = now.position + 3 * k, *middle = chord.position + 3 * k, *force = pulls[k].force;
    const V* moment = pulls[k].moment;
    V torque[3] = {moment[7] - moment[5], moment[2] - moment[6], moment[3] - moment[1]};
    V beside[3], slide[3], pulled[3];
    cross(middle, force, beside);
    for (int i = 0; i < 3; i++) torque[i] -= beside[i];
    cross(at, s, beside);
    for (int i = 0; i < 3; i++) slide[i] = s[3 + i] - beside[i];
    cross(force, chord_axes + 6 * j, pulled);
    cross(s, torque, out);
    add_cross(slide, force, out);
    cross(at, pulled, beside);
    for (int i = 0; i < 3; i++) out[i] -= beside[i], out[3 + i] = -pulled[i];
  }

  // Within one joint: its own axes turn too, those of a free joint's translation do not.
  void within(int k, int j, int first, int last, const V* bent, const V* turning) {
    const int n = plan.nv, rotation = plan.kind[k] == FREE ? first + 3 : first;
    if (j < rotation) return;
    for (int i = first; i < last; i++) {
      const V* t = axes + 6 * i;
      if (i >= rotation) {
        const V half = V(0.5) * dot(t, bent);
        matrix[i * n + j] += half;
        matrix[j * n + i] += half;
      }
      if (on_chord) matrix[j * n + i] = fma(share, along(t, turning), matrix[j * n + i]);
    }
  }

  // The chord's slopes are those of components along the body's own axes; the exponential chart's are less by ½ [r]×.
  void lose_half_the_torque() {
    const int n = plan.nv;
    for (int k = 0; k < plan.nodes; k++) {
      if (plan.kind[k] == HINGE || plan.kind[k] == SLIDE) continue;
      const int i = plan.v[k] + (plan.kind[k] == FREE ? 3 : 0);
      V r[3];
      for (int a = 0; a < 3; a++) r[a] = V(0.5) * worked(chord_axes + 6 * (i + a), pulls[k].moment, pulls[k].force);
      matrix[i * n + i + 1] += r[2];
      matrix[i * n + i + 2] -= r[1];
      matrix[(i + 1) * n + i] -= r[2];
      matrix[(i + 1) * n + i + 2] += r[0];
      matrix[(i + 2) * n + i] += r[1];
      matrix[(i + 2) * n + i + 1] -= r[0];
    }
  }
};

}  // namespace pbfd
