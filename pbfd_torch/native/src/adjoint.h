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
    for (int r = 0; r < asked->rows; r++) seed(r, kept, way), follow(h, way), hand_over(r);
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
    const Route<L>& found = routes.along(tape, all);
    sums.resize(std::max(sums.size(), size_t(found.places())));
    sums[0] = L(0);
    return found;
  }

  void seed(int r, M which, const Route<L>& way) {
    int k = 0, number = 0;
    Written::each(plan, [&](auto, int width) {
      for (int j = 0; j < width; j++) {
        L sum(0);
        for (int i = 0; i < W; i++) {
          if (!lane(which, i)) continue;
          T x = *Base::template row<T>(asked->cotangent[k], (long(r) * asked->worlds + world[i]) * width + j, 1);
          if (asked->seen[k]) x += *Base::template row<T>(asked->seen[k], asked->at(step, world[i]) * width + j, 1);
          put(sum, i, x);
        }
        sums[way.seed(number++)] = sum;
      }
      k++;
    });
  }

  void follow(int h, const Route<L>& way) {
    int leg = 0, number = int(way.legs[0].seeds.size());
    for (int p = (1 << h) - 1; p >= 0; p--) {
      const int n = plan.nv;
      way.follow(leg++, tape, sums.data());
      for (int i = 0; i < W; i++) {
        for (int j = 0; j < n; j++) column[j] = lane(sums[parts[p].delta + j], i);
        parts[p].jacobian[i].solve_transposed(column.data());
        for (int j = 0; j < n; j++) put(sums[way.seed(number + j)], i, -column[j]);
      }
      number += n;
      way.follow(leg++, tape, sums.data());
    }
    way.follow(leg, tape, sums.data());
  }

  // What the leaves have gathered, in the order in which they were loaded.
  void hand_over(int r) {
    int k = 0, leaf = 1;
    auto keep = [&](T* array, long rows, int width, bool sum) {
      for (int j = 0; j < width; j++, leaf++) {
        for (int i = 0; i < aboard; i++) {
          T& x = array[(rows + world[i]) * width + j];
          x = lane(sums[leaf], i) + (sum ? x : T(0));
        }
      }
    };
    Written::each(plan, [&](auto, int width) { keep(static_cast<T*>(asked->cotangent[k++]), long(r) * asked->worlds, width, false); });
    keep(asked->by_control, (long(r) * asked->steps + step) * asked->worlds, plan.nu, false);
    if (asked->by_dt) keep(asked->by_dt, 0, 1, true);
    if (asked->by_number) keep(asked->by_number, 0, count(), true);
  }
};

}  // namespace pbfd
