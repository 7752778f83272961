// A plan as the interface has it, as the core reads it.
#pragma once
#include "carriers.h"
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

// Where obstacles that move are, as a call has it.
template <class T, class A> Timetable<T> timetable(const pbfd_plan* p, const A* asked) {
  return {static_cast<const T*>(asked->poses), asked->timed, p->moving};
}

template <class V> Numbers<V> numbers_of(const pbfd_plan* p, const void* own, int first, int count, Arena<V>& arena) {
  using T = typename Kind<V>::Scalar;
  return {static_cast<const T*>(p->real), first, count, p->varied, p->which, static_cast<const T*>(own), arena};
}

// make(plan, numbers, μ, arena) with a plan whose numbers are lanes: any may be of its own for each world.
template <class V, int D, class F> void with_each(const pbfd_plan* p, const void* rows, Arena<V> arena, F&& make) {
  Numbers<V> own = numbers_of(p, rows, 0, Plan<V, D>::real_numbers(sizes(p)), arena);
  const Plan<V, D> plan = plan_of<V, D>(p, own.lanes);
  make(plan, own, plan.contact.grip, arena);
}

// Room for steps that are followed back [bytes] (descent.cpp).
long room_back(Sizes s);

}  // namespace pbfd
