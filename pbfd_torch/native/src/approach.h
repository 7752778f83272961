// The closest approach of two round bodies (contact/approach.py): ellipsoids with centres c and forms M, swept along lines with
// directions l, or not where these are zero. Their distance is the largest of
//   gap(n) = n·(c₁ − c₂) − h₁ − h₂,   h = √(nᵀM n),   n·l₁ = n·l₂ = 0,
// over all unit n, from the second to the first. Newton's method on the sphere finds it; by its matrix K n also answers a motion.
#pragma once
#include "supports.h"

namespace pbfd {

template <class V> struct Approach {
  using M = typename Kind<V>::Mask;
  static constexpr bool DOUBLE = sizeof(typename Kind<V>::Scalar) == 8;
  static constexpr double POINT = Ellipsoid::POINT;
  static constexpr double BENT = 0.9;  // of the least radius of curvature: deeper overlaps count as so deep, lest steps go downhill
  static constexpr double ENOUGH = DOUBLE ? 1e-9 : 1e-4;  // a shorter step of Newton's method is the last but one

  V between[3], form[2][9], line[2][3];  // in the world
  // along n
  V normal[3], spread[2][3], reach[2], gap;
  // across n: two directions, K⁻¹, the lines, what they hold and how tightly; [m] by which a line holds n
  V across[6], inverse[3], seen[4], held[4], tight[3], size;

  // Along a direction.
  void look(const V* n) {
    for (int j = 0; j < 3; j++) normal[j] = n[j];
    for (int i = 0; i < 2; i++) times(form[i], normal, spread[i]), reach[i] = reaching(dot(spread[i], normal));
    gap = dot(between, normal) - (reach[0] + reach[1]);
  }

  // After so many steps of Newton's method, with μ [2] by which the nearest points lie aside, − μ l₁ and + μ l₂.
  void close(int steps, V* slides) {
    V turn[3];
    M open(true);  // each lane by itself
    for (int k = 1; k < steps; k++) {
      step(turn, slides);
      open = open & (dot(turn, turn) > V(ENOUGH * ENOUGH));
      if (!any(open)) break;
      climb(open, turn);
    }
    nearer(slides);
  }

  // After one step.
  void nearer(V* slides) {
    V turn[3], n[3];
    step(turn, slides);
    ahead(turn, V(1), n), look(n);
  }

  // What `answer` needs.
  [[gnu::noinline]] void hold() {
    const V x = abs(normal[0]), y = abs(normal[1]), z = abs(normal[2]);
    const M first = (x <= y) & (x <= z), second = (!first) & (y <= z);
    const V flattest[3] = {select(first, V(1), V(0)), select(second, V(1), V(0)), select(first | second, V(0), V(1))};
    V *u = across, *w = across + 3, bent[3] = {V(0), V(0), V(0)};
    cross(normal, flattest, u);
    const V length = sqrt(dot(u, u));
    for (int j = 0; j < 3; j++) u[j] = u[j] / length;
    cross(normal, u, w);
    size = reach[0] + reach[1] + sqrt(dot(between, between));
    for (int i = 0; i < 2; i++) {
      V along[3], aside[3];
      times(form[i], u, along), times(form[i], w, aside);
      const V a = dot(u, spread[i]) / reach[i], b = dot(w, spread[i]) / reach[i], p = dot(u, line[i]), q = dot(w, line[i]);
      bent[0] += (dot(u, along) - a * a) / reach[i] + size * p * p;
      bent[1] += (dot(u, aside) - a * b) / reach[i] + size * p * q;
      bent[2] += (dot(w, aside) - b * b) / reach[i] + size * q * q;
      seen[i] = p, seen[2 + i] = q;
    }
    const V half = V(0.5) * (bent[0] - bent[2]);
    const V least = V(0.5) * (bent[0] + bent[2]) - sqrt(fma(half, half, fma(bent[1], bent[1], V(POINT * POINT))));
    const V kept = max(gap, V(-BENT) * least);
    bent[0] += kept, bent[2] += kept;
    inverted(bent, inverse);
    for (int i = 0; i < 2; i++) applied(inverse, seen[i], seen[2 + i], held[i], held[2 + i]);
    V pull[3];
    for (int k = 0; k < 3; k++) {
      const int i = k / 2, j = (k + 1) / 2;
      pull[k] = fma(seen[i], held[j], seen[2 + i] * held[2 + j]);
    }
    pull[0] += select(dot(line[0], line[0]) > V(0), V(0), V(1));  // what has no line has no μ
    pull[2] += select(dot(line[1], line[1]) > V(0), V(0), V(1));
    inverted(pull, tight);
  }

  // Where n and μ go as ∇gap grows by `pull` [3] and n·l by `leans` [2] while n stays.
  void answer(const V* pull, const V* leans, V* turn, V* slides) const {
    const V p = dot(across, pull), q = dot(across + 3, pull);
    V x, y, mu[2];
    applied(tight, fma(held[0], p, fma(held[2], q, leans[0])), fma(held[1], p, fma(held[3], q, leans[1])), mu[0], mu[1]);
    applied(inverse, p, q, x, y);
    x = x - fma(held[0], mu[0], held[1] * mu[1]), y = y - fma(held[2], mu[0], held[3] * mu[1]);
    for (int j = 0; j < 3; j++) turn[j] = fma(across[j], x, across[3 + j] * y);
    for (int i = 0; i < 2; i++) slides[i] = fma(-size, leans[i], mu[i]);
  }

  static V reaching(V square) { return sqrt(max(square, V(POINT * POINT))); }

 private:
  // Newton's step of n, not longer than one, and μ.
  void step(V* turn, V* slides) {
    hold();
    V grow[3], leans[2];
    for (int j = 0; j < 3; j++) grow[j] = between[j] - (spread[0][j] / reach[0] + spread[1][j] / reach[1]);
    for (int i = 0; i < 2; i++) leans[i] = dot(line[i], normal);
    answer(grow, leans, turn, slides);
    const V shorter = V(1) / sqrt(max(dot(turn, turn), V(1)));
    for (int j = 0; j < 3; j++) turn[j] = turn[j] * shorter;
  }

  void ahead(const V* turn, V part, V* n) const {
    for (int j = 0; j < 3; j++) n[j] = fma(part, turn[j], normal[j]);
    const V per = V(1) / sqrt(dot(n, n));
    for (int j = 0; j < 3; j++) n[j] = n[j] * per;
  }

  // That part of a step after which the gap is the largest: where a rim is seen along its axis, whole ones miss.
  [[gnu::noinline]] void climb(M open, const V* turn) {
    constexpr double PARTS[4] = {1.0, 0.5, 0.2, 0.05};
    V best[3] = {V(0), V(0), V(0)}, most(0);
    for (int k = 0; k < 4; k++) {
      V n[3], y[3], height(0);
      ahead(turn, V(PARTS[k]), n);
      for (int i = 0; i < 2; i++) {
        times(form[i], n, y);
        height -= fma(V(2) * size, abs(dot(line[i], n)), reaching(dot(y, n)));  // leaning costs more than μ is worth
      }
      height += dot(between, n);
      const M higher = k == 0 ? M(true) : height > most;
      most = select(higher, height, most);
      for (int j = 0; j < 3; j++) best[j] = select(higher, n[j], best[j]);
    }
    for (int j = 0; j < 3; j++) best[j] = select(open, best[j], normal[j]);
    look(best);
  }

  // Symmetric matrices [2 × 2] as their three entries: the inverse, finite for those that are not positive definite; and A x.
  static void inverted(const V* matrix, V* out) {
    constexpr double EPS = DOUBLE ? 2.220446049250313e-16 : 1.1920929e-07, TINY = DOUBLE ? 2.2250738585072014e-308 : 1.1754944e-38;
    const V a = matrix[0], b = matrix[1], c = matrix[2], whole = a * c, most = abs(whole);
    const V det = whole - b * b, per = V(1) / select(det > V(EPS) * most, det, max(most, V(TINY)));
    out[0] = c * per, out[1] = -b * per, out[2] = a * per;
  }
  static void applied(const V* matrix, V x, V y, V& first, V& second) {
    first = fma(matrix[0], x, matrix[1] * y), second = fma(matrix[1], x, matrix[2] * y);
  }
};

}  // namespace pbfd
