// The kinds of pairs that touch: in this order candidates are sorted (native/plan_contact.py).
#pragma once
#include "supports.h"
#include "surfaces.h"

namespace pbfd {

template <class A, class B> struct Pair {
  using Surface = A;
  using Support = B;
};

// Visits each kind with the run of its candidates, `first` … `last` − 1: a loop of its own, without choices in it.
template <class N, int D, class F> inline void each_kind(const Candidates<N, D>& c, F&& visit) {
  int kind = 0, first = 0;
  auto next = [&](auto pair) {
    const int last = first + c.counts[kind++];
    if (first < last) visit(pair, first, last);
    first = last;
  };
  next(Pair<Plane, Point>()), next(Pair<Plane, Ball>());
}

}  // namespace pbfd
