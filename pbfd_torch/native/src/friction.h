// Coulomb's friction as a drag, f = −G u, smooth below the slip ε (METHOD §4), as terms/coulomb_friction.py.
#pragma once
#include "scalar.h"

namespace pbfd {

// s = (2 − y/ε)/ε below ε, 1/y above; and (ds/dy)/y, 0 where nothing slips. `per_width`: 1/ε.
template <class V> inline void slip_law(V size, V per_width, V& factor, V& slope) {
  const auto slips = size > V(0);
  const V per_size = V(1) / select(slips, size, V(1)), per_larger = select(slips, min(per_size, per_width), per_width);
  factor = (V(2) - min(size * per_width, V(1))) * per_larger;
  slope = select(slips, -(per_larger * per_larger * per_size), V(0));
}

}  // namespace pbfd
