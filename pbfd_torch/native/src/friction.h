// Coulomb's friction as a drag, f = −G u, smooth below the slip ε (METHOD §4), as terms/coulomb_friction.py.
#pragma once
#include "scalar.h"

namespace pbfd {

// s = (2 − y/ε)/ε below ε, 1/y above; and (ds/dy)/y, 0 where nothing slips.
template <class V> inline void slip_factor(V size, V width, V& factor, V& slope) {
  const V larger = max(size, width);
  factor = (V(2) - min(size, width) / width) / larger;
  slope = select(size > V(0), V(-1) / (larger * larger * select(size > V(0), size, V(1))), V(0));
}

}  // namespace pbfd
