// What bodies touch with: the arm s from a candidate's centre to the point that touches, p = c + s, and the reach h of the body
// towards the solid (terms/touching.py, terms/supported.py). How they answer goes by the turn ω of the body and the velocity w of the
// centre, by which the normal turns like B w.
//   `rolls`: the slip knows of the body's rotation.   `wanders`: what touches moves over the body as it turns.   `leans`: so does n.
#pragma once
#include "candidates.h"

namespace pbfd {

// ∂s/∂ω, ∂s/∂w and ∂h/∂ω, ∂h/∂w; those by ω where it wanders, those by w where the solid is not flat. tilt: ∂n/∂ω where n leans.
template <class V, int D> struct Arm {
  static constexpr int T = turns(D);
  V s[D], reach, by_turn[D * T], by_shift[D * D], reach_by_turn[T], reach_by_shift[D], tilt[D * T];
};

// A point, with a margin perhaps.
struct Point {
  static constexpr bool rolls = false, wanders = false, leans = false;
  template <class V, class N, int D> static V reach(const Candidates<N, D>&, int, const V*, const V*) { return V(0); }
  template <bool FLAT, class V, class N, int D>
  static void arm(const Candidates<N, D>&, int, const V*, const V*, const V*, Arm<V, D>& out) {
    for (int j = 0; j < D; j++) out.s[j] = V(0);
  }
};

// A ball around the centre: s = −ρ n.
struct Ball {
  static constexpr bool rolls = true, wanders = false, leans = false;
  template <class V, class N, int D> static V reach(const Candidates<N, D>& c, int i, const V*, const V*) { return V(c.radius[i]); }
  template <bool FLAT, class V, class N, int D>
  static void arm(const Candidates<N, D>& c, int i, const V*, const V* n, const V* bend, Arm<V, D>& out) {
    arm<FLAT>(V(c.radius[i]), n, bend, out);
  }
  template <bool FLAT, class V, int D> static void arm(V radius, const V* n, const V* bend, Arm<V, D>& out) {
    const V back = -radius;
    for (int j = 0; j < D; j++) out.s[j] = back * n[j];
    if constexpr (!FLAT && !derived<V>)
      for (int j = 0; j < D * D; j++) out.by_shift[j] = back * bend[j];
  }
};

// M = R diag(a²) Rᵀ: y = M n, h = √(n·y), s = −y/h. The rim of a cylinder is one, and the points that hold it are such without size.
struct Ellipsoid {
  static constexpr bool rolls = true, wanders = true, leans = false;
  static constexpr double POINT = 1e-12;  // [m] a smaller reach is that of a point

  template <class V, class N> static V reach(const Candidates<N, 3>& c, int i, const V* R, const V* n) {
    return sqrt(max(square(c.ellipsoid + 9 * c.form[i], R, n), V(POINT * POINT)));
  }
  // nᵀM n, of a form [9] on the body.
  template <class V, class F> static V square(const F* form, const V* R, const V* n) {
    V own[3], spread[3];
    transposed_times(R, n, own);
    for (int j = 0; j < 3; j++)
      spread[j] = fma(V(form[3 * j]), own[0], fma(V(form[3 * j + 1]), own[1], V(form[3 * j + 2]) * own[2]));
    return dot(own, spread);
  }

  template <bool FLAT, class V, class N>
  [[gnu::noinline]] static void arm(const Candidates<N, 3>& c, int i, const V* R, const V* n, const V* bend, Arm<V, 3>& out) {
    V M[9], half[9];
    product(R, c.ellipsoid + 9 * c.form[i], half);
    product_transposed(half, R, M);
    arm<FLAT>(M, n, bend, out);
  }
  template <bool FLAT, class V> static void arm(const V* M, const V* n, const V* bend, Arm<V, 3>& out) {
    V y[3];
    times(M, n, y);
    const V h = sqrt(max(dot(n, y), V(POINT * POINT))), per = V(1) / h;
    const auto solid = h > V(POINT);
    out.reach = h;
    for (int j = 0; j < 3; j++) out.s[j] = select(solid, -(y[j] * per), V(0));
    if constexpr (!derived<V>) slope<FLAT>(M, n, bend, y, per, out);
  }
  // How both answer.
  template <bool FLAT, class V> static void slope(const V* M, const V* n, const V* bend, const V* y, V per, Arm<V, 3>& out) {
    V lean[3];
    // δy = ω × y − M (ω × n) + M B w,  δh = (ω · (y × n) + y · B w)/h,  δs = (y δh/h − δy)/h
    auto steer = [&](const V* spreads, V reaches, V* column) {
      for (int j = 0; j < 3; j++) column[3 * j] = fma(y[j] * per, reaches, -spreads[j]) * per;
    };
    cross(y, n, lean);
    const V N_[9] = {V(0), -n[2], n[1], n[2], V(0), -n[0], -n[1], n[0], V(0)};
    const V Y[9] = {V(0), -y[2], y[1], y[2], V(0), -y[0], -y[1], y[0], V(0)};
    for (int b = 0; b < 3; b++) {
      const V beside[3] = {N_[b], N_[3 + b], N_[6 + b]};
      V spreads[3];
      times(M, beside, spreads);
      for (int j = 0; j < 3; j++) spreads[j] = spreads[j] - Y[3 * j + b];
      out.reach_by_turn[b] = lean[b] * per;
      steer(spreads, out.reach_by_turn[b], out.by_turn + b);
    }
    if constexpr (!FLAT)
      for (int b = 0; b < 3; b++) {
        const V tilt[3] = {bend[b], bend[3 + b], bend[6 + b]};
        V spreads[3];
        times(M, tilt, spreads);
        out.reach_by_shift[b] = dot(y, tilt) * per;
        steer(spreads, out.reach_by_shift[b], out.by_shift + b);
      }
  }

  // h'' less what ω̇ makes of it and what a material point at p does, of a body that spins at ω: with η = −ω × n
  // (ηᵀM η − (s·η)²)/h − n·(ω × (ω × s)).
  template <class V, class N>
  [[gnu::noinline]] static V bulge(const Candidates<N, 3>& c, int i, const V* R, const V* n, const Arm<V, 3>& arm, const V* spin) {
    V turning[3], own[3], spread[3], swept[3], inward[3];
    cross(n, spin, turning);
    transposed_times(R, turning, own);
    const N* form = c.ellipsoid + 9 * c.form[i];
    for (int j = 0; j < 3; j++)
      spread[j] = fma(V(form[3 * j]), own[0], fma(V(form[3 * j + 1]), own[1], V(form[3 * j + 2]) * own[2]));
    cross(spin, arm.s, swept), cross(spin, swept, inward);
    const V along = dot(arm.s, turning);
    return fma(-along, along, dot(own, spread)) / arm.reach - dot(inward, n);
  }

  // Of its normal force that a candidate gives: points hold a rim that lies flat, the rim itself counts where it does not.
  template <class V, class N> static V share(const Candidates<N, 3>& c, int i, const V* R, const V* n) {
    V axis[3];
    times(R, c.axis + 3 * c.form[i], axis);
    return share(V(c.lying[c.form[i]]), dot(axis, n));
  }
  template <class V> static V share(V lying, V cosine) {
    constexpr double FLAT = 0.02, STEEP = 0.1;  // of the sine between axis and normal
    const V x = clamped((fma(-cosine, cosine, V(1)) - V(FLAT * FLAT)) / V(STEEP * STEEP - FLAT * FLAT), V(0), V(1));
    const V steep = x * x * x * (V(10) - x * (V(15) - V(6) * x));
    return select(lying > V(0), V(1) - steep, select(lying < V(0), steep, V(1)));
  }
};

}  // namespace pbfd
