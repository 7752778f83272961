// Numbers whose computation is written down as it happens, to be followed back from what came of it to what went into it: reverse
// differentiation of the same templates that make the steps, of all lanes at once.
//
// A value is p·a + q·b + c of others, to first order; c is a plain summand. What comes of constants alone is a constant, and is not
// written down.
#pragma once
#include <cmath>
#include <vector>

#include "fitted.h"
#include "powers.h"
#include "rotations.h"

namespace pbfd {

template <class L> struct Tape {
  struct Node {
    int a, b, c;
  };
  std::vector<Node> nodes;
  std::vector<L> slopes;  // p, q of each
  int count = 1;  // what has the number 0 is constant

  // That which this thread writes on.
#if defined(__ELF__)
  [[gnu::tls_model("initial-exec")]]
#endif
  static inline thread_local Tape* current = nullptr;
  static Tape& here() { return *current; }

  void clear() { count = 1; }
  int add(int a, L p, int b, L q, int c) {
    if (count >= int(nodes.size())) grow();
    nodes[count] = {a, b, c}, slopes[2 * count] = p, slopes[2 * count + 1] = q;
    return count++;
  }
  void grow() {
    const size_t size = nodes.empty() ? 4096 : 2 * nodes.size();
    nodes.resize(size), slopes.resize(2 * size), slopes[ONE] = L(1);
  }
  static constexpr int ONE = 0;  // where among the slopes there is a one
};

template <class L> struct Traced {
  using T = typename Kind<L>::Scalar;
  L v;
  int node;
  Traced() = default;
  Traced(T x) : v(x), node(0) {}
  Traced(L x, int number) : v(x), node(number) {}

  static Traced of(L v, const Traced& a, L p) { return {v, a.node ? Tape<L>::here().add(a.node, p, 0, L(0), 0) : 0}; }
  static Traced of(L v, const Traced& a, L p, const Traced& b, L q) {
    return {v, a.node | b.node ? Tape<L>::here().add(a.node, p, b.node, q, 0) : 0};
  }

  friend Traced operator+(const Traced& a, const Traced& b) {
    const L v = a.v + b.v;
    if (!a.node) return {v, b.node};
    return {v, b.node ? Tape<L>::here().add(a.node, L(1), 0, L(0), b.node) : a.node};
  }
  friend Traced operator-(const Traced& a, const Traced& b) {
    const L v = a.v - b.v;
    return {v, b.node ? Tape<L>::here().add(b.node, L(-1), 0, L(0), a.node) : a.node};
  }
  friend Traced operator*(const Traced& a, const Traced& b) { return of(a.v * b.v, a, b.v, b, a.v); }
  friend Traced operator/(const Traced& a, const Traced& b) {
    const L per = L(1) / b.v, v = a.v / b.v;
    return of(v, a, per, b, -(v * per));
  }
  friend Traced operator-(const Traced& a) { return of(-a.v, a, L(-1)); }
  Traced& operator+=(const Traced& b) { return *this = *this + b; }
  Traced& operator-=(const Traced& b) { return *this = *this - b; }
  Traced& operator*=(const Traced& b) { return *this = *this * b; }
  friend auto operator<(const Traced& a, const Traced& b) { return a.v < b.v; }
  friend auto operator<=(const Traced& a, const Traced& b) { return a.v <= b.v; }
  friend auto operator>(const Traced& a, const Traced& b) { return a.v > b.v; }
  friend auto operator>=(const Traced& a, const Traced& b) { return a.v >= b.v; }
};

template <class L> struct Kind<Traced<L>> {
  using Scalar = typename Kind<L>::Scalar;
  using Mask = typename Kind<L>::Mask;
  static constexpr int lanes = Kind<L>::lanes;
};
template <class L> constexpr bool derived<Traced<L>> = true;

template <class L> inline auto lane(const Traced<L>& x, int i) { return lane(x.v, i); }
template <class L> inline void put(Traced<L>& x, int i, typename Kind<L>::Scalar value) { put(x.v, i, value), x.node = 0; }

template <class L> inline Traced<L> fma(const Traced<L>& a, const Traced<L>& b, const Traced<L>& c) {
  const L v = fma(a.v, b.v, c.v);
  if (!(a.node | b.node)) return {v, c.node};
  return {v, Tape<L>::here().add(a.node, b.v, b.node, a.v, c.node)};
}
template <class M, class L> inline Traced<L> select(const M& which, const Traced<L>& a, const Traced<L>& b) {
  return Traced<L>::of(select(which, a.v, b.v), a, select(which, L(1), L(0)), b, select(which, L(0), L(1)));
}
// What lies at the bound that it is clamped to, first of the two, still counts, as for torch.clamp.
template <class L> inline Traced<L> min(const Traced<L>& a, const Traced<L>& b) { return select(a.v <= b.v, a, b); }
template <class L> inline Traced<L> max(const Traced<L>& a, const Traced<L>& b) { return select(a.v >= b.v, a, b); }
template <class L> inline Traced<L> abs(const Traced<L>& a) {
  return Traced<L>::of(abs(a.v), a, select(a.v > L(0), L(1), select(a.v < L(0), L(-1), L(0))));
}
template <class L> inline Traced<L> sqrt(const Traced<L>& a) {
  const L root = sqrt(a.v);
  return Traced<L>::of(root, a, select(root > L(0), L(0.5) / root, L(0)));  // lengths are taken to stay at zero
}
template <class L> inline Traced<L> rounded(const Traced<L>& a) { return {rounded(a.v), 0}; }

template <class L> inline void sine_cosine(const Traced<L>& angle, Traced<L>& sine, Traced<L>& cosine) {
  L s, c;
  sine_cosine(angle.v, s, c);
  sine = Traced<L>::of(s, angle, c), cosine = Traced<L>::of(c, angle, -s);
}
template <class L> inline Traced<L> exponential(const Traced<L>& x) {
  const L y = exponential(x.v);
  return Traced<L>::of(y, x, y);
}
// Where x is 0 and the exponent below one, x is not what it depends on.
template <class L> inline Traced<L> power(const Traced<L>& x, typename Kind<L>::Scalar exponent) {
  using T = typename Kind<L>::Scalar;
  if (exponent == T(0)) return Traced<L>(T(1));
  const L y = power(x.v, exponent);
  return Traced<L>::of(y, x, select(x.v > L(0), L(exponent) * y / select(x.v > L(0), x.v, L(1)), exponent == T(1) ? L(1) : L(0)));
}

// The rise of θ(z) of fitted.h.
inline double fit_slope(double z) {
  if (z < 1e-2) return 1.0 / 12 - z * z / 240;
  const double s = std::expm1(-z);
  return -std::exp(-z) / (s * s) + 1 / (z * z);
}

// θ [nv] of springs, damping and actuators in a step, as fitted.h.
template <class L, int D> inline void fit(const Plan<Traced<L>, D>& plan, const Traced<L>& step, Traced<L>* share) {
  using V = Traced<L>;
  const V per = V(1) / step;
  for (int j = 0; j < plan.nv; j++) share[j] = fma(plan.damping[j], per, plan.spring[j]);
  for (int k = 0; k < plan.nu; k++) {
    V& slope = share[plan.actuated_v[k]];
    slope = fma(plan.gear[k] * plan.gear[k], fma(plan.resistance[k], per, plan.stiffness[k]), slope);
  }
  for (int n = 0; n < plan.nodes; n++)
    for (int j = plan.v[n]; j < plan.v[n] + freedoms(plan.kind[n]); j++) {
      const bool adds_up = freedoms(plan.kind[n]) == 1 || j < plan.v[n] + straight(plan.kind[n]);
      const V z = step * step * share[j] / plan.felt[j];
      L taken, rises;
      for (int i = 0; i < Kind<L>::lanes; i++) {
        const bool whole = !adds_up && lane(z, i) > 0;
        put(taken, i, whole ? 1.0 : fit(lane(z, i))), put(rises, i, whole ? 0.0 : fit_slope(lane(z, i)));
      }
      share[j] = V::of(taken, z, rises);
    }
}

}  // namespace pbfd
