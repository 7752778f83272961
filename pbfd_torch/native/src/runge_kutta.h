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

template <class V, class N, int D = 3> struct Leap {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  const Plan<N, D>& plan;
  Flow<V, N, D> flow;
  Poses<V> short_of;
  V *q, *v, *lag;  // the state at its end, see `Velocities`
  V error;         // how far off that is, as estimated [m]
  V *at, *axes, *moves[STAGES], *gains[STAGES];

  static int room(Sizes s) {
    return Flow<V, N, D>::room(s) + (D * D + D) * s.nodes + (2 + STAGES) * s.nq + (2 + turns(D) + D + STAGES) * s.nv;
  }
  Leap(const Plan<N, D>& scene, Momenta<V, N, D>& momenta, Arena<V>& arena)
      : plan(scene), flow(scene, momenta, arena), short_of(Poses<V>::template in<D>(arena, scene)), error(0) {
    q = arena.take(plan.nq), v = arena.take(plan.nv), lag = arena.take(plan.nv), at = arena.take(plan.nq);
    axes = arena.take((turns(D) + D) * plan.nv);
    for (V*& x : moves) x = arena.take(plan.nq);
    for (V*& x : gains) x = arena.take(plan.nv);
  }

  // The step from q with v that a balance has been begun for; which lanes may make it. stiffest: Δt² (∂r/∂q)/m.
  M make(const Balance<V, N, D>& b, Sight<V, N, D>& sight, const V* from_q, const V* from_v, V stiffest, T trust) {
    const V h = b.dt;
    M kept = stiffest <= V(T(STIFFEST));
    for (int i = 0; i < plan.nv; i++) kept = kept & !(V(plan.dry[i]) > V(0));
    for (int s = 0; s < STAGES; s++) {
      blend(from_q, h, s ? STAGE[s - 1] : nullptr, s, moves, plan.nq, q);
      blend(from_v, h, s ? STAGE[s - 1] : nullptr, s, gains, plan.nv, v);
      normalize(plan, q, at);
      kept = kept & !sight.pushes(b, at);
      coordinate_rates(plan, q, v, moves[s]);
      flow.accelerate(sight.there, sight.axes, at, v, b.control, gains[s]);
    }
    for (int i = 0; i < plan.nq; i++) q[i] = at[i];
    kept = kept & near(q, plan.nq) & finite(v, plan.nv);
    blend(q, h, SHORT, STAGES, moves, plan.nq, at);
    normalize(plan, at, at), place(plan, at, short_of, axes);
    error = apart(plan, short_of, sight.there);
    // what the velocity is off by shows in the next step
    for (int i = 0; i < plan.nv; i++) lag[i] = V(0);
    blend(lag, h, SHORT, STAGES, gains, plan.nv, lag);
    retract(plan, q, lag, h, at), place(plan, at, short_of, axes);
    error = max(error, apart(plan, short_of, sight.there));
    const T epsilon = sizeof(T) == 8 ? T(DBL_EPSILON) : T(FLT_EPSILON);
    const V least = V(T(ROUNDED) * epsilon) * V(plan.reach[0]);
    kept = kept & (error <= fma(V(trust), apart(plan, b.start, sight.there), least));
    for (int i = 0; i < plan.nv; i++) lag[i] = h * (V(1) - V(2) * b.fitted[i]) * flow.others[i];
    substitute(tree(plan), flow.momenta.matrix, lag);
    for (int i = 0; i < plan.nv; i++) v[i] = fma(V(-0.5), lag[i], v[i]);
    return kept;
  }

 private:
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
