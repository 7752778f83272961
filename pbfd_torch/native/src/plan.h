// A scene as the core sees it: a tree of nodes (joints), what acts on its degrees of freedom, and contact candidates.
//
// The numbers are those of all worlds (N a scalar) or every world's own (N like V). `Plan` walks once over two arrays that
// native/plan.py has written in this order: this file and that one change together.
#pragma once
#include "vectors.h"

namespace pbfd {

enum Joint { HINGE, SLIDE, BALL, FREE };
inline int coordinates(int kind) { return kind == FREE ? 7 : kind == BALL ? 4 : 1; }
inline int freedoms(int kind) { return kind == FREE ? 6 : kind == BALL ? 3 : 1; }

struct Sizes {
  int nodes, nq, nv, nu, candidates, halvings;
};

template <class N> struct Plan : Sizes {
  // nodes, parents first; −1: the world
  const int *parent, *kind, *q, *v;
  const N *frame, *origin;  // [9], [3] on the parent at the joint's reference
  const N *axis, *reference;  // [3], [1]
  const N *mass, *center, *second;  // [1], [3], [9] ∫ρ (x − c)(x − c)ᵀ of all links on the node, in its frame
  // degrees of freedom
  const N *scale;  // what counts as a force of one
  const N *heft;   // [kg, kg m] what rounded positions weigh
  const N *turns;  // 1 where it rotates, else 0
  const N *share;  // θ of springs, damping and actuators (`Fitted`), 1 where all is implicit: [nv] of steps Δt, Δt/2, Δt/4 …
  const N *spring, *damping, *armature, *dry, *lower, *upper, *limit;
  const N *rest;  // [nq] of the springs
  // actuators
  const int *actuated_q, *actuated_v;
  const N *gear, *gain, *bias, *stiffness, *resistance, *least_control, *most_control, *least_force, *most_force;
  // contact candidates, each against one half-space
  const int* carrier;  // node
  const N *position, *radius, *margin, *firmness, *grip, *normal, *offset;  // [3] on the node, …, [3] in the world
  const N *deep;  // from which depth on it is a hazard
  // the scene
  const N *gravity;  // [3]
  const N *reach;    // [m]
  const N *release, *slip_speed, *limit_release, *dry_speed;

  Plan() = default;
  Plan(Sizes sizes, const int* ints, const N* numbers) : Sizes(sizes) {
    auto whole = [&](int count) { const int* here = ints; ints += count; return here; };
    auto real = [&](int count) { const N* here = numbers; numbers += count; return here; };
    parent = whole(nodes), kind = whole(nodes), q = whole(nodes), v = whole(nodes);
    actuated_q = whole(nu), actuated_v = whole(nu);
    carrier = whole(candidates);
    frame = real(9 * nodes), origin = real(3 * nodes), axis = real(3 * nodes), reference = real(nodes);
    mass = real(nodes), center = real(3 * nodes), second = real(9 * nodes);
    scale = real(nv), heft = real(nv), turns = real(nv), share = real(nv * (1 + halvings));
    spring = real(nv), damping = real(nv), armature = real(nv), dry = real(nv);
    lower = real(nv), upper = real(nv), limit = real(nv), rest = real(nq);
    gear = real(nu), gain = real(nu), bias = real(nu), stiffness = real(nu), resistance = real(nu);
    least_control = real(nu), most_control = real(nu), least_force = real(nu), most_force = real(nu);
    position = real(3 * candidates), radius = real(candidates), margin = real(candidates), firmness = real(candidates);
    grip = real(candidates), normal = real(3 * candidates), offset = real(candidates), deep = real(candidates);
    gravity = real(3), reach = real(1), release = real(1), slip_speed = real(1), limit_release = real(1), dry_speed = real(1);
  }

  static int whole_numbers(Sizes s) { return 4 * s.nodes + 2 * s.nu + s.candidates; }
  static int real_numbers(Sizes s) { return 29 * s.nodes + (11 + s.halvings) * s.nv + s.nq + 9 * s.nu + 12 * s.candidates + 8; }
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

}  // namespace pbfd
