// What the library offers to Python: plain C functions, called by ctypes (pbfd_torch/native/library.py).
#pragma once

#define PBFD_FUNCTION extern "C" __attribute__((visibility("default")))

// The version of this interface. A change of it here is a change of INTERFACE in library.py.
PBFD_FUNCTION int pbfd_interface();

// How many worlds one register holds, for scalars of 8 or 4 bytes.
PBFD_FUNCTION int pbfd_lanes(int bytes);

// The kind of processor that the library is compiled for: "x86-64-v4", ...
PBFD_FUNCTION const char* pbfd_target();

// A scene as plan.h reads it, in space or, with dimension 2, in a plane. Scalars are of 8 or 4 bytes, those of all arrays below too.
struct pbfd_plan {
  int bytes, dimension, nodes, nq, nv, nu, candidates, anchors, planes, solids, samples, forms, uncommon, pushes;
  int varied;  // numbers of which each world has its own: others than μ in space only
  const int* whole;
  const void* real;
  const void* sample;  // of terrain and meshes
  const int* which;    // [varied] of `real`, in order
  // contact between bodies, in space only, as bodies.h reads it
  int links = 0, groups = 0, rows = 0, pairs = 0, colliders = 0, slots = 0, remembered = 0;
  const int* body_whole = nullptr;
  const void* body_real = nullptr;
  int moving = 0;  // obstacles in prescribed motion, in space only
};

// Steps of worlds `first` … `last` − 1. Each array is [worlds, count], or [steps, worlds, count].
//   given: of the state that each world goes on from: q, v, push, steady, lag, average, gained, surplus, peak (`Velocities`), or q,
//     q_previous, acceleration (`Positions`), or q, history, moves, push (`FourPoses`); and what anchors remember, [3 · anchors + remembered], where there are any;
//   control: [worlds, nu] for all steps if `held`, else [steps, worlds, nu];
//   found: what is given, after each step, [steps, …];
//   residual_norm, counted (status, evaluations, iterations, hazards): [steps, worlds]; fallbacks: [steps, worlds, 4].
struct pbfd_steps {
  const void* dt;  // [s], of all worlds, or [worlds] of each
  int alike;       // whether it is that of all
  int halvings;    // how often a step may be halved
  double tolerance;
  double surplus;  // of energy–momentum
  double share;    // of the chord at which inertia works: 1 implicit Euler, less the variational scheme
  double jump;     // of BDF2 [weights]
  int evaluations;  // at most, of each world in each step, with all that is tried
  int worlds, first, last;
  int steps, held;
  const void* given[10];
  const void* control;
  void* found[10];
  void* residual_norm;
  int* counted[4];
  int* fallbacks;
  const void* own;   // [worlds, varied] the worlds' own numbers
  void* trial[7];    // of starts: room for what their trial is given but q, and for what it finds, of `Positions`
  // where the obstacles that move are at the ends of all parts of all steps, [2^halvings · steps + 1, timed, moving, 12], see
  // `Timetable`; timed: 1, or all worlds
  const void* poses = nullptr;
  int timed = 1;
  // how steps were made, see `Ways`: [steps, worlds], [steps, worlds, 2^halvings] and [steps, worlds, 2^halvings, nq]; null: not asked
  int *halved = nullptr, *eased = nullptr;
  void* ends = nullptr;
  // of frames, if accuracy > 0, see `Frames`: [worlds], and [steps, worlds, …]; nothing moves but the bodies
  double accuracy = 0, shortest = 0;
  const void* wish = nullptr;
  void *pace = nullptr, *spacing = nullptr;
  int* made = nullptr;
  void* before_last[10] = {};
  // of explicit steps, if trust > 0, see `RungeKutta` and `Explicit`: [steps, worlds]
  double trust = 0;
  void *estimate = nullptr, *strike = nullptr;
};

// How many whole numbers and scalars the arrays of a plan hold, and the room [bytes] that a step needs, aligned to 64.
PBFD_FUNCTION long pbfd_whole_numbers(const pbfd_plan*);
PBFD_FUNCTION long pbfd_real_numbers(const pbfd_plan*);
PBFD_FUNCTION long pbfd_room(const pbfd_plan*);

// Steps by Newton's method with all fallbacks.
PBFD_FUNCTION void pbfd_energy_momentum(const pbfd_plan*, const pbfd_steps*, void* room);
PBFD_FUNCTION void pbfd_implicit_euler(const pbfd_plan*, const pbfd_steps*, void* room);
PBFD_FUNCTION void pbfd_bdf2(const pbfd_plan*, const pbfd_steps*, void* room);  // in space only

// Steps followed back, in double precision. Arrays as in `pbfd_steps`:
//   given, control: what the steps were given, `found`: the states after each, [steps, …];
//   detour: [steps, worlds] which row of `halved`, `eased` and `ends` (see `pbfd_steps`) says how a step was made, −1: as itself;
//   constant: [steps, worlds] not 0 where a step's end counts as a constant, or null; dropped: so does that of one whose J is singular;
//   refined: the ends were found in single precision, and one of Newton's steps improves them;
//   cotangent: [rows, worlds, …] derivatives by the last state, which become those by what was given;
//   seen: [steps, worlds, …] of derivatives by the states after each step, to be added to these, or null;
//   by_control: [rows, steps, worlds, nu] becomes the derivatives by controls; singular: [steps, worlds] where J is. Several rows
//   are for one step;
//   by_number: [worlds, numbers of the plan] and by_dt: [worlds], to which those by these are added, or null; of one row.
struct pbfd_descent {
  const void* dt;
  int alike, halvings, worlds, first, last, steps, rows, held, refined, dropped;
  double share, jump;
  const void *given[10], *found[10];
  const void* control;
  const void* own;
  const void* poses;
  int timed;
  const int *detour, *halved, *eased;
  const void* ends;
  const int* constant;
  void* cotangent[10];
  void* seen[10];
  void *by_control, *by_number, *by_dt;
  int* singular;
};

PBFD_FUNCTION void pbfd_energy_momentum_back(const pbfd_plan*, const pbfd_descent*, void* room);
PBFD_FUNCTION void pbfd_implicit_euler_back(const pbfd_plan*, const pbfd_descent*, void* room);
PBFD_FUNCTION void pbfd_bdf2_back(const pbfd_plan*, const pbfd_descent*, void* room);
// The same ahead, of one row: cotangent, by_control, by_number and by_dt are changes of what the steps are made of, or null (the last
// two), and `seen` becomes the changes of the states after each.
PBFD_FUNCTION void pbfd_energy_momentum_ahead(const pbfd_plan*, const pbfd_descent*, void* room);
PBFD_FUNCTION void pbfd_implicit_euler_ahead(const pbfd_plan*, const pbfd_descent*, void* room);
PBFD_FUNCTION void pbfd_bdf2_ahead(const pbfd_plan*, const pbfd_descent*, void* room);

// States at t = 0 of worlds that are given by q, v and one control, found as after one step. What is reported is the trial step.
PBFD_FUNCTION void pbfd_start_energy_momentum(const pbfd_plan*, const pbfd_steps*, void* room);
PBFD_FUNCTION void pbfd_start_implicit_euler(const pbfd_plan*, const pbfd_steps*, void* room);
PBFD_FUNCTION void pbfd_start_bdf2(const pbfd_plan*, const pbfd_steps*, void* room);

// What a record lists beside what a plan in space knows.
//   carrier: node of each link, −1: it rides on the world; slot: the place of each of the plan's candidates among all `slots` of a
//   row of contacts; danger: its number among the dangers; first_limit: that of the first dof's limit, −1: there are none;
//   real: [12 · links + 7], of each world if it is their `own`, else of all: frames of the links where they are, rotation and
//   position [3 × 4], row by row; the mass of all links; and of what rides on the world Σ m x [3], its energy, and the strain of the
//   candidate there that is deepest beyond its measure, −∞: there is none, and its number.
struct pbfd_roster {
  int links, slots, first_limit, own;
  const int *carrier, *slot, *danger;
  const void* real;
  const int *meeting_slot = nullptr, *meeting_danger = nullptr;  // the first ones of each group of pairs of bodies
};

// The record of steps `first` … `last` − 1 of all steps of all worlds that have been made, where world w makes its steps w,
// worlds + w, 2 worlds + w …: `given` and `found` as in pbfd_steps, where only what they hold is read; hazards: of each step;
//   q, v, link_poses [links, 12], center_of_mass [3], kinetic_energy, potential_energy, linear_momentum [3], angular_momentum [3]:
//     of the state after each step, [steps, …];
//   contact_depth [slots], contact_point, contact_normal, contact_force, contact_slip [slots, 3], suspect: of each step, [steps, …];
//     if suspect is null nothing of these is asked for, and what is `given` does not count.
// Of frames, what is `given` are the states before the last of their steps, and `spacing` its length, [steps, …].
struct pbfd_record {
  const void* dt;
  int alike;
  const void* spacing;
  int worlds, first, last;
  const void* given[10];
  const void* found[10];
  const int* hazards;
  const void* own;  // see pbfd_steps
  void *q, *v, *link_poses, *center_of_mass, *kinetic_energy, *potential_energy, *linear_momentum, *angular_momentum;
  void *contact_depth, *contact_point, *contact_normal, *contact_force, *contact_slip;
  int* suspect;
  const void* poses = nullptr;  // as of pbfd_steps, at the ends of all steps, [steps + 1, …]
  int timed = 1;
};

PBFD_FUNCTION void pbfd_energy_momentum_record(const pbfd_plan*, const pbfd_roster*, const pbfd_record*, void* room);
PBFD_FUNCTION void pbfd_implicit_euler_record(const pbfd_plan*, const pbfd_roster*, const pbfd_record*, void* room);
PBFD_FUNCTION void pbfd_bdf2_record(const pbfd_plan*, const pbfd_roster*, const pbfd_record*, void* room);

// The balance of forces that energy–momentum steps from the given states solve, at configurations [worlds, nq]: r [worlds, nv] and
// J [worlds, nv · nv].
PBFD_FUNCTION void pbfd_balance(const pbfd_plan*, const pbfd_steps*, const void* q, void* residual, void* jacobian, void* room);

// Contact points of pairs of convex shapes, see hulls.h and finding.h: pairs [count, 3] a, b, whether both are boxes; poses
// [count, 2, 12]; moves [count]. counts [count, 2] count, swapped; found [count, 4 + 8 · 4] normal, offset, and each point with its
// gap; apart [count, 5] direction, separation along it, and distance.
PBFD_FUNCTION void pbfd_meet(int bytes, const int* whole, const void* real, int count, const int* pairs, const void* poses,
                             const void* moves, int* counts, void* found, void* apart);
