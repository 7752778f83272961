// What one call of the machine is asked for, and leaves: arrays as interface.h has them.
#pragma once
#include "carriers.h"
#include "itinerary.h"

namespace pbfd {

// How steps were made, for those who follow them back: each as 2^halved parts, of which it is listed what easier step they are, and
// where they end. Null: nobody asks.
template <class T> struct Ways {
  int *halved, *eased;
  T* ends;

  template <class V> void note(long to, int easier, int i, const V* q, int nq) const {
    eased[to] = easier;
    for (int j = 0; j < nq; j++) ends[to * nq + j] = lane(q[j], i);
  }
};

// What frames are given and leave beside states, see frames.h: how long the next step had better be, of how many steps they are
// made, and the states before the last of these and its length. Null where steps are no frames.
template <class T> struct Frames {
  const T* wish;
  T *pace, *spacing;
  int* made;
  void* const* before_last;

  void note(long to, T next, T length, int steps) const { pace[to] = next, spacing[to] = length, made[to] = steps; }
};

// How far the ends of explicit steps are off, as estimated, 0: the step was none; and after what share of one something would have
// struck, 1: nothing. Null where there are none.
template <class T> struct Explicit {
  T *estimate, *strike;

  void note(long to, T off, T share) const { estimate[to] = off, strike[to] = share; }
};

template <class T> struct Journey {
  int worlds, steps;
  bool held, alike;  // one control for all steps; one length of steps for all worlds
  const T* dt;
  const void* const* given;
  const T* control;
  void* const* found;
  T* residual_norm;
  int *status, *evaluations, *iterations, *hazards, *fallbacks;
  Timetable<T> timetable;
  Ways<T> ways;
  Frames<T> frames;
  Explicit<T> explicitly;

  long at(int step, int world) const { return long(step) * worlds + world; }
  T step(int world) const { return dt[alike ? 0 : world]; }

  // The state of a lane, from what a world is given, and to a step's place in arrays.
  template <class State> void load(int world, int i, Sizes s, State& x) const {
    int k = 0;
    State::each(s, [&](auto member, int width) {
      const T* array = static_cast<const T*>(given[k++]) + long(world) * width;
      for (int j = 0; j < width; j++) put((x.*member)[j], i, array[j]);
    });
  }
  template <class State> static void store(long to, int i, Sizes s, const State& x, void* const* arrays) {
    int k = 0;
    State::each(s, [&](auto member, int width) {
      T* array = static_cast<T*>(arrays[k++]) + to * width;
      for (int j = 0; j < width; j++) array[j] = lane((x.*member)[j], i);
    });
  }
  void report(long to, const Tally<T>& tally) const {
    residual_norm[to] = tally.error, status[to] = tally.status, hazards[to] = tally.hazards;
    evaluations[to] = tally.evaluations, iterations[to] = tally.iterations;
    for (int j = 0; j < FALLBACKS; j++) fallbacks[to * FALLBACKS + j] = tally.counts[j];
  }
};

}  // namespace pbfd
