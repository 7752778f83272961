// Steps followed back, from what came of them to what they were made of: from the state after a step, which gives what it takes of
// δ, g; and from r by −J⁻ᵀ g, which gives what it takes of all else through δ (retrace.h).
#pragma once
#include "retrace.h"
#include "route.h"

namespace pbfd {

template <class L, int D, template <class, class, int> class Scheme> struct Adjoint : Retrace<L, D, Scheme> {
  using Base = Retrace<L, D, Scheme>;
  using typename Base::M, typename Base::T, typename Base::Written;
  using Base::aboard, Base::after, Base::asked, Base::column, Base::count, Base::parts, Base::plan, Base::residual;
  using Base::step, Base::sums, Base::tape, Base::world, Base::W;
  static constexpr int AT_ONCE = 4;  // rows of derivatives that are followed side by side
  std::vector<Leg> legs;
  Routes<L>& routes = Base::template of_thread<Routes<L>>();
  using Base::Base;

  void run(const Descent<T>& of, const Rules& rules, int first, int last) {
    Base::ask(of, rules);
    for (int at = of.steps - 1; at >= 0; at--) Base::each_group(at, first, last, [&](int h) { go(h); });
  }

 private:
  void go(int h) {
    const int leaves = Base::load();
    Base::write(h);
    const M kept = Base::note(h);
    const Route<L>& way = route(h, leaves);
    int r = 0;
    for (; r + AT_ONCE <= asked->rows; r += AT_ONCE) rows<AT_ONCE>(r, h, kept, way);
    for (; r < asked->rows; r++) rows<1>(r, h, kept, way);
  }
  // R rows from the first on.
  template <int R> void rows(int first, int h, M kept, const Route<L>& way) {
    sums.resize(std::max(sums.size(), size_t(R) * way.places()));
    for (int r = 0; r < R; r++) sums[r] = L(0), seed<R>(first, r, kept, way);
    follow<R>(h, way);
    for (int r = 0; r < R; r++) hand_over<R>(first, r);
  }

  // From the state after the step through its parts, of each from its end and then from its balance, to what it was made of.
  const Route<L>& route(int h, int leaves) {
    std::vector<Leg>& all = legs;
    all.clear();
    int last = tape.count - 1;
    for (int p = (1 << h) - 1; p >= 0; p--) {
      const int n = plan.nv, delta = parts[p].delta;
      all.push_back({last, delta, n, false, {}});
      all.push_back({parts[p].balanced, delta + n, 0, true, {residual.begin() + p * n, residual.begin() + (p + 1) * n}});
      last = delta - 1;
    }
    all.push_back({last, 1, leaves, false, {}});
    Written::each(plan, [&](auto member, int width) {
      for (int j = 0; j < width; j++) all[0].seeds.push_back((after.*member)[j].node);
    });
    return routes.along(tape, all);
  }

  template <int R> void seed(int first, int r, M which, const Route<L>& way) {
    int k = 0, number = 0;
    Written::each(plan, [&](auto, int width) {
      for (int j = 0; j < width; j++) {
        L sum(0);
        for (int i = 0; i < W; i++) {
          if (!lane(which, i)) continue;
          T x = *Base::template row<T>(asked->cotangent[k], (long(first + r) * asked->worlds + world[i]) * width + j, 1);
          if (asked->seen[k]) x += *Base::template row<T>(asked->seen[k], asked->at(step, world[i]) * width + j, 1);
          put(sum, i, x);
        }
        sums[R * way.seed(number++) + r] = sum;
      }
      k++;
    });
  }

  template <int R> void follow(int h, const Route<L>& way) {
    int leg = 0, number = int(way.legs[0].seeds.size());
    for (int p = (1 << h) - 1; p >= 0; p--) {
      const int n = plan.nv;
      way.template follow<R>(leg++, tape, sums.data());
      for (int i = 0; i < W; i++)
        for (int r = 0; r < R; r++) {
          for (int j = 0; j < n; j++) column[j] = lane(sums[R * (parts[p].delta + j) + r], i);
          parts[p].jacobian[i].solve_transposed(column.data());
          for (int j = 0; j < n; j++) put(sums[R * way.seed(number + j) + r], i, -column[j]);
        }
      number += n;
      way.template follow<R>(leg++, tape, sums.data());
    }
    way.template follow<R>(leg, tape, sums.data());
  }

  // What the leaves have gathered, in the order in which they were loaded.
  template <int R> void hand_over(int first, int r) {
    int k = 0, leaf = 1;
    auto keep = [&](T* array, long rows, int width, bool sum) {
      for (int j = 0; j < width; j++, leaf++)
        for (int i = 0; i < aboard; i++) {
          T& x = array[(rows + world[i]) * width + j];
          x = lane(sums[R * leaf + r], i) + (sum ? x : T(0));
        }
    };
    Written::each(plan, [&](auto, int width) {
      keep(static_cast<T*>(asked->cotangent[k++]), long(first + r) * asked->worlds, width, false);
    });
    keep(asked->by_control, (long(first + r) * asked->steps + step) * asked->worlds, plan.nu, false);
    if (asked->by_dt) keep(asked->by_dt, 0, 1, true);
    if (asked->by_number) keep(asked->by_number, 0, count(), true);
  }
};

}  // namespace pbfd
