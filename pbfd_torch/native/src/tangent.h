// Steps followed ahead, from changes of what they are made of to those of what comes of them (retrace.h).
#pragma once
#include "retrace.h"

namespace pbfd {

template <class L, int D, template <class, class, int> class Scheme> struct Tangent : Retrace<L, D, Scheme> {
  using Base = Retrace<L, D, Scheme>;
  using typename Base::M, typename Base::T, typename Base::Written;
  using Base::aboard, Base::after, Base::asked, Base::column, Base::count, Base::parts, Base::plan, Base::residual;
  using Base::step, Base::sums, Base::tape, Base::world, Base::W;
  using Base::Base;

  void run(const Descent<T>& of, const Rules& rules, int first, int last) {
    Base::ask(of, rules);
    for (int at = 0; at < of.steps; at++) Base::each_group(at, first, last, [&](int h) { go(h); });
  }

 private:
  void go(int h) {
    const int leaves = Base::load(), n = plan.nv;
    Base::write(h);
    const M kept = Base::note(h);
    sums.resize(std::max(sums.size(), size_t(tape.count)));
    sums[0] = L(0);
    set_out();
    int done = leaves;
    for (int p = 0; p < 1 << h; p++) {
      const int delta = parts[p].delta, moves = delta + n - 1;
      follow(done, delta - 1);
      for (int j = 0; j < n; j++) sums[delta + j] = L(0);
      follow(moves, parts[p].balanced);
      for (int i = 0; i < W; i++) {
        for (int j = 0; j < n; j++) column[j] = lane(sums[residual[p * n + j]], i);
        parts[p].jacobian[i].solve(column.data());
        for (int j = 0; j < n; j++) put(sums[delta + j], i, -column[j]);
      }
      done = moves;
    }
    follow(done, tape.count - 1);
    hand_over(kept);
  }

  // The values after `first` up to `last`, of those before them.
  void follow(int first, int last) {
    const auto* nodes = tape.nodes.data();
    const L *slopes = tape.slopes.data(), zero(0);
    for (int i = first + 1; i <= last; i++) {
      const auto& n = nodes[i];
      const L a = sums[n.a], b = sums[n.b];
      // the slope of what was not selected may be anything
      const L sum = fma(select(a != zero, slopes[2 * i], zero), a, sums[n.c]);
      sums[i] = fma(select(b != zero, slopes[2 * i + 1], zero), b, sum);
    }
  }

  // What the leaves change by, in the order in which they were loaded.
  void set_out() {
    int k = 0, leaf = 1;
    auto take = [&](const void* array, long rows, int width) {
      for (int j = 0; j < width; j++, leaf++)
        for (int i = 0; i < W; i++) put(sums[leaf], i, static_cast<const T*>(array)[(rows + world[i]) * width + j]);
    };
    Written::each(plan, [&](auto, int width) {
      step ? take(asked->seen[k], long(step - 1) * asked->worlds, width) : take(asked->cotangent[k], 0, width);
      k++;
    });
    take(asked->by_control, long(step) * asked->worlds, plan.nu);
    if (asked->by_dt) take(asked->by_dt, 0, 1);
    if (asked->by_number) take(asked->by_number, 0, count());
  }

  void hand_over(M kept) {
    int k = 0;
    Written::each(plan, [&](auto member, int width) {
      T* out = static_cast<T*>(asked->seen[k++]) + asked->at(step, 0) * width;
      for (int j = 0; j < width; j++) {
        const L change = sums[(after.*member)[j].node];
        for (int i = 0; i < aboard; i++) out[long(world[i]) * width + j] = lane(kept, i) ? lane(change, i) : T(0);
      }
    });
  }
};

}  // namespace pbfd
