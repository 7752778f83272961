// What curved bodies touch other bodies with (terms/curved_body_contact.py): ellipsoids, and points that hold them, beside planes
// of the other body; or, where two round bodies touch at one point alone, the point where they come closest (terms/approaching.py).
//
// There the depth is −gap(n), and n makes the gap the largest: so the depth answers a motion as if n stayed, −δd = n · (the velocity
// of the body at p), while n itself, the arm s = −M n/h − μ l and the slip know how n and μ turn with both bodies.
#pragma once
#include "approach.h"
#include "facets.h"

namespace pbfd {

// What touches at such a point: n leans with the body that gives it.
struct Approaching : Ellipsoid {
  static constexpr bool leans = true;
  static constexpr int STEPS = 5;  // of Newton's method, from the direction at the start of the step
};

// A row's own numbers, see bodies.h.
template <class T> struct Curved {
  const T* at;
  T radius() const { return at[0]; }
  const T* form() const { return at + 1; }
  const T* axis() const { return at + 10; }
  const T* other_form() const { return at + 13; }
  const T* other_axis() const { return at + 22; }
};

// Where a body is in the lanes.
template <class V> struct Standing {
  const V *rotation, *position;
};

// M of a candidate, in the world.
template <class V, class T> inline void form_of(const Spot<V>& s, Curved<T> row, const V* R, V* out) {
  V own[9], half[9];
  const V ball = V(row.radius() * row.radius());
  for (int j = 0; j < 9; j++) own[j] = fma(s.rim, V(row.form()[j]), j % 4 == 0 ? ball : V(0));
  product(R, own, half), product_transposed(half, R, out);
}

// Both bodies, of which the first one has its centre at c.
template <class V, class T>
inline void both_of(const Spot<V>& s, Curved<T> row, Standing<V> one, Standing<V> other, const V* c, Approach<V>& out) {
  V center[3], half[9], axis[3];
  form_of(s, row, one.rotation, out.form[0]);
  product(other.rotation, row.other_form(), half), product_transposed(half, other.rotation, out.form[1]);
  times(other.rotation, s.other, center);
  for (int j = 0; j < 3; j++) out.between[j] = c[j] - (center[j] + other.position[j]);
  times(one.rotation, row.axis(), axis);
  for (int j = 0; j < 3; j++) out.line[0][j] = s.swept[0] * axis[j];
  times(other.rotation, row.other_axis(), axis);
  for (int j = 0; j < 3; j++) out.line[1][j] = s.swept[1] * axis[j];
}

// How deep it is, of which the plane's normal in the world and its distance from c are known: takes the direction over where
// the candidate follows both bodies.
template <class Support, class V, class T>
[[gnu::noinline]] V sunk(const Spot<V>& s, Curved<T> row, Standing<V> one, Standing<V> other, const V* c, Beside<V, 3>& solid) {
  const V reach = Approach<V>::reaching(s.rim * Ellipsoid::square(row.form(), one.rotation, solid.normal));
  V depth = V(row.radius()) - solid.distance + reach;
  solid.slide = V(0);
  if constexpr (Support::leans) {
    const auto follows = s.follows > V(0);
    if (!any(follows)) return depth;
    Approach<V> both;
    V n[3], slides[2];
    for (int j = 0; j < 3; j++) n[j] = select(follows, solid.normal[j], V(j == 2));
    both_of(s, row, one, other, c, both);
    both.look(n), both.close(Support::STEPS, slides);
    for (int j = 0; j < 3; j++) solid.normal[j] = select(follows, both.normal[j], solid.normal[j]);
    depth = select(follows, -both.gap, depth), solid.slide = select(follows, slides[0], V(0));
  }
  return depth;
}

// s.
template <class V, class T> inline void arm_of(const Spot<V>& s, Curved<T> row, Standing<V> one, const Beside<V, 3>& solid, V* out) {
  V form[9], y[3], axis[3];
  form_of(s, row, one.rotation, form);
  times(form, solid.normal, y), times(one.rotation, row.axis(), axis);
  const V h = Approach<V>::reaching(dot(y, solid.normal)), along = s.swept[0] * solid.slide;
  for (int j = 0; j < 3; j++) out[j] = select(h > V(Ellipsoid::POINT), -(y[j] / h), V(0)) - along * axis[j];
}

// s and how it answers; where n leans, ∂n/∂w.
template <class Support, class V, class T>
[[gnu::noinline]] void reach_out(const Spot<V>& s, Curved<T> row, Standing<V> one, Standing<V> other, const V* c,
                                 const Beside<V, 3>& solid, V* bend, Arm<V, 3>& out) {
  const V zero(0), *n = solid.normal;
  V form[9];
  form_of(s, row, one.rotation, form);
  Ellipsoid::arm<true>(form, n, bend, out);
  if constexpr (Support::leans) {
    for (int j = 0; j < 9; j++) bend[j] = out.by_shift[j] = out.tilt[j] = zero;
    for (int j = 0; j < 3; j++) out.reach_by_shift[j] = zero;
    const auto follows = s.follows > zero;
    if (!any(follows)) return;
    Approach<V> both;
    V up[3], y[3], leans[3], back[3];
    for (int j = 0; j < 3; j++) up[j] = select(follows, n[j], V(j == 2));
    both_of(s, row, one, other, c, both);
    both.look(up), both.hold();
    const V *line = both.line[0], per = V(1) / out.reach, slide = solid.slide;
    times(form, n, y), cross(line, n, leans);
    for (int j = 0; j < 3; j++) out.s[j] = fma(-slide, line[j], out.s[j]);
    cross(n, out.s, back);
    for (int b = 0; b < 6; b++) {  // ω, w
      const bool turns = b < 3;
      V* column = turns ? out.by_turn + b : out.by_shift + (b - 3);
      V pull[3], tilt[3], spreads[3], slides[2], lean[2] = {turns ? leans[b] : zero, zero};
      if (turns) {  // the line turns too
        const V e[3] = {V(b == 0), V(b == 1), V(b == 2)};
        cross(line, e, pull);
        for (int j = 0; j < 3; j++) column[3 * j] = pull[j] = fma(slide, pull[j], column[3 * j]);
      } else {
        for (int j = 0; j < 3; j++) pull[j] = V(j == b - 3);
      }
      both.answer(pull, lean, tilt, slides);
      for (V& x : tilt) x = select(follows, x, zero);
      slides[0] = select(follows, slides[0], zero);
      times(form, tilt, spreads);
      const V longer = dot(y, tilt) * per;
      for (int j = 0; j < 3; j++) {
        (turns ? out.tilt + b : bend + (b - 3))[3 * j] = tilt[j];
        column[3 * j] += fma(-slides[0], line[j], fma(y[j] * per, longer, -spreads[j]) * per);
      }
    }
    for (int b = 0; b < 3; b++) out.reach_by_turn[b] = select(follows, back[b], out.reach_by_turn[b]);
  }
}

}  // namespace pbfd
