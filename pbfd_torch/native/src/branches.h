// Which degrees of freedom J couples: those on one branch of the tree, and those of bodies that touch each other.
#pragma once
#include "plan.h"

namespace pbfd {

// Of each dof how many others it is coupled to that are eliminated after it, and which: [nv], [nv × nv], the nearest first.
struct Branches {
  int count;
  const int *depth, *above;
};

template <class N, int D> inline Branches tree(const Plan<N, D>& plan) { return {plan.nv, plan.depth, plan.above}; }

// The tree with bodies coupled, and what fills in.
struct Coupling {
  int nodes, count;
  int *depth, *above;
  bool *joined, *wanted;  // [nodes × nodes]: pairs of bodies, those that there are and those that there ought to be
  bool* coupled;          // [nv × nv]

  static int bytes(int nodes, int nv) { return int(sizeof(int)) * nv * (nv + 1) + 2 * nodes * nodes + nv * nv; }
  Coupling(int bodies, int nv, char* room) : nodes(bodies), count(nv) {
    depth = reinterpret_cast<int*>(room), above = depth + nv;
    joined = reinterpret_cast<bool*>(above + nv * nv), wanted = joined + nodes * nodes, coupled = wanted + nodes * nodes;
  }
  Branches branches() const { return {count, depth, above}; }

  template <class N, int D> void begin(const Plan<N, D>& plan) {
    for (int i = 0; i < nodes * nodes; i++) joined[i] = wanted[i] = false;
    rebuild(plan);
  }

  // Takes over what is wanted; whether that is something else.
  template <class N, int D> bool renew(const Plan<N, D>& plan) {
    bool same = true;
    for (int i = 0; i < nodes * nodes; i++) same = same && joined[i] == wanted[i];
    if (same) return false;
    for (int i = 0; i < nodes * nodes; i++) joined[i] = wanted[i];
    rebuild(plan);
    return true;
  }

 private:
  template <class N, int D> void rebuild(const Plan<N, D>& plan) {
    const int n = count;
    for (int i = 0; i < n * n; i++) coupled[i] = false;
    for (int j = 0; j < n; j++)
      for (int a = 0; a < plan.depth[j]; a++) coupled[n * j + plan.above[n * j + a]] = true;
    for (int k = 0; k < nodes; k++)
      for (int l = 0; l < nodes; l++)
        if (joined[nodes * k + l])
          each_dof(plan, k, [&](int i) {
            each_dof(plan, l, [&](int j) {
              if (i != j) coupled[n * (i > j ? i : j) + (i > j ? j : i)] = true;
            });
          });
    for (int j = n - 1; j >= 0; j--) {
      int* list = above + n * j;
      depth[j] = 0;
      for (int i = j - 1; i >= 0; i--)
        if (coupled[n * j + i]) list[depth[j]++] = i;
      for (int a = 0; a < depth[j]; a++)
        for (int b = a + 1; b < depth[j]; b++) coupled[n * list[a] + list[b]] = true;
    }
  }
};

// Of all dofs that move a node, its own joint's first.
template <class N, int D, class F> inline void each_dof(const Plan<N, D>& plan, int node, F&& visit) {
  const int last = plan.v[node] + freedoms(plan.kind[node]) - 1;
  visit(last);
  for (int a = 0; a < plan.depth[last]; a++) visit(plan.above[plan.nv * last + a]);
}

}  // namespace pbfd
