// What a contact or a limit pushes with at a depth: C d² (Eq. 8), less where it leaves faster than the release speed (METHOD §4).
#pragma once
#include "scalar.h"

namespace pbfd {

// How much of it is left at depth d in a step that began at d₀, and how that rises; `per_range`: 1 / (release speed × Δt).
template <class V> inline void released(V depth, V start, V per_range, V& share, V& rises) {
  const V x = clamped(fma(depth - start, per_range, V(1)), V(0), V(1));
  share = x * x * fma(V(-2), x, V(3)), rises = V(6) * x * (V(1) - x) * per_range;
}

// 1 / (v Δt) of a limit: the deeper it is left from, the faster.
constexpr double RETURN = 0.2;  // [s]
template <class V> inline V per_return(V release, V start, V dt) { return V(1) / (fma(start, V(1 / RETURN), release) * dt); }

// N and dN/dd.
template <class V> inline void release_law(V stiffness, V depth, V start, V per_range, V& push, V& slope) {
  V share, falls;
  released(depth, start, per_range, share, falls);
  const V d = max(depth, V(0)), whole = stiffness * d * d;
  push = share * whole;
  slope = fma(share * V(2), stiffness * d, falls * whole);
}

}  // namespace pbfd
