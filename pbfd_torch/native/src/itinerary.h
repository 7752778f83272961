// How a world makes its step where the first attempt fails, as stepping/eager.py: for one lane, what it tries next. That is, in
// turn: shorter steps where these are worth more than an easier one, the scheme's easier step, and 2, 4, 8 … shorter steps.
#pragma once
#include "fallbacks.h"
#include "state.h"

namespace pbfd {

enum Fallback { WARM_START, CONTINUATION, EASIER_STEP, HALVING, FALLBACKS };  // as they are counted

// What follows an attempt. The step has ended: here, at the best end so far, or with the last of its parts. Or else it is tried
// again as an easier one or from the first of shorter parts on, or the same part as an easier one; or the next part follows.
enum Then { END, END_AT_BEST, END_OF_PARTS, EASE, HALVE, EASE_PART, NEXT_PART };

template <class T, bool EASIER> struct Itinerary {
  static constexpr int FIRST = EASIER ? SOON : DIRECT;  // evaluations of a first attempt: detours come later, if at all

  // the attempt
  int halvings, part;  // of 2^halvings parts; 0: of the whole step
  bool eased;
  int limit, share;  // what `evaluations` may reach in it; what each part may spend
  // the step
  int tried, wanted;
  bool may_ease;  // parts
  int evaluations, iterations, counts[FALLBACKS];
  // how the step has ended, or its best end so far
  int status, hazards;
  T error;

  void begin(const Rules& rules) {
    halvings = part = tried = wanted = evaluations = iterations = hazards = 0;
    eased = false, limit = rules.evaluations;
    for (int& x : counts) x = 0;
  }

  bool whole() const { return halvings == 0; }
  bool first() const { return tried == 0; }
  // Whether it goes through all detours, and whether these count as the step's own. Where not, roots that have strayed are good
  // enough.
  bool led() const { return eased || !EASIER; }
  bool own() const { return whole() && !eased; }
  bool affords(int cost) const { return evaluations + cost <= limit; }

  // An attempt has ended like this. `wanted`, of a first attempt that failed, is known.
  Then after(const Rules& rules, int ended, T reached, int found) {
    const bool solved = ended <= HALVED;
    if (!whole()) return after_part(rules, ended, reached, found);
    if (first() || solved || reached < infinite<T>())
      status = eased && solved ? int(EASED) : ended, error = reached, hazards = found;
    if (solved || status == NON_FINITE) return END;
    return further(rules);
  }

 private:
  int parts_hazards;
  T parts_error;

  Then after_part(const Rules& rules, int ended, T reached, int found) {
    if (ended <= HALVED) {
      eased = false, parts_hazards |= found, parts_error = max(parts_error, reached);
      if (++part == 1 << halvings) return status = HALVED, error = parts_error, hazards = parts_hazards, END_OF_PARTS;
      return begin_part(), NEXT_PART;
    }
    if (EASIER && !eased && may_ease && ended != NON_FINITE && affords(DIRECT)) return eased = true, EASE_PART;
    return further(rules);  // where one part fails, so do all
  }

  void begin_part() { limit = evaluations + share; }

  Then further(const Rules& rules) {
    limit = rules.evaluations, eased = false, halvings = part = 0;
    const int easing = rules.halvings + 1, last = 2 * rules.halvings + 1;
    while (++tried <= last) {
      const int times = tried < easing ? tried : tried - easing;
      if (tried == easing) {
        if (!EASIER || !affords(DIRECT)) continue;
        counts[EASIER_STEP]++, eased = true;
        return EASE;
      }
      // as long as still shorter steps are to be tried, none of these may be an easier one
      if ((tried < easing && times > wanted) || !affords(FIRST << times)) continue;
      may_ease = tried > easing || times == wanted;
      counts[HALVING]++, halvings = times, share = (limit - evaluations) >> times;
      parts_hazards = 0, parts_error = T(0);
      return begin_part(), HALVE;
    }
    if (!EASIER && error <= T(rules.tolerance)) status = SOLVED;  // a root that has strayed is better than none
    return END_AT_BEST;
  }
};

}  // namespace pbfd
