// The kinds of pairs that touch: in this order candidates are sorted (native/plan_contact.py).
#pragma once
#include "grids.h"
#include "polyhedron.h"
#include "supports.h"

namespace pbfd {

template <class A, class B> struct Pair {
  using Surface = A;
  using Support = B;
};

// A function of its own, which the compiler takes by itself: many in one would be too large for it to be made well.
template <class F, class P> [[gnu::noinline]] void apart(F& visit, P pair, int first, int last) { visit(pair, first, last); }

// Visits each kind with the run of its candidates, `first` … `last` − 1: a loop of its own, without choices in it.
template <class N, int D, class F> inline void each_kind(const Candidates<N, D>& c, F&& visit) {
  int kind = 0, first = 0;
  auto next = [&](auto pair) {
    const int last = first + c.counts[kind++];
    if (first < last) apart(visit, pair, first, last);
    first = last;
  };
  next(Pair<Plane, Point>()), next(Pair<Plane, Ball>());
  if constexpr (D == 3) {
    next(Pair<Plane, Ellipsoid>());
    // a point there is a ball without a radius
    next(Pair<Placed<Globe>, Ball>()), next(Pair<Placed<Pill>, Ball>());
    next(Pair<Placed<Block>, Ball>()), next(Pair<Placed<Drum>, Ball>()), next(Pair<Placed<Polyhedron>, Ball>());
    next(Pair<Placed<Terrain>, Ball>()), next(Pair<Placed<Sampled>, Ball>());
    next(Pair<Placed<Terrain>, Ellipsoid>()), next(Pair<Placed<Sampled>, Ellipsoid>());
  }
}

}  // namespace pbfd
