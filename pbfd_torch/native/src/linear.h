// J x = b where J couples the dofs of `Branches` only, eliminated from the leaves on: along the tree alone nothing fills in. Without
// pivots: what is eliminated first is what stands for the lightest bodies.
#pragma once
#include "branches.h"

namespace pbfd {

// Factors `matrix` [nv × nv] in place, the pivots' inverses on its diagonal; the sign of its determinant.
template <class V> inline V factor(const Branches& along, V* matrix) {
  const int n = along.count;
  V sign(1);
  for (int j = n - 1; j >= 0; j--) {
    const int *above = along.above + n * j, depth = along.depth[j];
    V* row = matrix + n * j;
    const V pivot = row[j], inverse = V(1) / pivot;
    sign = select(pivot < V(0), -sign, select(pivot > V(0), sign, V(0)));
    for (int a = 0; a < depth; a++) {
      V* other = matrix + n * above[a];
      const V part = other[j] * inverse;
      for (int b = 0; b < depth; b++) other[above[b]] = fma(-part, row[above[b]], other[above[b]]);
      other[j] = part;
    }
    row[j] = inverse;
  }
  return sign;
}

// x ← matrix⁻¹ x by the factors.
template <class V> inline void substitute(const Branches& along, const V* matrix, V* x) {
  const int n = along.count;
  for (int j = n - 1; j >= 0; j--) {
    const int* above = along.above + n * j;
    for (int a = 0; a < along.depth[j]; a++) x[above[a]] = fma(-matrix[n * above[a] + j], x[j], x[above[a]]);
  }
  for (int j = 0; j < n; j++) {
    const int* above = along.above + n * j;
    V sum = x[j];
    for (int a = 0; a < along.depth[j]; a++) sum = fma(-matrix[n * j + above[a]], x[above[a]], sum);
    x[j] = sum * matrix[n * j + j];
  }
}

}  // namespace pbfd
