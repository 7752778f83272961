// J x = b and Jᵀ x = b of one world by LU factors with pivots, as gradients/implicit.py has them (`Factors`).
#pragma once
#include <cmath>
#include <limits>
#include <vector>

namespace pbfd {

constexpr double SINGULAR = 64;  // of the machine's ε: a pivot this small is rounding

template <class T> struct Square {
  int n;
  std::vector<T> factors, size;  // of D⁻¹ J D⁻¹, and D
  std::vector<int> order;        // which row of it each row of the factors is
  std::vector<T> room;
  bool singular = false;  // beside what it is made of: then it is damped

  explicit Square(int count) : n(count), factors(count * count), size(count), order(count), room(count) {}

  // J(i, j), and D² = |K(i, i)|, the size of what J is made of.
  template <class J, class K> void factor(J&& jacobian, K&& stiffness) {
    for (int i = 0; i < n; i++) size[i] = std::sqrt(std::max(std::abs(stiffness(i)), std::numeric_limits<T>::min()));
    const T epsilon = std::numeric_limits<T>::epsilon();
    auto fill = [&](T damping) {
      for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
          const T x = jacobian(i, j) / (size[i] * size[j]) + (i == j ? damping : T(0));
          factors[n * i + j] = damping > 0 && !(std::abs(x) < T(HUGE_VAL)) ? T(0) : x;
        }
    };
    fill(T(0));
    singular = !(eliminate() > T(SINGULAR) * epsilon);
    if (singular) fill(std::sqrt(epsilon)), eliminate();
  }

  // x ← J⁻¹ x
  void solve(T* x) {
    for (int i = 0; i < n; i++) room[i] = x[order[i]] / size[order[i]];
    for (int i = 0; i < n; i++)
      for (int j = 0; j < i; j++) room[i] -= factors[n * i + j] * room[j];
    for (int i = n - 1; i >= 0; i--) {
      for (int j = i + 1; j < n; j++) room[i] -= factors[n * i + j] * room[j];
      room[i] /= factors[(n + 1) * i];
    }
    for (int i = 0; i < n; i++) x[i] = room[i] / size[i];
  }

  // x ← J⁻ᵀ x
  void solve_transposed(T* x) {
    for (int i = 0; i < n; i++) room[i] = x[i] / size[i];
    for (int i = 0; i < n; i++) {
      room[i] /= factors[(n + 1) * i];
      for (int j = i + 1; j < n; j++) room[j] -= factors[n * i + j] * room[i];
    }
    for (int i = n - 1; i >= 0; i--)
      for (int j = 0; j < i; j++) room[j] -= factors[n * i + j] * room[i];
    for (int i = 0; i < n; i++) x[order[i]] = room[i] / size[order[i]];
  }

 private:
  // The smallest pivot; not a number, where there is none.
  T eliminate() {
    T least = T(HUGE_VAL);
    for (int i = 0; i < n; i++) order[i] = i;
    for (int k = 0; k < n; k++) {
      int best = k;
      for (int i = k + 1; i < n; i++)
        if (std::abs(factors[n * i + k]) > std::abs(factors[n * best + k])) best = i;
      if (best != k) {
        std::swap(order[k], order[best]);
        for (int j = 0; j < n; j++) std::swap(factors[n * k + j], factors[n * best + j]);
      }
      const T pivot = factors[(n + 1) * k], size = std::abs(pivot);
      if (!(size >= least)) least = size;
      for (int i = k + 1; i < n; i++) {
        const T part = factors[n * i + k] /= pivot;
        for (int j = k + 1; j < n; j++) factors[n * i + j] -= part * factors[n * k + j];
      }
    }
    return least;
  }
};

}  // namespace pbfd
