// What a contact or a limit pushes with at a depth: C d² (Eq. 8), less where it leaves faster than the release speed (METHOD §4).
#pragma once
#include "scalar.h"

namespace pbfd {

// N and dN/dd at depth d in a step that began at d₀; `per_range`: 1 / (release speed × Δt).
template <class V> inline void release_law(V stiffness, V depth, V start, V per_range, V& push, V& slope) {
  const V d = max(depth, V(0)), x = clamped(fma(depth - start, per_range, V(1)), V(0), V(1));
  const V whole = stiffness * d * d, share = x * x * fma(V(-2), x, V(3)), falls = V(6) * x * (V(1) - x) * per_range;
  push = share * whole;
  slope = fma(share * V(2), stiffness * d, falls * whole);
}

}  // namespace pbfd
