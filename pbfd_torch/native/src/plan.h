// A scene as the core sees it: a tree of nodes (joints), what acts on its degrees of freedom, and contact candidates. What moves in
// a plane only (hinges and slides, D = 2) is spared the third dimension: the same mechanics with fewer numbers.
//
// `Plan` walks once over two arrays that native/plan.py has written in this order: this file and that one change together.
#pragma once
#include "bodies.h"
#include "candidates.h"

namespace pbfd {

enum Joint { HINGE, SLIDE, BALL, FREE };
inline int coordinates(int kind) { return kind == FREE ? 7 : kind == BALL ? 4 : 1; }
inline int freedoms(int kind) { return kind == FREE ? 6 : kind == BALL ? 3 : 1; }
inline int straight(int kind) { return kind == FREE ? 3 : kind == SLIDE ? 1 : 0; }  // of these, the first

// Of a law: α, e, γ, μ_s − μ_k, 1/v_s [s/m]; restitution (0: none), and its threshold [m/s]; of torsional friction ℓμ [m] (0: none)
// and 1/ε_ω [s/rad].
constexpr int PARTICULARS = 9;

struct Sizes : CandidateSizes {
  int nodes, nq, nv, nu, pushes;
  BodySizes bodies = {};
  int moving = 0;  // obstacles

  int remembered() const { return 3 * anchors + bodies.remembered; }  // numbers that anchors remember
};

template <class N, int D = 3> struct Plan : Sizes {
  // nodes, parents first; −1: the world
  const int *parent, *kind, *q, *v;
  const int* plain;  // 1 where its frame is turned as the parent's
  const N *frame, *origin;  // [D × D], [D] on the parent at the joint's reference; slides move along its last axis
  const N *reference, *sense;  // hinges turn about z; in a plane, ahead or back: ±1
  const N *mass, *center, *second;  // [1], [D], [D × D] ∫ρ (x − c)(x − c)ᵀ of all links on the node, in its frame
  const N* carried;  // mass of it and of all that it moves
  // degrees of freedom
  const int *depth, *above;  // how many others a dof rides on, and which: [nv] each, the nearest first
  const N *scale;  // what counts as a force of one
  const N *heft;   // [kg, kg m] what rounded positions weigh
  const N *turns;  // 1 where it rotates, else 0
  const N *felt;   // inertia that springs, damping and actuators are fitted to, see fitted.h
  const N *spring, *damping, *armature, *dry, *lower, *upper, *limit;
  const N *rest;  // [nq] of the springs
  // actuators
  const int *actuated_q, *actuated_v;
  const N *gear, *gain, *bias, *stiffness, *resistance, *least_control, *most_control, *least_force, *most_force;
  Candidates<N, D> contact;
  // forces from outside
  const int* pushed;           // node
  const N *push_point, *push;  // [3] on the node, [3] in the world
  Bodies<typename Kind<N>::Scalar> pairing;
  const N* laws;               // [LAWS_OF_A_ROW · rows] of contact between bodies
  const int* manner;           // [uncommon] laws, see laws.h
  const N* particulars;        // [PARTICULARS · uncommon]
  // where obstacles move: which of them carries the solid of each contact candidate, −1: none; velocities [3] of belts in their frames
  const int* mover;
  const N* belt;
  // the scene
  const N *gravity;  // [D]
  const N *reach;    // [m]
  const N *limit_release, *limit_per_force, *dry_speed;

  Plan() = default;
  // `body_ints`, `body_reals`: of `pairing`.
  Plan(Sizes sizes, const int* ints, const N* numbers, const typename Kind<N>::Scalar* samples, const int* body_ints = nullptr,
       const typename Kind<N>::Scalar* body_reals = nullptr)
      : Sizes(sizes) {
    auto whole = [&](int count) { const int* here = ints; ints += count; return here; };
    auto real = [&](int count) { const N* here = numbers; numbers += count; return here; };
    parent = whole(nodes), kind = whole(nodes), q = whole(nodes), v = whole(nodes), plain = whole(nodes);
    depth = whole(nv), above = whole(nv * nv);
    actuated_q = whole(nu), actuated_v = whole(nu);
    frame = real(D * D * nodes), origin = real(D * nodes), reference = real(nodes), sense = real(nodes);
    mass = real(nodes), center = real(D * nodes), second = real(D * D * nodes), carried = real(nodes);
    scale = real(nv), heft = real(nv), turns = real(nv), felt = real(nv);
    spring = real(nv), damping = real(nv), armature = real(nv), dry = real(nv);
    lower = real(nv), upper = real(nv), limit = real(nv), rest = real(nq);
    gear = real(nu), gain = real(nu), bias = real(nu), stiffness = real(nu), resistance = real(nu);
    least_control = real(nu), most_control = real(nu), least_force = real(nu), most_force = real(nu);
    gravity = real(D), reach = real(1), limit_release = real(1), limit_per_force = real(1), dry_speed = real(1);
    contact = Candidates<N, D>(*this, ints, numbers, samples);
    pushed = whole(pushes), push_point = real(3 * pushes), push = real(3 * pushes);
    if (bodies.rows > 0) pairing = Bodies<typename Kind<N>::Scalar>(bodies, body_ints, body_reals);
    laws = real(LAWS_OF_A_ROW * bodies.rows);
    manner = whole(uncommon), particulars = real(PARTICULARS * uncommon);
    mover = whole(moving ? candidates : 0), belt = real(3 * moving);
  }

  static int whole_numbers(Sizes s) {
    return 5 * s.nodes + s.nv * (1 + s.nv) + 2 * s.nu + s.pushes + s.uncommon + (s.moving ? s.candidates : 0) +
           Candidates<N, D>::whole_numbers(s);
  }
  static int real_numbers(Sizes s) {
    return (2 * D * (D + 1) + 4) * s.nodes + 11 * s.nv + s.nq + 9 * s.nu + D + 4 + 6 * s.pushes +
           LAWS_OF_A_ROW * s.bodies.rows + PARTICULARS * s.uncommon + 3 * s.moving + Candidates<N, D>::real_numbers(s);
  }
};

// Memory that the caller owns, handed out piece by piece.
template <class V> struct Arena {
  V* next;
  V* take(int count) {
    V* here = next;
    next += count;
    return here;
  }
};

// Numbers of a plan, from `first` on, as the worlds in the lanes have them: what all worlds share, but for some, of which each world
// has a row of its own.
template <class V> struct Numbers {
  using T = typename Kind<V>::Scalar;
  int first, varied;
  const int* which;  // [varied] of all numbers of the plan
  const T* rows;     // [worlds, varied]
  V* lanes;

  Numbers(const T* real, int from, int count, int differing, const int* these, const T* own, Arena<V>& arena)
      : first(from), varied(differing), which(these), rows(own), lanes(arena.take(count)) {
    for (int j = 0; j < count; j++) lanes[j] = V(real[first + j]);
  }
  // A lane takes a world.
  void load(int i, int world) {
    for (int j = 0; j < varied; j++) put(lanes[which[j] - first], i, rows[long(world) * varied + j]);
  }
};

}  // namespace pbfd
