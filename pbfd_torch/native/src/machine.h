// The lane machine: every pass makes one evaluation for all lanes, each at its own place of its own step and all that it tries, and
// a lane that has ended its step takes the next one of its world, or another world, at once (the paper's Fig. 3).
#pragma once
#include "bdf2.h"
#include "energy_momentum.h"
#include "fitted.h"
#include "frames.h"
#include "implicit_euler.h"
#include "journey.h"
#include "standstill.h"

namespace pbfd {

template <class V, class N, int D, class Scheme> struct Machine {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  using State = typename Scheme::State;
  static constexpr int W = Kind<V>::lanes;

  const Plan<N, D>& plan;
  Numbers<V>& own;  // of the worlds in the lanes
  Newton<V, N, D> newton;
  Sight<V, N, D> sight;
  Scheme scheme;
  State before, after, origin, best;  // of the attempt; of the whole step
  State base, middle, last;           // of a frame: before and half way through the step, and before the last part that is kept
  Poses<V> reached[2];                // of the step as a whole, and of its halves
  V *guess, *from, *found, *velocity, *coarse, *coarse_speed, *axes;

  static int room(Sizes s) {
    return Newton<V, N, D>::room(s) + Sight<V, N, D>::room(s) + Scheme::room(s) + 7 * room_for<State>(s) + 4 * s.nq +
           2 * (D * D + D) * s.nodes + (2 + turns(D) + D) * s.nv;
  }
  Machine(const Plan<N, D>& scene, Numbers<V>& numbers, Arena<V>& arena)
      : plan(scene), own(numbers), newton(plan, arena), sight(plan, arena), scheme(plan, arena), whole(1) {
    before = taken<State>(arena, plan), after = taken<State>(arena, plan);
    origin = taken<State>(arena, plan), best = taken<State>(arena, plan);
    base = taken<State>(arena, plan), middle = taken<State>(arena, plan), last = taken<State>(arena, plan);
    for (Poses<V>& end : reached) end = Poses<V>::template in<D>(arena, plan);
    newton.balance.recall(before.behind);
    sight.there.carriers = newton.balance.now.carriers;
    guess = arena.take(plan.nq), from = arena.take(plan.nq), found = arena.take(plan.nq), velocity = arena.take(plan.nv);
    coarse = arena.take(plan.nq), coarse_speed = arena.take(plan.nv), axes = arena.take((turns(D) + D) * plan.nv);
  }

  // All steps of worlds first … last − 1. Those that remain unsolved go on from the best that was found.
  void run(const Journey<T>& to, const Rules& asked, int first, int last) {
    if (first == last) return;
    journey = &to, rules = asked, next = first, end = last;
    scheme.ask(rules);
    newton.running = eased = anew = leapt = cut = struck = pressed = M(false), stiffest = estimate = V(0), strike = V(1);
    M fresh(false);
    for (int i = 0; i < W; i++) plainly[i] = false, put(fresh, i, board(i));
    if (paced()) set_base(fresh);
    while (any_aboard()) {
      set_out(fresh);
      while (!enough()) newton.pass();
      fresh = arrive();
    }
  }

 private:
  const Journey<T>* journey;
  Rules rules;
  int next, end;  // worlds that no lane has taken yet
  // of each lane
  int world[W];  // −1: none
  int step[W];   // of that world
  Itinerary<T> trips[W];
  Fallbacks<T> ways[W];
  Frame<T> frames[W];
  V whole;          // length of its step, before that is halved
  bool plainly[W];  // it is posed the step itself
  M eased;          // it is posed an easier step
  M anew;           // it is posed another step than before
  V stiffest;       // Δt² (∂r/∂q)/m in it
  V estimate, strike;  // how far the end of its explicit step is off; after what share of it something strikes
  M leapt;          // it has made one
  M cut;            // which is to be made again, to where something strikes
  M struck;         // something has pushed in its step of a frame
  M pressed;        // something has pushed before it, and in all that was made of it
  M safe, from_guess, from_start;  // where it sets out: with a retreat; from the guess, from θ_n, else from where it is

  bool any_aboard() const {
    for (int i = 0; i < W; i++)
      if (world[i] >= 0) return true;
    return false;
  }
  M aboard() const {
    M there(false);
    for (int i = 0; i < W; i++) put(there, i, world[i] >= 0);
    return there;
  }

  // A lane takes the next world; whether there is one. Idle lanes compute too, with the numbers of some world.
  bool board(int i) {
    const bool more = next < end;
    const int from = more ? next++ : end - 1;
    world[i] = more ? from : -1, step[i] = 0;
    load(i, from);
    depart(i);
    return more;
  }
  void depart(int i) {
    steer(i);
    const T dt = journey->step(whose(i));
    if (paced()) frames[i].begin(dt, step[i] ? frames[i].pace : journey->frames.wish[whose(i)]);
    embark(i, paced() ? frames[i].next() : dt);
  }
  void embark(int i, T dt) { put(whole, i, dt), trips[i].begin(rules, scheme.easier), attempt(i); }
  bool paced() const { return journey->frames.pace; }
  int whose(int i) const { return world[i] < 0 ? end - 1 : world[i]; }  // whose numbers it has
  void attempt(int i) { put(anew, i, true), ways[i].begin(), pose(i); }

  // What a lane is to solve next. Most have just made a step, and are to make one.
  void pose(int i) {
    if (plan.moving > 0) move_obstacles(i);
    const bool plain = trips[i].first() && ways[i].way == DIRECTLY;
    if (plain && plainly[i]) return;
    plainly[i] = plain && !paced();
    Balance<V, N, D>& b = newton.balance;
    const int halvings = trips[i].halvings;
    const Stage problem = ways[i].problem();
    const Start start = ways[i].start();
    const T dt = lane(whole, i) / T(1 << halvings);
    put(b.dt, i, dt), put(b.share, i, T(scheme.share(trips[i].eased))), put(eased, i, trips[i].eased > 0);
    if (Scheme::fits)
      put(stiffest, i, fit(plan, i, dt, b.fitted));
    else
      for (int j = 0; j < plan.nv; j++) put(b.fitted[j], i, T(1));
    put(b.relaxed.width, i, T(problem.width)), put(b.relaxed.firmness, i, T(problem.firmness));
    put(b.relaxed.length, i, T(problem.length)), put(b.relaxed.lagged, i, problem.lagged);
    put(newton.tolerance, i, T(ways[i].tolerance(rules.tolerance)));
    put(newton.most, i, T(ways[i].most(trips[i].led() ? DIRECT : SOON)));
    put(safe, i, start == GUESS_OR_RETREAT), put(from_guess, i, start == GUESS_OR_RETREAT || start == GUESS);
    put(from_start, i, start == BEGINNING);
  }

  // They go from where they are when it begins to where they are when it ends.
  void move_obstacles(int i) {
    const Timetable<T>& table = journey->timetable;
    const long lasts = (1 << rules.halvings) >> trips[i].halvings;
    const long begins = (long(step[i]) << rules.halvings) + trips[i].part * lasts;
    newton.balance.carriers.load(i, table.at(begins, whose(i)), table.at(begins + lasts, whose(i)));
  }

  // Lanes are served together: what it costs to end a step is the same for one lane and for all.
  bool enough() const {
    int ended = 0, busy = 0;
    bool more = next < end;
    for (int i = 0; i < W; i++) {
      if (world[i] < 0) continue;
      const bool runs = lane(newton.running, i);
      busy += runs, ended += !runs, more = more || (!runs && goes_on(i));
    }
    return busy == 0 || (more && ended >= busy);
  }
  bool goes_on(int i) const {
    const bool led_on = !trips[i].first() || ways[i].way != DIRECTLY || lane(newton.status, i) > T(SOLVED);
    return led_on || step[i] + 1 < journey->steps;
  }

  // Lanes set out on what they are to solve: those on their way find the same again.
  void set_out(M fresh) {
    if (!any(fresh)) return;
    Balance<V, N, D>& b = newton.balance;
    scheme.velocity(before, b.dt, velocity);
    const M fits = near(before.q, plan.nq) & slow(plan, velocity, b.dt) & finite(b.control, plan.nu);
    scheme.begin(b, before, guess, eased);
    if (any(b.relaxed.length < V(1))) shorten();
    b.begin(anew), anew = M(false);
    for (int i = 0; i < plan.nq; i++) {
      const V start = select(from_guess, guess[i], select(from_start, before.q[i], newton.q[i]));
      from[i] = select(fits, start, infinite<V>() - infinite<V>());  // from NaN nothing is near, and the search ends at its start
    }
    b.relaxed.lagging = any(b.relaxed.lagged);
    if (b.relaxed.lagging) hold(fresh & b.relaxed.lagged);
    newton.begin(fresh, from, safe & fits);
    if constexpr (Scheme::leaps)
      if (rules.trust > 0) leap(fresh & fits);
  }

  // Lanes that set out on a step end where the explicit one leads, if they may.
  void leap(M fresh) {
    M first(false);
    for (int i = 0; i < W; i++) put(first, i, lane(fresh, i) && trips[i].first() && ways[i].way == DIRECTLY);
    leapt = leapt & !fresh, estimate = select(first, V(0), estimate), strike = select(first, V(1), strike);
    if (!any(first)) return;
    M made = scheme.leap.make(newton.balance, sight, first, before.q, velocity, stiffest, T(rules.trust));
    for (int i = 0; i < W; i++) {
      if (!lane(scheme.leap.tried, i)) continue;
      trips[i].evaluations += STAGES;
      put(cut, i, paced() && lane(scheme.leap.strike, i) < T(1) && frames[i].cut(lane(scheme.leap.strike, i)));
      put(made, i, lane(made, i) || lane(cut, i));
    }
    leapt = leapt | made, estimate = select(made, scheme.leap.error, estimate);
    strike = select(first, scheme.leap.strike, strike);
    newton.rest(made, scheme.leap.q);
  }

  // Inertia as in a step that has gone on for a share of its time only.
  void shorten() {
    Balance<V, N, D>& b = newton.balance;
    const V part = b.relaxed.length;
    const M shorter = part < V(1);
    auto nearer = [&](V start, V target) { return select(shorter, fma(part, target - start, start), target); };
    for (int i = 0; i < D * D * plan.nodes; i++) b.target.rotation[i] = nearer(b.start.rotation[i], b.target.rotation[i]);
    for (int i = 0; i < D * plan.nodes; i++) b.target.position[i] = nearer(b.start.position[i], b.target.position[i]);
    difference(plan, b.q_start, b.q_target, velocity);
    retract(plan, b.q_start, velocity, part, from);
    for (int i = 0; i < plan.nq; i++) b.q_target[i] = select(shorter, from[i], b.q_target[i]);
  }

  // Friction is to feel the normal forces, or depths, where lanes set out from.
  void hold(M which) {
    Balance<V, N, D>& b = newton.balance;
    sight.look(from);
    b.each_normal_force(sight.there, [&](int i, V force, V felt) { b.relaxed.hold(which, i, force, felt); });
  }

  // Lanes whose solve has ended take the next detour, or their attempt has ended; who sets out now.
  M arrive() {
    const M ended = aboard() & !newton.running;
    M doubted(false), strayed(false), better(false), led(false), over(false), fresh(false);
    for (int i = 0; i < W; i++)
      put(doubted, i, lane(ended, i) && trips[i].led() && ways[i].doubts(status(i), int(lane(newton.evaluations, i))));
    if (any(doubted)) strayed = sight.strayed(newton.balance, newton.q, guess);
    for (int i = 0; i < W; i++) {
      if (!lane(ended, i)) continue;
      bool kept = false;
      const bool more = led_on(i, lane(doubted, i) && lane(strayed, i), kept);
      put(better, i, kept), put(fresh, i, more), put(over, i, !more), put(led, i, !more && trips[i].led());
    }
    if (any(better))
      for (int i = 0; i < plan.nq; i++) found[i] = select(better, newton.q[i], found[i]);
    if (any(led))
      for (int i = 0; i < plan.nq; i++)
        newton.q[i] = select(led, found[i], newton.q[i]), newton.trial[i] = select(led, found[i], newton.trial[i]);
    if (any(led & !better)) newton.settled = false;
    return any(over) ? fresh | conclude(over) : fresh;
  }
  int status(int i) const { return int(lane(newton.status, i)); }

  // Whether a solve that has ended is followed by another one of the same attempt; whether it is the best so far.
  bool led_on(int i, bool strayed, bool& better) {
    auto& trip = trips[i];
    auto& way = ways[i];
    trip.evaluations += int(lane(newton.evaluations, i)), trip.iterations += int(lane(newton.iterations, i));
    if (!trip.led()) return way.status = status(i), way.error = lane(newton.error, i), false;
    const bool more = way.go_on(
        status(i), lane(newton.error, i), strayed, rules.tolerance, better, [&](int cost) { return trip.affords(cost); },
        [&](int kind) { trip.counts[kind] += trip.own(); });
    if (more) pose(i);
    if (!more && !trip.own() && way.error <= T(rules.tolerance)) way.status = SOLVED;
    return more;
  }

  // Lanes whose attempt has ended try something else, or go on with the next step, or with another world; who sets out now.
  M conclude(M over) {
    Balance<V, N, D>& b = newton.balance;
    if (!newton.settled) b.evaluate(newton.trial);  // running lanes look again; the others are where their attempt has ended
    M refused(false);
    if (any(over & !leapt)) refused = scheme.advance(b, newton.q, before, after, eased) & !leapt;
    if constexpr (Scheme::leaps)
      if (any(over & leapt)) scheme.land(leapt, b.dt, before, after);
    for (int i = 0; i < plan.nq; i++) after.q[i] = newton.q[i];
    if (plan.remembered() > 0) b.remember(after.behind);
    M kept(false), solved(false), failed(false), part(false), lost(false);
    const Hazards<V> seen = look_for_hazards();
    for (int i = 0; i < W; i++) {
      if (!lane(over, i)) continue;
      const bool good = ways[i].status <= HALVED && !lane(refused, i);
      put(solved, i, ways[i].status <= HALVED), put(part, i, !trips[i].whole());
      put(failed, i, !good && ways[i].status != NON_FINITE && trips[i].first());
    }
    V wanted(0);
    if (any(failed)) copy(plan, failed, before, origin), wanted = scheme.halves(b, sight, after, solved);
    if (any(part)) lost = part & got_lost(b.dt);

    M ends(false), from_best(false), from_parts(false), back(false), shorter(false), further(false), fresh(false);
    for (int i = 0; i < W; i++) {
      if (!lane(over, i)) continue;
      auto& trip = trips[i];
      if (lane(failed, i)) trip.wanted = int(lane(wanted, i));
      const bool worth = trip.whole() && (trip.first() || ways[i].error < infinite<T>());
      int how = lane(lost, i) ? int(NON_FINITE) : ways[i].status;
      if (how <= HALVED && lane(refused, i)) how = STALLED;
      if (!trip.whole()) note(i, trip.part, trip.eased, newton.q);
      const Then then = trip.after(rules, how, ways[i].error, seen.bits(i));
      const bool end = then <= END_OF_PARTS;
      put(ends, i, end), put(fresh, i, !end), put(kept, i, worth && then != END);
      put(from_best, i, then == END_AT_BEST), put(from_parts, i, then == END_OF_PARTS);
      put(back, i, end ? !trip.first() : then == EASE || then == HALVE);
      put(shorter, i, then == HALVE), put(further, i, then == NEXT_PART);
    }
    copy(plan, kept, after, best), copy(plan, from_best, best, after);
    if (any(from_parts)) scheme.resize(from_parts, b.dt, whole, after);
    copy(plan, back, origin, before), copy(plan, further, after, before);
    for (int i = 0; i < W; i++)
      if (lane(fresh, i)) attempt(i);
    if (any(shorter)) scheme.resize(shorter, whole, b.dt, before);
    return any(ends) ? fresh | deliver(ends) : fresh;
  }

  // Lanes whose step has ended hand it over and go on; who sets out now. Worlds that got lost are where they were.
  M deliver(M ends) {
    M gone = ends & got_lost(whole), fresh(false), same(false);
    for (int i = 0; i < W; i++) put(gone, i, lane(gone, i) || (lane(ends, i) && trips[i].status == NON_FINITE));
    copy(plan, gone, before, after);
    for (int i = 0; i < W; i++)
      if (lane(gone, i)) trips[i].status = NON_FINITE, trips[i].hazards = 0;
    const M begin = paced() ? pace(ends, fresh) : ends;
    for (int i = 0; i < W; i++) {
      if (!lane(begin, i)) continue;
      store(i), report(i);
      if (++step[i] == journey->steps)
        put(fresh, i, board(i));
      else
        put(fresh, i, true), put(same, i, true), depart(i);
    }
    copy(plan, same, after, before);
    if (paced()) set_base(begin);
    return fresh;
  }

  // Lanes whose step is part of a frame go on with the next half or step, and set out now; whose frame has ended.
  M pace(M ends, M& fresh) {
    M whole_step(false), half(false), judged(false), at_once(false), taken(false), again(false), over(false);
    for (int i = 0; i < W; i++) {
      if (!lane(ends, i)) continue;
      if (lane(cut, i)) {
        frames[i].spend(trips[i]), put(again, i, true), put(fresh, i, true), embark(i, frames[i].next());
        continue;
      }
      frames[i].add(trips[i]);
      const Half made = frames[i].half;
      put(whole_step, i, made == WHOLE), put(half, i, made == FIRST_HALF);
      put(judged, i, made == SECOND_HALF || made == AT_ONCE), put(at_once, i, made == AT_ONCE);
    }
    for (int i = 0; i < plan.nq; i++) coarse[i] = select(whole_step, after.q[i], coarse[i]);
    if constexpr (Scheme::extrapolates) {
      const M pushed = scheme.pushed(after);
      struck = (struck & !whole_step) | (ends & pushed);
      pressed = ((pressed & !whole_step) | (whole_step & scheme.pushed(base))) & (pushed | !ends);
      for (int i = 0; i < plan.nv; i++) coarse_speed[i] = select(whole_step, scheme.speed(after, i), coarse_speed[i]);
    }
    copy(plan, half, after, middle), copy(plan, half, after, before);
    V off(0);
    if (any(judged)) {
      place(plan, coarse, reached[0], axes), place(plan, after.q, reached[1], axes);
      off = select(at_once, estimate, apart(plan, reached[0], reached[1]));
      if constexpr (Scheme::extrapolates)
        scheme.extrapolate(agreed(judged & !at_once, off), pressed, coarse, coarse_speed, base, after, reached[0], axes);
    }
    for (int i = 0; i < W; i++) {
      if (!lane(ends, i) || lane(cut, i)) continue;
      Frame<T>& frame = frames[i];
      if (lane(judged, i)) put(taken, i, frame.judge(rules, lane(off, i)));
      const bool ended = lane(taken, i) && frame.over();
      put(over, i, ended), put(again, i, !ended && !lane(half, i)), put(fresh, i, !ended);
      if (ended) continue;
      if (lane(judged, i))
        frame.set_out();
      else
        frame.half = Half(frame.half + 1);
      embark(i, frame.next());
    }
    cut = cut & !ends;
    copy(plan, taken, after, base), copy(plan, taken & !at_once, middle, last), copy(plan, taken & at_once, before, last);
    copy(plan, again, base, before), copy(plan, over, base, after);
    if (any(again)) scheme.resize(again, spacing(), whole, before);
    if (any(over)) scheme.resize(over, spacing(), lengths(), after);
    return over;
  }
  // The first step of these lanes' frames sets out from where they are.
  void set_base(M begin) {
    copy(plan, begin, before, base);
    scheme.resize(begin, lengths(), whole, before);
  }
  // Where a whole step and its halves say the same and nothing has struck in between; what lies still is damped best by halves.
  M agreed(M which, V off) const {
    const V most = V(T(rules.accuracy));
    return which & (off <= most) & ((pressed & (off > V(T(STILL)) * most)) | !struck);
  }
  V spacing() const { return of_frames([](const Frame<T>& x) { return x.spacing; }); }
  V lengths() const { return of_frames([](const Frame<T>& x) { return x.length; }); }
  template <class F> V of_frames(F&& which) const {
    V x(0);
    for (int i = 0; i < W; i++) put(x, i, which(frames[i]));
    return x;
  }

  // Whose state after a step Δt is none that a step may start from.
  M got_lost(V dt) {
    scheme.velocity(after, dt, velocity);
    return !(near(after.q, plan.nq) & finite(velocity, plan.nv));
  }

  Hazards<V> look_for_hazards() const {
    const Balance<V, N, D>& b = newton.balance;
    Hazards<V> found;
    b.contacts.look_for_hazards(found.deep, found.turned);
    b.meetings.look_for_hazards(found);
    each_limit(plan, newton.q, [&](int i, V past) { found.deep = found.deep | ((past > V(TOO_FAR)) & (V(plan.limit[i]) > V(0))); });
    return found;
  }

  // Between a lane and the arrays.
  void steer(int i) {
    const long row = (journey->held ? 0 : long(step[i]) * journey->worlds) + whose(i);
    for (int j = 0; j < plan.nu; j++) put(newton.balance.control[j], i, journey->control[row * plan.nu + j]);
  }
  void load(int i, int from) {
    if (own.varied || !journey->alike) plainly[i] = false;  // θ may be another
    if (own.varied) own.load(i, from);
    journey->load(from, i, plan, before);
  }
  void store(int i) const {
    journey->store(at(i), i, plan, after, journey->found);
    if (paced()) journey->store(at(i), i, plan, last, journey->frames.before_last);
  }
  void report(int i) const {
    journey->report(at(i), paced() ? static_cast<const Tally<T>&>(frames[i]) : trips[i]);
    if (paced()) journey->frames.note(at(i), frames[i].pace, frames[i].spacing, frames[i].made);
    if (journey->explicitly.estimate) journey->explicitly.note(at(i), lane(estimate, i), lane(strike, i));
    if (!journey->ways.ends) return;
    journey->ways.halved[at(i)] = trips[i].halvings;
    if (trips[i].whole()) note(i, 0, trips[i].status == EXPLICIT ? EXPLICIT : trips[i].kept, after.q);
  }
  // How a part of a step was made, and where it has ended.
  void note(int i, int part, int eased, const V* q) const {
    if (journey->ways.ends) journey->ways.note((at(i) << rules.halvings) + part, eased, i, q, plan.nq);
  }
  long at(int i) const { return journey->at(step[i], world[i]); }
};

}  // namespace pbfd
