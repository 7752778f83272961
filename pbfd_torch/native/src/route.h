// The way back along a tape: every value's derivative is the sum, over all that was made of it, of a slope times the derivative of
// that. Which sums there are, and in which order, is found once for all tapes that were written alike.
#pragma once
#include <cstring>

#include "traced.h"

namespace pbfd {

// A part of the way: derivatives by the values last … first, of seeds, which are derivatives by some of these, and of what has been
// found before. `again`: of the seeds alone, and of what is made of them among these values. The first `wanted` of the values get one
// in any case.
struct Leg {
  int last, first, wanted;
  bool again;
  std::vector<int> seeds;  // values
};

template <class L> struct Route {
  using Node = typename Tape<L>::Node;
  struct Term {
    int from, slope, to, more;  // more: −1 where it is added to the last one, else 0
  };
  std::vector<Node> nodes;
  std::vector<Leg> legs;
  std::vector<Term> terms;
  std::vector<int> ends;  // of the legs, among the terms
  int count = 0;

  // Where derivatives are: of values, of those found again, and of seeds, numbered through all legs.
  int place(bool again, int value) const { return again ? count + value : value; }
  int seed(int number) const { return 2 * count + number; }
  int places() const {
    int all = 2 * count;
    for (const Leg& leg : legs) all += int(leg.seeds.size());
    return all;
  }

  bool leads_back(const Tape<L>& tape, const std::vector<Leg>& parts) const {
    if (tape.count != count || parts.size() != legs.size()) return false;
    for (size_t i = 0; i < parts.size(); i++) {
      const Leg &a = parts[i], &b = legs[i];
      if (a.last != b.last || a.first != b.first || a.seeds != b.seeds) return false;
    }
    return std::memcmp(nodes.data() + 1, tape.nodes.data() + 1, (count - 1) * sizeof(Node)) == 0;
  }

  void find(const Tape<L>& tape, const std::vector<Leg>& parts) {
    count = tape.count, legs = parts, nodes.assign(tape.nodes.begin(), tape.nodes.begin() + count), terms.clear(), ends.clear();
    // what each value went into, the earliest first
    std::vector<int> begin(count + 1), into, slope;
    auto each_use = [&](auto&& visit) {
      for (int k = 1; k < count; k++) {
        const Node& n = nodes[k];
        if (n.a) visit(n.a, k, 2 * k);
        if (n.b) visit(n.b, k, 2 * k + 1);
        if (n.c) visit(n.c, k, Tape<L>::ONE);
      }
    };
    each_use([&](int of, int, int) { begin[of + 1]++; });
    for (int j = 0; j < count; j++) begin[j + 1] += begin[j];
    into.resize(begin[count]), slope.resize(begin[count]);
    std::vector<int> next(begin.begin(), begin.end() - 1);
    each_use([&](int of, int k, int by) { into[next[of]] = k, slope[next[of]++] = by; });

    std::vector<char> found(2 * count);
    // the last seed of each value, and the one before it; what comes before a leg is found once only
    std::vector<int> seeded[] = {std::vector<int>(count, -1), std::vector<int>(count, -1)}, other;
    for (const Leg& leg : legs) {
      for (int value : leg.seeds) {
        int& last = seeded[leg.again && value >= leg.first][value];
        other.push_back(last);
        last = int(other.size()) - 1;
      }
      for (int j = leg.last; j >= leg.first; j--) {
        const size_t before = terms.size();
        const int to = place(leg.again, j);
        auto add = [&](int from, int by) { terms.push_back({from, by, to, terms.size() > before ? -1 : 0}); };
        for (int s = seeded[leg.again][j]; s >= 0; s = other[s]) add(seed(s), Tape<L>::ONE);
        for (int u = begin[j]; u < begin[j + 1]; u++)
          for (bool again : {false, true}) {
            const bool counts = leg.again ? again && into[u] <= leg.last : true;
            if (counts && found[place(again, into[u])]) add(place(again, into[u]), slope[u]);
          }
        found[to] = terms.size() > before;
        if (!found[to] && j < leg.first + leg.wanted) add(0, Tape<L>::ONE);
      }
      ends.push_back(int(terms.size()));
    }
  }

  // One of the legs, of R derivatives side by side at each place; there is nothing at place 0.
  template <int R> void follow(int leg, const Tape<L>& tape, L* sums) const {
    const L *slopes = tape.slopes.data(), zero(0);
    const Term *term = terms.data() + (leg ? ends[leg - 1] : 0), *end = terms.data() + ends[leg];
    L sum[R];
    for (L& x : sum) x = zero;
    for (; term < end; term++) {
      const L slope = slopes[term->slope], *d = sums + R * term->from;
      L* to = sums + R * term->to;
      for (int r = 0; r < R; r++) {
        // the slope of what was not selected may be anything
        sum[r] = fma(select(d[r] != zero, slope, zero), d[r], kept(sum[r], term->more));
        to[r] = sum[r];
      }
    }
  }
};

// Those that were found last.
template <class L> struct Routes {
  static constexpr int MOST = 128;
  std::vector<Route<L>> known;
  int oldest = 0, last = 0;

  const Route<L>& along(const Tape<L>& tape, const std::vector<Leg>& parts) {
    for (int i = 0; i < int(known.size()); i++) {
      const int at = (last + i) % int(known.size());
      if (known[at].leads_back(tape, parts)) return known[last = at];
    }
    last = int(known.size()) < MOST ? (known.emplace_back(), int(known.size()) - 1) : oldest++ % MOST;
    known[last].find(tape, parts);
    return known[last];
  }
};

}  // namespace pbfd
