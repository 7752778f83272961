// How far to go along a direction: the zero of the work φ(a) = r·d, as solvers/searches.py.
#pragma once
#include "outlook.h"

namespace pbfd {

constexpr double SHORTEST = 1e-4, BALANCED = 1e-2, NEAREST = 0.02;
constexpr int ROUNDS = 12;

// Where in a bracket to try next, 0 at its low end: a straight line there, and a parabola that sets in where something touches;
// `other` where the two ends contradict that.
template <class V> inline V touching_share(V low_work, V low_curve, V high_work, V high_curve, V width, V other) {
  const V zero(0), one(1);
  const V slope = low_curve * width, gap = high_work - (low_work + slope), steepness = high_curve * width - slope;
  const V touch = max(one - V(2) * gap / select(steepness > zero, steepness, one), zero), rest = max(one - touch, V(1e-6));
  const V curve = gap / (rest * rest), left = fma(slope, touch, low_work);
  const V root = slope + sqrt(max(fma(slope, slope, V(-4) * curve * left), zero));
  const V past = touch - V(2) * left / select(root > zero, root, one), before = -low_work / select(slope > zero, slope, one);
  const V share = select(left < zero, past, before);
  const auto fits = (gap > zero) & (steepness > zero) & (share > zero) & (share < one);
  return select(fits, clamped(share, V(NEAREST), V(1 - NEAREST)), other);
}

// The first length to try: 1 where the work is expected to end short of its zero, or at it, else where it first vanishes.
template <class V, class N, int D>
inline V first_length(const Outlook<V, N, D>& outlook, V work, V curve, typename Kind<V>::Mask where) {
  const V zero(0), one(1);
  V high_curve;
  const V end = outlook.work(one, high_curve);
  const auto beyond = where & (!(end < zero)) & (!(abs(end) <= V(BALANCED) * abs(work)));
  if (!any(beyond)) return one;
  // by turns the touching parabola and Anderson and Björck's false position, where these contradict what is known the middle:
  // what a limit or a contact lets go of sets in like a step
  V low = zero, high = one, low_work = work, high_work = end, low_curve = curve, low_felt = work, high_felt = end;
  V best = one, best_work = end, length = one;
  auto open = beyond & (abs(best_work) > V(outlook.close) * abs(work));
  for (int round = 0; round < ROUNDS && any(open); round++) {  // a lane that has enough stays: others may need more
    const V width = high - low;
    V share = low_felt / (low_felt - high_felt);
    share = select((share > V(NEAREST)) & (share < V(1 - NEAREST)), share, V(0.5));
    if (round % 2 == 0) share = touching_share(low_work, low_curve, high_work, high_curve, width, V(0.5));
    length = select(open, fma(share, width, low), length);
    V df;
    const V f = outlook.work(length, df);
    const auto shorter = open & (f < zero), longer = open & !(f < zero);
    const V by_low = one - f / low_work, by_high = one - f / high_work, half(0.5);
    const V less_high = high_felt * select(by_low < one, max(by_low, half), half);
    const V less_low = low_felt * select(by_high < one, max(by_high, half), half);
    high_felt = select(longer, f, select(shorter, less_high, high_felt));
    low_felt = select(shorter, f, select(longer, less_low, low_felt));
    low = select(shorter, length, low), low_work = select(shorter, f, low_work), low_curve = select(shorter, df, low_curve);
    high = select(longer, length, high), high_work = select(longer, f, high_work), high_curve = select(longer, df, high_curve);
    const auto better = open & (abs(f) < abs(best_work));
    best = select(better, length, best), best_work = select(better, f, best_work);
    open = open & (abs(best_work) > V(outlook.close) * abs(work));
  }
  length = select(abs(best_work) <= V(outlook.close) * abs(work), best, select(low > zero, low, length));
  return select(beyond, max(length, V(SHORTEST)), one);
}

}  // namespace pbfd
