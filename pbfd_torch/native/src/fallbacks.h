// Detours to a better start where the direct way finds no root, as solvers/fallbacks.py: for one lane, what it solves next.
#pragma once
#include "newton.h"

namespace pbfd {

// An easier problem: multiples of the friction's width, of the stiffness, and of the step's length as inertia sees it.
struct Stage {
  double width, firmness, length;
  bool lagged;  // its friction feels the normal forces where it starts
};

constexpr Stage PLAIN = {1, 1, 1, false}, LAGGED = {1, 1, 1, true};
constexpr Stage shorter(double length) { return {1, 1, length, false}; }
constexpr Stage wider(double width) { return {width, 1, 1, false}; }
constexpr Stage softer(double firmness) { return {1, firmness, 1, false}; }

// Easier problems in turn, each solved to the tolerance from where the one before it ended, the first from θ_n; then the step's
// own, with at most `last` evaluations.
struct Detour {
  int kind;  // its place among the fallbacks that are counted, −1: none
  Status status;  // of a world that it helped
  bool from_guess;
  int last, stages;
  double tolerance;
  Stage stage[4];
};

constexpr int WAYS = 5, DIRECTLY = -1, ALONG = 0;
constexpr int SOON = 40, DIRECT = 200, CLIMB = 60, LAST = 100, LONG = 60;  // evaluations

constexpr Detour DETOURS[WAYS] = {
    // along the motion, for roots that have strayed
    {1, CONTINUED, false, CLIMB, 4, 1e-2, {shorter(1.0 / 256), shorter(1.0 / 64), shorter(1.0 / 16), shorter(0.25)}},
    {0, WARM_STARTED, false, LAST, 2, 1e-2, {LAGGED, LAGGED}},
    {1, CONTINUED, false, LAST, 3, 1e-1, {wider(1000), wider(100), wider(10)}},
    {1, CONTINUED, false, LAST, 3, 1e-2, {softer(1e-3), softer(1e-2), softer(1e-1)}},
    // the direct way from the guess: the retreat from it may have been the mistake
    {-1, SOLVED, true, LAST, 0, 0, {}}};

enum Start { GUESS_OR_RETREAT, GUESS, BEGINNING, HERE };

template <class T> struct Fallbacks {
  int way, stage;  // which detour it is on; stage = its number of stages: on the step's own problem
  bool astray;
  // the best end so far
  int status;
  T error;

  void begin() { way = DIRECTLY, stage = 0; }

  // What is being solved, and from where.
  bool on_a_stage() const { return way != DIRECTLY && stage < DETOURS[way].stages; }
  Stage problem() const { return on_a_stage() ? DETOURS[way].stage[stage] : PLAIN; }
  double tolerance(double tight) const { return on_a_stage() ? DETOURS[way].tolerance : tight; }
  int most(int direct) const { return way == DIRECTLY ? direct : on_a_stage() ? CLIMB : DETOURS[way].last; }
  Start start() const {
    if (way == DIRECTLY) return GUESS_OR_RETREAT;
    return DETOURS[way].from_guess ? GUESS : stage == 0 ? BEGINNING : HERE;
  }

  // Whether it counts that the end of a solve has strayed: roots found after a long search are doubted.
  bool doubts(int ended, int evaluations) const {
    const bool found = ended == SOLVED && evaluations > LONG;
    return way == DIRECTLY ? found || (ended != SOLVED && ended != NON_FINITE) : found && !on_a_stage() && way != ALONG;
  }

  // A solve has ended with this error; `strayed` is known where `doubts` says so. `better`: whether that is the best end so far;
  // `afford` says whether so many evaluations more may be spent, and `count` is told of detours that are taken. Whether another
  // solve is to follow.
  template <class Afford, class Count>
  bool go_on(int ended, T reached, bool strayed, double tight, bool& better, Afford&& afford, Count&& count) {
    better = false;
    if (on_a_stage()) return stage++, true;
    if (ended == SOLVED && strayed) ended = STALLED;
    if (way == DIRECTLY) {
      better = true, astray = strayed, status = ended, error = reached;
    } else if (ended == SOLVED || reached < error) {
      better = true, status = ended == SOLVED ? int(DETOURS[way].status) : ended, error = reached;
    }
    while (++way < WAYS) {
      const Detour& next = DETOURS[way];
      if (status <= HALVED || status == NON_FINITE) return false;
      if (way == ALONG ? !astray : error <= T(tight)) continue;
      if (!afford(next.stages * CLIMB + next.last)) continue;
      stage = 0;
      if (next.kind >= 0) count(next.kind);
      return true;
    }
    return false;
  }
};

}  // namespace pbfd
