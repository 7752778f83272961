// Newton's method with a search for the zero of the work, every lane at its own stage, as solvers/descent.py: a pass is one
// evaluation for all lanes and each lane's own decision, by masks.
#pragma once
#include <cfloat>
#include "forces.h"
#include "linear.h"
#include "search.h"

namespace pbfd {

constexpr double NEGLIGIBLE = 0.1;     // of the scale, at most, may be left to rounding
constexpr double RETREAT_ABOVE = 2.0;  // ‖r/scale‖ at the guess
constexpr double OVERSHOOT = 0.5;      // of the work at the start
constexpr double MAX_TURN = 1.0;       // [rad] of a joint in one step of Newton's
constexpr double ABSURD = 1e6;         // what drives the bodies may move them by so many times their extent in a step, or [rad]

// As solvers/objective.py: up to HALVED the step is solved.
enum Status { EXPLICIT = -1, SOLVED, WARM_STARTED, CONTINUED, EASED, HALVED, STALLED, ITERATION_LIMIT, NON_FINITE };

template <class V, class N, int D = 3> struct Newton {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr T EPSILON = sizeof(T) == 8 ? T(DBL_EPSILON) : T(FLT_EPSILON);

  const Plan<N, D>& plan;
  Balance<V, N, D> balance;
  Outlook<V, N, D> outlook;
  V tolerance, most;  // ‖r/scale‖; evaluations
  // where every lane stands
  V *q, *trial, *retreat, *direction, *step, *column, *diagonal;
  V *plain, *allowed;  // of each residual: 1 / scale, 1 / (scale + rounding/tolerance)
  V* factors;          // of J or of the stiffness
  V length, start_work, low, low_work, low_curve, high, high_work, high_curve;
  V error, status, evaluations, iterations, far;
  M running, at_guess, at_retreat, searching;
  bool settled;  // every lane that does not run has been evaluated where it stays

  static int room(Sizes s) { return Balance<V, N, D>::room(s) + Outlook<V, N, D>::room(s) + 3 * s.nq + (6 + s.nv) * s.nv; }

  Newton(const Plan<N, D>& scene, Arena<V>& arena) : plan(scene), balance(scene, arena), outlook(scene, arena) {
    q = arena.take(plan.nq), trial = arena.take(plan.nq), retreat = arena.take(plan.nq);
    direction = arena.take(plan.nv), step = arena.take(plan.nv), column = arena.take(plan.nv), diagonal = arena.take(plan.nv);
    plain = arena.take(plan.nv), allowed = arena.take(plan.nv), factors = arena.take(plan.nv * plan.nv);
    for (int i = 0; i < plan.nv; i++) direction[i] = V(0);
    length = start_work = low = low_work = low_curve = high = high_work = high_curve = V(0);
    error = status = evaluations = iterations = V(0), far = V(1);
    running = at_guess = at_retreat = searching = M(false), settled = false;
  }

  // Lanes set out from a guess; θ_n is the retreat of those that have one. Their balance has been begun.
  void begin(M which, const V* guess, M safe) {
    for (int i = 0; i < plan.nq; i++) {
      q[i] = select(which, guess[i], q[i]), trial[i] = select(which, guess[i], trial[i]);
      retreat[i] = select(which, balance.q_start[i], retreat[i]);
    }
    V farthest(0);
    for (int i = 0; i < D * plan.nodes; i++) farthest = max(farthest, abs(balance.start.position[i]));
    far = select(which, farthest + V(plan.reach[0]), far);
    const V per = V(8 * EPSILON) * balance.weight / tolerance;
    for (int i = 0; i < plan.nv; i++) {
      plain[i] = V(1) / V(plan.scale[i]);
      allowed[i] = V(1) / fma(per, fma(far, V(plan.heft[i]), V(plan.armature[i])), V(plan.scale[i]));
    }
    running = running | which, searching = searching & !which;
    at_guess = (at_guess & !which) | (which & safe), at_retreat = (at_retreat & !which) | (which & !safe);
    evaluations = select(which, V(0), evaluations), iterations = select(which, V(0), iterations);
    error = select(which, V(0), error), status = select(which, V(ITERATION_LIMIT), status);
    high = select(which, infinite<V>(), high);
  }

  // Lanes have ended at `there` without looking for it.
  void rest(M which, const V* there) {
    for (int i = 0; i < plan.nq; i++) q[i] = select(which, there[i], q[i]), trial[i] = select(which, there[i], trial[i]);
    evaluations = select(which, V(0), evaluations), iterations = select(which, V(0), iterations);
    error = select(which, V(0), error), status = select(which, V(EXPLICIT), status);
    running = running & !which, settled = settled & !any(which);
  }

  // One evaluation of every lane that runs, and what it does next.
  void pass() {
    const int n = plan.nv;
    balance.evaluate(trial);
    bool assembled = false;
    const V reached = judged(assembled);
    const M finite = reached < infinite<V>();
    const M retreating = running & at_guess & !(finite & (reached <= V(RETREAT_ABOVE)));
    M hopeless = !finite;
    if (any(running & at_retreat)) hopeless = hopeless | absurd();
    const M lost = running & at_retreat & hopeless, usable = running & finite & !retreating & !lost;
    const M arrived = usable & (reached <= tolerance);
    evaluations += select(running, V(1), V(0));
    iterations += select(arrived & searching, V(1), V(0));
    error = select(arrived | lost | retreating, reached, error);
    status = select(arrived, V(SOLVED), select(lost, V(NON_FINITE), status));
    for (int i = 0; i < plan.nq; i++) q[i] = select(arrived, trial[i], q[i]);
    const M ran = running;
    running = running & !arrived & !lost;

    V work(0);
    for (int i = 0; i < n; i++) work = fma(balance.residual[i], direction[i], work);
    work = select(abs(work) < infinite<V>(), work, infinite<V>());
    const M good = (abs(work) <= V(OVERSHOOT) * abs(start_work)) | ((work < V(0)) & !(high < infinite<V>()));
    const M accept = usable & !arrived & ((!searching) | good), rejected = running & searching & !accept;
    M stalled(false);
    if (any(rejected)) stalled = shorten(rejected, work, assembled);
    if (any(accept)) set_out(accept, assembled);
    error = select(accept, reached, error);
    iterations += select(accept & searching, V(1), V(0));
    status = select(stalled, V(STALLED), status);
    running = running & !stalled & (evaluations < most);
    at_retreat = (at_retreat | retreating) & !accept, at_guess = at_guess & !accept & !retreating;
    searching = searching | accept;
    settled = !any(ran & !running & !arrived);

    pbfd::retract(plan, q, direction, length, trial);
    for (int i = 0; i < plan.nq; i++) trial[i] = select(running, select(retreating, retreat[i], trial[i]), q[i]);
  }

 private:
  // ‖r / (scale + rounding/tolerance)‖ (BalanceObjective.error). What rounded coordinates make of J is asked where it may decide.
  V judged(bool& assembled) {
    const int n = plan.nv;
    V whole(0), strict(0);
    for (int i = 0; i < n; i++) {
      const V r = balance.residual[i], a = r * plain[i], b = r * allowed[i];
      whole = fma(a, a, whole), strict = fma(b, b, strict);
    }
    const V least = tolerance * V(1 / NEGLIGIBLE) * sqrt(whole);
    const V first = max(sqrt(strict), least);
    const M near = running & !(first <= tolerance) & (first <= (sizeof(T) == 8 ? V(1e3) * tolerance : V(1)));
    if (!any(near)) return first;
    balance.assemble(trial, true), assembled = true;
    const V moved = V(2 * EPSILON) / tolerance;
    V lenient(0);
    for (int i = 0; i < n; i++) {
      V felt(0);
      for (int j = 0; j < n; j++) felt = fma(abs(balance.matrix[i * n + j]), extent(j), felt);
      const V b = balance.residual[i] * allowed[i], a = b / fma(moved * felt, allowed[i], V(1));
      lenient = fma(a, a, lenient);
    }
    return select(near, max(sqrt(lenient), least), first);
  }

  // Where the forces are not to be balanced (`BalanceObjective.absurd`): what drives the bodies would move them beyond all reason.
  M absurd() {
    V* driven = column;
    forces_of<SMOOTH | DRY>(balance, trial, driven, step);
    if (balance.pushed()) {
      balance.gather([&] { balance.push(); }), balance.add_pushed(driven);
      balance.press();
    }
    M found(false);
    for (int i = 0; i < plan.nv; i++)
      found = found | (abs(driven[i]) > V(ABSURD) * balance.weight * fma(far, V(plan.heft[i]), V(plan.armature[i])));
    return found;
  }
  V extent(int j) const { return select(V(plan.turns[j]) > V(0), V(1), far); }

  // dᵀJd, the slope of the work along d, where J is assembled.
  V curvature(const V* d) const {
    const int n = plan.nv;
    V sum(0);
    for (int i = 0; i < n; i++) {
      V row(0);
      for (int j = 0; j < n; j++) row = fma(balance.matrix[i * n + j], d[j], row);
      sum = fma(row, d[i], sum);
    }
    return sum;
  }

  // A trial went too far, or a shortened one not far enough: another length within the bracket. Who has none left.
  M shorten(M rejected, V work, bool& assembled) {
    if (!assembled) balance.assemble(trial, true), assembled = true;
    const V curve = curvature(direction);
    const M low_side = rejected & (work < V(0)), high_side = rejected & !(work < V(0));
    low = select(low_side, length, low), low_work = select(low_side, work, low_work);
    low_curve = select(low_side, curve, low_curve);
    high = select(high_side, length, high), high_work = select(high_side, work, high_work);
    high_curve = select(high_side, curve, high_curve);
    const V secant = -low_work / (high_work - low_work);
    const V line = clamped(select(high_work < infinite<V>(), secant, V(0.1)), V(0.1), V(0.9));
    const V share = touching_share(low_work, low_curve, high_work, high_curve, high - low, line);
    length = select(rejected, fma(share, high - low, low), length);
    const V shortest = sizeof(T) == 8 ? V(3.0e-13) : V(2.9e-6);  // ε^.8
    return rejected & ((length < shortest) | (high - low < V(16 * EPSILON) * high));
  }

  // Newton's direction from the trial where det J > 0 and it descends, else the stiffness' (solvers/directions.py).
  void set_out(M accept, bool& assembled) {
    const int n = plan.nv;
    if (!assembled) balance.assemble(trial, true);
    V *newton = column, *saved = step;
    for (int i = 0; i < n; i++) newton[i] = -balance.residual[i];
    for (int i = 0; i < n * n; i++) factors[i] = balance.matrix[i];
    const V sign = factor(balance.branches(), factors);
    substitute(balance.branches(), factors, newton);
    V work = against(newton);
    const M direct = (sign > V(0)) & descends(work);
    V curve = -work;  // r = −J y, and yᵀJy = −y·r
    for (int i = 0; i < n; i++) saved[i] = newton[i];
    if (any(accept & !direct)) {
      V *convex = newton, *curved = balance.matrix;
      balance.matrix = factors;
      balance.assemble(trial, false);
      balance.matrix = curved;
      for (int i = 0; i < n; i++) convex[i] = -balance.residual[i];
      for (int i = 0; i < n; i++) diagonal[i] = abs(factors[i * n + i]);
      factor(balance.branches(), factors);
      substitute(balance.branches(), factors, convex);
      const V convex_work = against(convex);
      const M by_convex = descends(convex_work) & (!direct), by_newton = descends(work) & (!direct) & (!by_convex);
      for (int i = 0; i < n; i++) {
        const V plain = -balance.residual[i] / select(diagonal[i] > V(0), diagonal[i], V(1));
        saved[i] = select(direct | by_newton, saved[i], select(by_convex, convex[i], plain));
      }
      work = against(saved);
      curve = select(direct, curve, curvature(saved));
    }
    V turn(MAX_TURN);
    for (int i = 0; i < n; i++) turn = max(turn, abs(saved[i]) * V(plan.turns[i]));
    const V part = V(MAX_TURN) / turn;
    for (int i = 0; i < n; i++) saved[i] = part * saved[i];
    work = part * work, curve = part * part * curve;
    outlook.look(balance, trial, saved, work, curve, accept);
    const V first = first_length(outlook, work, curve, accept);
    for (int i = 0; i < n; i++) direction[i] = select(accept, saved[i], direction[i]);
    for (int i = 0; i < plan.nq; i++) q[i] = select(accept, trial[i], q[i]);
    length = select(accept, first, length), start_work = select(accept, work, start_work);
    low = select(accept, V(0), low), low_work = select(accept, work, low_work), low_curve = select(accept, curve, low_curve);
    high = select(accept, infinite<V>(), high);
  }

  V against(const V* d) const {
    V sum(0);
    for (int i = 0; i < plan.nv; i++) sum = fma(balance.residual[i], d[i], sum);
    return sum;
  }
  static M descends(V work) { return (work < V(0)) & (abs(work) < infinite<V>()); }
};

}  // namespace pbfd
