// A plan as the interface has it, as the core reads it.
#pragma once
#include "interface.h"
#include "plan.h"

namespace pbfd {

inline Sizes sizes(const pbfd_plan* p) {
  const CandidateSizes contact{p->candidates, p->anchors, p->planes, p->solids, p->samples, p->forms, p->uncommon};
  return {contact, p->nodes, p->nq, p->nv, p->nu, p->pushes,
          {p->links, p->groups, p->rows, p->pairs, p->colliders, p->slots, p->remembered}, p->moving};
}

template <class N, int D> Plan<N, D> plan_of(const pbfd_plan* p, const N* numbers) {
  using T = typename Kind<N>::Scalar;
  return {sizes(p), p->whole, numbers, static_cast<const T*>(p->sample), p->body_whole, static_cast<const T*>(p->body_real)};
}

}  // namespace pbfd
