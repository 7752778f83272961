// Explicit steps where nothing touches, by the pair of Dormand and Prince, as integrators/runge_kutta.py.
#pragma once
#include "apart.h"
#include "flow.h"
#include "standstill.h"
#include "strayed.h"

namespace pbfd {

constexpr int STAGES = 7;
// of the stages after the first; the last row is the solution of fifth order
constexpr double STAGE[STAGES - 1][STAGES - 1] = {
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};
// what the solution of fourth order is short of
constexpr double SHORT[STAGES] = {71.0 / 57600, 0, -71.0 / 16695, 71.0 / 1920, -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
constexpr double STIFFEST = 1, ROUNDED = 100;
constexpr int SCANS = 8, BISECTIONS = 30;  // of a step, for the instant at which something strikes

template <class V, class N, int D = 3> struct Leap {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  const Plan<N, D>& plan;
  Flow<V, N, D> flow;
  Poses<V> short_of;
  V *q, *v, *lag;  // the state at its end, see `Velocities`
  V error;         // how far off that is, as estimated [m]
  M tried;         // which lanes have gone through its stages
  V strike;        // the share of the step after which something strikes; 1: nothing does
  V *at, *axes, *moves[STAGES], *gains[STAGES];

  static int room(Sizes s) {
    return Flow<V, N, D>::room(s) + (D * D + D) * s.nodes + (2 + STAGES) * s.nq + (2 + turns(D) + D + STAGES) * s.nv;
  }
  Leap(const Plan<N, D>& scene, Momenta<V, N, D>& momenta, Arena<V>& arena)
      : plan(scene), flow(scene, momenta, arena), short_of(Poses<V>::template in<D>(arena, scene)), error(0), tried(false), strike(1) {
    q = arena.take(plan.nq), v = arena.take(plan.nv), lag = arena.take(plan.nv), at = arena.take(plan.nq);
    axes = arena.take((turns(D) + D) * plan.nv);
    for (V*& x : moves) x = arena.take(plan.nq);
    for (V*& x : gains) x = arena.take(plan.nv);
  }

  // The step from q with v that a balance has been begun for; which of these lanes may make it. Where nothing but that something
  // strikes on the way keeps a lane from making it, `strike` says when. stiffest: Δt² (∂r/∂q)/m.
  M make(const Balance<V, N, D>& b, Sight<V, N, D>& sight, M which, const V* from_q, const V* from_v, V stiffest, T trust) {
    tried = which & (stiffest <= V(T(STIFFEST))), strike = V(1), error = V(0);
    for (int i = 0; i < plan.nv; i++) tried = tried & !(V(plan.dry[i]) > V(0));
    if (any(tried)) tried = tried & !sight.pushes(b, from_q, false);
    if (!any(tried)) return tried;
    const V h = b.dt;
    M clear(true);  // nothing pushes at any of the stages
    for (int s = 0; s < STAGES; s++) {
      blend(from_q, h, s ? STAGE[s - 1] : nullptr, s, moves, plan.nq, q);
      blend(from_v, h, s ? STAGE[s - 1] : nullptr, s, gains, plan.nv, v);
      normalize(plan, q, at);
      if (s > 0) clear = clear & !sight.pushes(b, at, false);
      coordinate_rates(plan, q, v, moves[s]);
      flow.accelerate(sight.there, sight.axes, at, v, b.control, gains[s]);
    }
    for (int i = 0; i < plan.nq; i++) q[i] = at[i];
    find_error(sight.there, h);
    const T epsilon = sizeof(T) == 8 ? T(DBL_EPSILON) : T(FLT_EPSILON);
    const V least = V(T(ROUNDED) * epsilon) * V(plan.reach[0]);
    const V most = fma(V(trust), apart(plan, b.start, sight.there), least);
    const M good = tried & near(q, plan.nq) & finite(v, plan.nv) & (error <= most);
    for (int i = 0; i < plan.nv; i++) lag[i] = h * (V(1) - V(2) * b.fitted[i]) * flow.others[i];
    substitute(tree(plan), flow.momenta.matrix, lag);
    if (any(good & !clear)) find_strike(b, sight, from_q, good & !clear);
    for (int i = 0; i < plan.nv; i++) v[i] = fma(V(-0.5), lag[i], v[i]);
    return good & clear;
  }

 private:
  // How far the solution of fourth order is from q, where it is placed, and what its velocity is off by shows in the next step.
  void find_error(Poses<V> end, V h) {
    blend(q, h, SHORT, STAGES, moves, plan.nq, at);
    normalize(plan, at, at), place(plan, at, short_of, axes);
    error = apart(plan, short_of, end);
    for (int i = 0; i < plan.nv; i++) lag[i] = V(0);
    blend(lag, h, SHORT, STAGES, gains, plan.nv, lag);
    retract(plan, q, lag, h, at), place(plan, at, short_of, axes);
    error = max(error, apart(plan, short_of, end));
  }

  // When something first pushes on the cubic between both ends, with their rates: to a share of 2^−33 of the step, and not after.
  void find_strike(const Balance<V, N, D>& b, Sight<V, N, D>& sight, const V* from, M which) {
    auto touches = [&](V x) {
      const V y = V(1) - x, h = b.dt;
      for (int i = 0; i < plan.nq; i++) {
        const V ends = fma(y * y * fma(V(2), x, V(1)), from[i], x * x * fma(V(-2), x, V(3)) * q[i]);
        at[i] = fma(h * x * y, fma(y, moves[0][i], -(x * moves[STAGES - 1][i])), ends);
      }
      normalize(plan, at, at);
      return sight.pushes(b, at, false);
    };
    V low(0), high(2);  // the strike is between them
    for (int k = 1; k <= SCANS; k++) {
      const V x = V(T(k) / SCANS);
      const M found = touches(x);
      high = select(found & (high > V(1)), x, high), low = select(high > V(1), x, low);
    }
    const M there = which & (high <= V(1));
    for (int k = 0; k < BISECTIONS; k++) {
      const V middle = V(0.5) * (low + min(high, V(1)));
      const M found = touches(middle);
      high = select(found, middle, high), low = select(found, low, middle);
    }
    strike = select(there, low, V(1));
  }

  // x + h Σ a k of `count` rates.
  static void blend(const V* x, V h, const double* a, int count, V* const* rates, int size, V* out) {
    for (int i = 0; i < size; i++) {
      V sum(0);
      for (int s = 0; s < count; s++)
        if (a[s] != 0) sum = fma(V(T(a[s])), rates[s][i], sum);
      out[i] = fma(h, sum, x[i]);
    }
  }
};

}  // namespace pbfd
