// J x = b where J couples dofs on one branch of the tree only: eliminated from the leaves on, nothing fills in. Without pivots:
// what is eliminated first is what stands for the lightest bodies.
#pragma once
#include "plan.h"

namespace pbfd {

// Dofs before j in its joint k, and those of all joints above.
template <class N, class F> inline void above(const Plan<N>& plan, int k, int j, F&& visit) {
  for (int i = plan.v[k]; i < j; i++) visit(i);
  for (int up = plan.parent[k]; up >= 0; up = plan.parent[up])
    for (int i = plan.v[up]; i < plan.v[up] + freedoms(plan.kind[up]); i++) visit(i);
}

// Factors `matrix` [nv × nv] in place, the pivots' inverses on its diagonal; the sign of its determinant.
template <class V, class N> inline V factor_along_the_tree(const Plan<N>& plan, V* matrix) {
  const int n = plan.nv;
  V sign(1);
  for (int k = plan.nodes - 1; k >= 0; k--)
    for (int j = plan.v[k] + freedoms(plan.kind[k]) - 1; j >= plan.v[k]; j--) {
      const V pivot = matrix[j * n + j], inverse = V(1) / pivot;
      sign = select(pivot < V(0), -sign, select(pivot > V(0), sign, V(0)));
      above(plan, k, j, [&](int i) {
        const V part = matrix[i * n + j] * inverse;
        above(plan, k, j, [&](int l) { matrix[i * n + l] = fma(-part, matrix[j * n + l], matrix[i * n + l]); });
        matrix[i * n + j] = part;
      });
      matrix[j * n + j] = inverse;
    }
  return sign;
}

// x ← matrix⁻¹ x by the factors.
template <class V, class N> inline void substitute_along_the_tree(const Plan<N>& plan, const V* matrix, V* x) {
  const int n = plan.nv;
  for (int k = plan.nodes - 1; k >= 0; k--)
    for (int j = plan.v[k] + freedoms(plan.kind[k]) - 1; j >= plan.v[k]; j--)
      above(plan, k, j, [&](int i) { x[i] = fma(-matrix[i * n + j], x[j], x[i]); });
  for (int k = 0; k < plan.nodes; k++)
    for (int j = plan.v[k]; j < plan.v[k] + freedoms(plan.kind[k]); j++) {
      V sum = x[j];
      above(plan, k, j, [&](int i) { sum = fma(-matrix[j * n + i], x[i], sum); });
      x[j] = sum * matrix[j * n + j];
    }
}

}  // namespace pbfd
