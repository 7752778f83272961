// How a world makes its step where the first attempt fails, as stepping/eager.py: for one lane, what it tries next. That is, in
// turn: shorter steps where these are worth more than an easier one, the scheme's easier steps, and 2, 4, 8 … shorter steps.
#pragma once
#include "fallbacks.h"
#include "state.h"

namespace pbfd {

enum Fallback { WARM_START, CONTINUATION, EASIER_STEP, HALVING, FALLBACKS };  // as they are counted

// What follows an attempt. The step has ended: here, at the best end so far, or with the last of its parts. Or else it is tried
// again as an easier one or from the first of shorter parts on, or the same part as an easier one; or the next part follows.
enum Then { END, END_AT_BEST, END_OF_PARTS, EASE, HALVE, EASE_PART, NEXT_PART };

// What has been spent, and how it ended, or its best end so far.
template <class T> struct Tally {
  int evaluations, iterations, counts[FALLBACKS], status, hazards;
  T error;

  void begin() {
    evaluations = iterations = status = hazards = 0, error = T(0);
    for (int& x : counts) x = 0;
  }
};

template <class T> struct Itinerary : Tally<T> {
  using Tally<T>::evaluations, Tally<T>::counts, Tally<T>::status, Tally<T>::hazards, Tally<T>::error;
  int easier;  // how many easier steps the scheme has
  // the attempt
  int halvings, part;  // of 2^halvings parts; 0: of the whole step
  int eased;           // which of the easier steps it is; 0: the step itself
  int limit, share;  // what `evaluations` may reach in it; what each part may spend
  // the step
  int tried, wanted;
  bool may_ease;  // parts
  int kept;       // which of the easier steps has the best end so far, as `eased`

  void begin(const Rules& rules, int steps) {
    Tally<T>::begin();
    halvings = part = tried = wanted = eased = kept = 0, easier = steps, limit = rules.evaluations;
  }

  bool whole() const { return halvings == 0; }
  bool first() const { return tried == 0; }
  // Whether it goes through all detours, and whether these count as the step's own. Where not, roots that have strayed are good
  // enough.
  bool led() const { return eased == easier; }
  bool own() const { return whole() && !eased; }
  bool affords(int cost) const { return evaluations + cost <= limit; }
  // What a first attempt may cost, which is the last of all: detours come with that.
  int attempt(int which) const { return which == easier ? DIRECT : SOON; }

  // An attempt has ended like this. `wanted`, of a first attempt that failed, is known.
  Then after(const Rules& rules, int ended, T reached, int found) {
    const bool solved = ended <= HALVED;
    if (!whole()) return after_part(rules, ended, reached, found);
    if (first() || solved || reached < infinite<T>())
      status = eased && solved ? int(EASED) : ended, error = reached, hazards = found, kept = eased;
    if (solved || status == NON_FINITE) return END;
    return further(rules);
  }

 private:
  int parts_hazards;
  T parts_error;

  Then after_part(const Rules& rules, int ended, T reached, int found) {
    if (ended <= HALVED) {
      eased = 0, parts_hazards |= found, parts_error = max(parts_error, reached);
      if (++part == 1 << halvings) return status = HALVED, error = parts_error, hazards = parts_hazards, END_OF_PARTS;
      return begin_part(), NEXT_PART;
    }
    if (eased < easier && may_ease && ended != NON_FINITE && affords(attempt(eased + 1))) return eased++, EASE_PART;
    return further(rules);  // where one part fails, so do all
  }

  void begin_part() { limit = evaluations + share; }

  Then further(const Rules& rules) {
    limit = rules.evaluations, eased = 0, halvings = part = 0;
    const int easing = rules.halvings, last = easing + easier + rules.halvings;
    while (++tried <= last) {
      const bool early = tried <= easing;
      const int times = early ? tried : tried - easing - easier;
      if (!early && times <= 0) {
        if (!affords(attempt(times + easier))) continue;
        counts[EASIER_STEP]++, eased = times + easier;
        return EASE;
      }
      // as long as still shorter steps are to be tried, none of these may be an easier one
      if ((early && times > wanted) || !affords(attempt(0) << times)) continue;
      may_ease = !early || times == wanted;
      counts[HALVING]++, halvings = times, share = (limit - evaluations) >> times;
      parts_hazards = 0, parts_error = T(0);
      return begin_part(), HALVE;
    }
    if (!easier && error <= T(rules.tolerance)) status = SOLVED;  // a root that has strayed is better than none
    return END_AT_BEST;
  }
};

}  // namespace pbfd
