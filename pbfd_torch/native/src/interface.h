// What the library offers to Python: plain C functions, called by ctypes (pbfd_torch/native/library.py).
#pragma once

#define PBFD_FUNCTION extern "C" __attribute__((visibility("default")))

// The version of this interface. A change of it here is a change of INTERFACE in library.py.
PBFD_FUNCTION int pbfd_interface();

// How many worlds one register holds, for scalars of 8 or 4 bytes.
PBFD_FUNCTION int pbfd_lanes(int bytes);

// The kind of processor that the library is compiled for: "x86-64-v4", ...
PBFD_FUNCTION const char* pbfd_target();

// A scene as plan.h reads it. Scalars are of 8 or 4 bytes, `numbers` and all arrays below alike.
struct pbfd_plan {
  int bytes, nodes, nq, nv, nu, candidates, planes, solids, samples, forms, pushes;
  const int* whole;
  const void* real;
};

// One step of worlds `first` … `last` − 1, each array [count, worlds]:
//   given: q, v, push, steady, lag, average, gained, surplus, peak of the state (`Velocities`), and the control;
//   found: the same of the state after the step, and ‖r/scale‖; counted: status, evaluations, iterations, refused, hazards.
struct pbfd_step {
  double dt, tolerance, surplus;
  int evaluations;  // at most, of each world
  int worlds, first, last;
  const void* given[10];
  void* found[10];
  int* counted[5];
  const void* grip;  // μ of the candidates, [candidates, worlds]; null: the plan's
};

// How many whole numbers and scalars the arrays of a plan hold, and the room [bytes] that a step needs, aligned to 64.
PBFD_FUNCTION long pbfd_whole_numbers(const pbfd_plan*);
PBFD_FUNCTION long pbfd_real_numbers(const pbfd_plan*);
PBFD_FUNCTION long pbfd_room(const pbfd_plan*);

// The energy–momentum step by Newton's method from the guess or from θ_n: what it leaves unsolved, and what it refuses, it says.
PBFD_FUNCTION void pbfd_energy_momentum(const pbfd_plan*, const pbfd_step*, void* room);

// The balance of forces that a step from the given states solves, at configurations [nq, worlds]: r [nv, worlds] and
// J [nv · nv, worlds].
PBFD_FUNCTION void pbfd_balance(const pbfd_plan*, const pbfd_step*, const void* q, void* residual, void* jacobian, void* room);
