// Steps made once more at the ends that were found, with everything written down: r, and the state after a step, as functions of all
// that it is made of and of q ⊕ δ. By the implicit function theorem (gradients/implicit.py) the end moves by δ = −J⁻¹ ∂r/∂x dx. J is
// the balance's own, and factored once.
#pragma once
#include <algorithm>

#include "fitted.h"
#include "given.h"
#include "journey.h"
#include "square.h"
#include "state.h"
#include "traced.h"

namespace pbfd {

// Steps as they were made, and derivatives by what came of them: arrays as interface.h has them.
template <class T> struct Descent {
  int worlds, steps, rows, halvings;
  bool held, alike, refined, dropped;
  const T* dt;
  const void *const *given, *const *found;
  const T* control;
  Timetable<T> timetable;
  const int *detour, *halved, *eased;
  const T* ends;
  const int* constant;
  void* const* cotangent;
  void* const* seen;
  T *by_control, *by_number, *by_dt;
  int* singular;

  long at(int step, int world) const { return long(step) * worlds + world; }
};

template <class L, int D, template <class, class, int> class Scheme> struct Retrace {
  using V = Traced<L>;
  using T = typename Kind<L>::Scalar;
  using M = typename Kind<L>::Mask;
  using State = typename Scheme<L, L, D>::State;
  using Written = typename Scheme<V, V, D>::State;
  static constexpr int W = Kind<L>::lanes;

  // A part of a step, on the tape: where what moves q begins, and where r is known; and J of each lane.
  struct Part {
    int delta, balanced;
    std::vector<Square<T>> jacobian;
  };

  // numbers alone, which J is of
  const Plan<L, D>& plain;
  Numbers<L>& own;
  // the same written down
  V* numbers;
  Plan<V, D> plan;
  Balance<L, L, D> exact;
  Scheme<L, L, D> exactly;
  Balance<V, V, D> balance;
  Scheme<V, V, D> scheme;
  Tape<L>& tape;
  State now;               // the state before a part, as numbers
  Written before, after;   // and written down, and that after it
  L *ended, *better, *guessed, *moved, *stiffness;  // where the part has ended; room
  V *q, *delta, *guess, whole;                      // q ⊕ δ, δ; room; Δt
  std::vector<int> residual;                        // where on the tape r is [parts · nv]
  std::vector<L>& sums;                             // room for a derivative of each value
  std::vector<Part> parts;
  std::vector<T> column;

  static int room(Sizes s) {
    return Balance<L, L, D>::room(s) + Scheme<L, L, D>::room(s) + room_for<State>(s) + 3 * s.nq + (1 + s.nv) * s.nv;
  }
  static int written_room(Sizes s) {
    return Plan<V, D>::real_numbers(s) + Balance<V, V, D>::room(s) + Scheme<V, V, D>::room(s) + 2 * room_for<Written>(s) +
           3 * s.nq + s.nv;
  }
  Retrace(const pbfd_plan* p, const Plan<L, D>& scene, Numbers<L>& these, Arena<L>& arena, Arena<V>& written)
      : plain(scene), own(these), numbers(written.take(Plan<V, D>::real_numbers(scene))), plan(plan_of<V, D>(p, numbers)),
        exact(plain, arena), exactly(plain, arena), balance(plan, written), scheme(plan, written), tape(of_thread<Tape<L>>()),
        sums(of_thread<std::vector<L>>()), column(scene.nv) {
    now = taken<State>(arena, plain), before = taken<Written>(written, plan), after = taken<Written>(written, plan);
    ended = arena.take(plan.nq), better = arena.take(plan.nq), moved = arena.take(plan.nv), guessed = arena.take(plan.nq);
    stiffness = arena.take(plan.nv * plan.nv);
    q = written.take(plan.nq), delta = written.take(plan.nv), guess = written.take(2 * plan.nq);
    exact.contacts.grip = plain.contact.grip, balance.contacts.grip = plan.contact.grip;
    exact.recall(now.behind), balance.recall(before.behind);
    for (int j = 0; j < count(); j++) numbers[j] = V(own.lanes[j], 0);
  }

  // One for each thread, which is not made anew for each call.
  template <class X> static X& of_thread() {
    static thread_local X one;
    return one;
  }

  // The steps that are asked for.
  void ask(const Descent<T>& of, const Rules& rules) {
    asked = &of;
    Tape<L>::current = &tape;
    exactly.ask(rules), scheme.ask(rules);
  }

  // Worlds first … last − 1 at a step, those whose step was made of 2^h parts together: visit(h), `aboard` of them in the lanes.
  template <class F> void each_group(int at, int first, int last, F&& visit) {
    step = at;
    for (int h = 0; h <= asked->halvings; h++) {
      aboard = 0;
      for (int w = first; w < last; w++)
        if (parts_of(w) == h) {
          world[aboard++] = w;
          if (aboard == W) take_seats(), visit(h), aboard = 0;
        }
      if (aboard) take_seats(), visit(h);
    }
  }

  const Descent<T>* asked;
  int world[W], aboard, step;

  int detour(int w) const { return asked->detour[asked->at(step, w)]; }
  int parts_of(int w) const {
    const int other = detour(w);
    return other < 0 ? 0 : asked->halved[other];
  }

  // The last world is in the lanes that are left, too.
  void take_seats() {
    for (int i = 0; i < W; i++) {
      if (i >= aboard) world[i] = world[aboard - 1];
      own.load(i, world[i]);
    }
  }

  template <class X> static const X* row(const void* array, long index, int width) {
    return static_cast<const X*>(array) + index * width;
  }

  // The state that the step set out from and its control, as what everything else is made of; the last of their nodes.
  int load() {
    tape.clear();
    int k = 0;
    Written::each(plan, [&](auto member, int width) {
      for (int j = 0; j < width; j++) (before.*member)[j] = V(L(0), leaf());
      for (int i = 0; i < W; i++) {
        const T* x = step ? row<T>(asked->found[k], asked->at(step - 1, world[i]), width) : row<T>(asked->given[k], world[i], width);
        for (int j = 0; j < width; j++) put((before.*member)[j].v, i, x[j]);
      }
      k++;
    });
    for (int j = 0; j < plan.nu; j++) {
      V& x = balance.control[j] = V(L(0), leaf());
      for (int i = 0; i < W; i++) put(x.v, i, *row<T>(asked->control, asked->at(asked->held ? 0 : step, world[i]) * plan.nu + j, 1));
      exact.control[j] = x.v;
    }
    whole = V(L(0), asked->by_dt ? leaf() : 0);
    for (int i = 0; i < W; i++) put(whole.v, i, asked->dt[asked->alike ? 0 : world[i]]);
    if (asked->by_number)
      for (int j = 0; j < count(); j++) numbers[j] = V(own.lanes[j], leaf());
    else
      for (int j = 0; j < own.varied; j++) numbers[own.which[j]] = V(own.lanes[own.which[j]], 0);
    return tape.count - 1;
  }
  int leaf() { return tape.add(0, L(0), 0, L(0), 0); }
  int count() const { return Plan<V, D>::real_numbers(plan); }

  void write(int h) {
    const V dt = h ? whole * V(T(1) / T(1 << h)) : whole;
    if (h) scheme.resize(M(true), whole, dt, before);
    for (int p = 0; p < 1 << h; p++) {
      if (p) copy(plan, M(true), after, before);
      write(h, p, dt);
    }
    if (h) scheme.resize(M(true), dt, whole, after);
  }

  // A part of a step [s].
  void write(int h, int p, const V& dt) {
    M eased(false);
    const int lasts = (1 << asked->halvings) >> h;
    const long begins = (long(step) << asked->halvings) + p * lasts;
    for (int i = 0; i < W; i++) {
      const int other = detour(world[i]), easier = other < 0 ? 0 : asked->eased[(long(other) << asked->halvings) + p];
      const T* end = other < 0 ? row<T>(asked->found[0], asked->at(step, world[i]), plan.nq)
                               : row<T>(asked->ends, (long(other) << asked->halvings) + p, plan.nq);
      for (int j = 0; j < plan.nq; j++) put(ended[j], i, end[j]);
      put(eased, i, easier > 0), put(exact.share, i, T(exactly.share(easier))), put(exact.dt, i, lane(dt, i));
      if (plan.moving > 0) {
        const T *from = asked->timetable.at(begins, world[i]), *to = asked->timetable.at(begins + lasts, world[i]);
        exact.carriers.load(i, from, to), balance.carriers.load(i, from, to);
      }
    }
    balance.dt = dt, balance.share = V(exact.share, 0);
    if constexpr (Scheme<L, L, D>::fits)
      fit(plan, dt, balance.fitted);
    else
      for (int j = 0; j < plan.nv; j++) balance.fitted[j] = V(1);
    for (int j = 0; j < plan.nv; j++) exact.fitted[j] = balance.fitted[j].v;
    each_value([&](const V& x, L& value) { value = x.v; });
    solve(eased, part(p).jacobian);

    scheme.begin(balance, before, guess, eased), balance.begin();
    Part& made = part(p);
    made.delta = tape.count;
    for (int j = 0; j < plan.nv; j++) delta[j] = V(L(0), tape.add(0, L(0), 0, L(0), 0));
    for (int j = 0; j < plan.nq; j++) guess[j] = V(ended[j], 0);
    retract(plan, guess, delta, V(1), q);
    balance.evaluate(q);
    made.balanced = tape.count - 1;
    residual.resize(std::max(residual.size(), size_t((p + 1) * plan.nv)));
    for (int j = 0; j < plan.nv; j++) residual[p * plan.nv + j] = balance.residual[j].node;
    scheme.advance(balance, q, before, after, eased);
    for (int j = 0; j < plan.nq; j++) after.q[j] = q[j];
    if (plan.remembered() > 0) balance.remember(after.behind);
  }

  // J at the part's end, which Newton's method improves where it was found in half the precision.
  void solve(M eased, std::vector<Square<T>>& jacobian) {
    exactly.begin(exact, now, guessed, eased), exact.begin();
    for (bool refined = !asked->refined;; refined = true) {
      L* matrix = exact.matrix;
      exact.evaluate(ended), exact.assemble(ended, true);
      exact.matrix = stiffness, exact.assemble(ended, false), exact.matrix = matrix;
      for (int i = 0; i < W; i++) factor(i, jacobian[i]);
      if (refined) break;
      for (int i = 0; i < W; i++) {
        for (int j = 0; j < plan.nv; j++) column[j] = -lane(exact.residual[j], i);
        jacobian[i].solve(column.data());
        for (int j = 0; j < plan.nv; j++) put(moved[j], i, column[j]);
      }
      retract(plain, ended, moved, L(1), better);
      for (int j = 0; j < plan.nq; j++) ended[j] = better[j];
    }
  }
  void factor(int i, Square<T>& jacobian) {
    const int n = plan.nv;
    jacobian.factor([&](int a, int b) { return lane(exact.matrix[n * a + b], i); },
                    [&](int a) { return lane(stiffness[(n + 1) * a], i); });
  }

  Part& part(int p) {
    while (int(parts.size()) <= p) parts.push_back({0, 0, std::vector<Square<T>>(W, Square<T>(plan.nv))});
    return parts[p];
  }

  // Whose derivatives are wanted, and not those of a constant.
  M note(int h) {
    M kept(false);
    for (int i = 0; i < aboard; i++) {
      bool singular = false;
      for (int p = 0; p < 1 << h; p++) singular |= parts[p].jacobian[i].singular;
      const long at = asked->at(step, world[i]);
      asked->singular[at] = singular;
      put(kept, i, !(asked->constant && asked->constant[at]) && !(singular && asked->dropped));
    }
    return kept;
  }

  // Visits the numbers of the written state beside those of the plain one.
  template <class F> void each_value(F&& visit) {
    V* from[16];
    int k = 0;
    Written::each(plan, [&](auto member, int) { from[k++] = before.*member; });
    k = 0;
    State::each(plan, [&](auto member, int width) {
      for (int j = 0; j < width; j++) visit(from[k][j], (now.*member)[j]);
      k++;
    });
  }
};

}  // namespace pbfd
