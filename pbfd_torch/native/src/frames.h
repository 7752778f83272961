// Frames that are made of as many steps as each world needs, as schedules/adaptive.py: every step is made twice, whole and as two
// halves; the halves are kept, and how far both end apart says how long the next one is to be.
#pragma once
#include <cmath>
#include "itinerary.h"

namespace pbfd {

constexpr double SAFETY = 0.9, SHRINK = 0.2, GROW = 3.0, ORDER = 3.0, EXPLICIT_ORDER = 5.0;  // of the error of one step

// What a lane makes: a step as a whole, or one of its halves; or it has made an explicit one, which knows its error without these.
enum Half { WHOLE, FIRST_HALF, SECOND_HALF, AT_ONCE };

constexpr double BRINK = 1e-6, REST = 1e-4;  // of the step, before a strike; of the frame, after it: less is not worth a step
constexpr int CUTS = 5;
constexpr double STILL = 0.01;  // of the accuracy: where something presses, less is not worth an extrapolation

// How far a lane is in a frame [s], and what that has cost.
template <class T> struct Frame : Tally<T> {
  T length, elapsed, pace, step, spacing;  // of the frame, of the next step, of this one, and of those that the state is known by
  Half half;
  int made;  // steps that are kept
  int cuts;  // how often this step has been cut short where something strikes
  // this one's halves: how they ended, and what was seen of them
  int ended[2], seen;
  T reached;

  void begin(T dt, T wish) {
    Tally<T>::begin();
    length = spacing = dt, pace = wish, elapsed = T(0), made = 0, this->status = EXPLICIT;
    set_out();
  }
  void set_out() {
    const T left = length - elapsed;
    step = left / std::ceil(left / std::fmin(pace, left) - T(1e-6)), half = WHOLE, seen = 0, reached = T(0), cuts = 0;
  }
  // Whether a step that something strikes in, after this share of it, had better end there; then it does.
  bool cut(T share) {
    if (half != WHOLE || cuts == CUTS || share <= T(BRINK) || length - elapsed - share * step < T(REST) * length) return false;
    return step *= share, cuts++, true;
  }
  T next() const { return half == WHOLE ? step : T(0.5) * step; }
  bool over() const { return !(length - elapsed > T(1e-9) * length); }

  void spend(const Tally<T>& tried) {
    this->evaluations += tried.evaluations, this->iterations += tried.iterations;
    for (int i = 0; i < FALLBACKS; i++) this->counts[i] += tried.counts[i];
  }
  // All that is tried costs; how well the step is solved is said by its halves.
  void add(const Tally<T>& tried) {
    spend(tried);
    if (half == WHOLE && tried.status == EXPLICIT) half = AT_ONCE, ended[0] = EXPLICIT;
    if (half == WHOLE) return;
    ended[half != FIRST_HALF] = tried.status, seen |= tried.hazards;
    if (tried.error > reached) reached = tried.error;
  }
  // Both halves are made, or the step was explicit, and the whole step ends so far off; whether they are kept.
  bool judge(const Rules& rules, T off) {
    const T accuracy = T(rules.accuracy), shortest = T(rules.shortest);
    const int worst = ended[0] > ended[1] ? ended[0] : ended[1];
    const bool broken = ended[1] == NON_FINITE, solved = worst <= HALVED;
    const bool taken = broken || step <= T(1.001) * shortest || (off <= accuracy && solved);
    T factor = T(SAFETY) * std::pow(accuracy / off, T(1 / (half == AT_ONCE ? EXPLICIT_ORDER : ORDER)));
    factor = factor < T(SHRINK) || factor != factor ? T(SHRINK) : factor > T(GROW) ? T(GROW) : factor;
    if (!taken && factor > T(0.5)) factor = T(0.5);
    const T wish = step * factor;
    if (!cuts || wish > pace || !taken) pace = wish < shortest ? shortest : wish > length ? length : wish;
    if (!taken) return false;
    const T share = half == AT_ONCE ? T(1) : T(0.5);
    elapsed = broken ? length : elapsed + step, spacing = share * step, made += half == AT_ONCE ? 1 : 2;
    this->hazards |= seen;
    if (worst > this->status) this->status = worst;
    if (reached > this->error) this->error = reached;
    return true;
  }
};

}  // namespace pbfd
