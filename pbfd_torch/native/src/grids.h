// Solids that are sampled: terrain (contact/height_field.py) and meshes (contact/distance_grid.py). For `Placed`.
#pragma once
#include "solids.h"
#include "splines.h"

namespace pbfd {

// Everything below z = h(x, y): φ = s (z − h), s = 1/√(1 + ‖∇h‖²). Sizes: origin [2], spacing [2] of the nodes.
struct Terrain {
  static constexpr bool exact = false, convex = false;

  template <int ORDER, class V> struct Height {
    V D[ORDER + 1][ORDER + 1];
    V slope[2], along[2], above, s, upward[3], easing[2];  // ∇h, ½ ∇‖∇h‖², z − h, s, ∇(z − h), ∇s

    template <class N> Height(const Candidates<N, 3>& c, int solid, const V* p) {
      const N* m = c.measure + 6 * solid;
      const int* grid = c.grid + 4 * solid;
      const Basis<ORDER, V> x(p[0], V(m[0]), V(m[2])), y(p[1], V(m[1]), V(m[3]));
      spline<ORDER>(c.sample + grid[0], grid + 1, x, y, D);
      slope[0] = D[1][0], slope[1] = D[0][1], above = p[2] - D[0][0];
      along[0] = fma(D[2][0], slope[0], D[1][1] * slope[1]), along[1] = fma(D[1][1], slope[0], D[0][2] * slope[1]);
      s = V(1) / sqrt(fma(slope[0], slope[0], fma(slope[1], slope[1], V(1))));
      upward[0] = -slope[0], upward[1] = -slope[1], upward[2] = V(1);
      for (int j = 0; j < 2; j++) easing[j] = -(s * s * s * along[j]);
    }
  };

  template <class V, class N> static V field(const Candidates<N, 3>& c, int solid, const V* p, V* n) {
    const Height<2, V> h(c, solid, p);
    for (int j = 0; j < 3; j++) n[j] = h.s * h.upward[j];
    for (int j = 0; j < 2; j++) n[j] = fma(h.above, h.easing[j], n[j]);
    return h.s * h.above;
  }

  template <class V, class N> static void curvature(const Candidates<N, 3>& c, int solid, const V* p, V* out) {
    const Height<3, V> h(c, solid, p);
    const V bend[4] = {h.D[2][0], h.D[1][1], h.D[1][1], h.D[0][2]}, s3 = h.s * h.s * h.s;
    const V twist[4][2] = {{h.D[3][0], h.D[2][1]}, {h.D[2][1], h.D[1][2]}, {h.D[2][1], h.D[1][2]}, {h.D[1][2], h.D[0][3]}};
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) {
        V& entry = out[3 * j + k];
        entry = V(0);
        if (k < 2) entry = fma(h.upward[j], h.easing[k], entry);
        if (j < 2) entry = fma(h.easing[j], h.upward[k], entry);
        if (j == 2 || k == 2) continue;
        const V* t = twist[2 * j + k];
        const V change = fma(t[0], h.slope[0], t[1] * h.slope[1]) + fma(bend[2 * j], bend[2 * k], bend[2 * j + 1] * bend[2 * k + 1]);
        const V eases = fma(V(3) * s3 * h.s * h.s, h.along[j] * h.along[k], -(s3 * change));  // ∇∇s
        entry = fma(h.above, eases, entry - h.s * bend[2 * j + k]);
      }
  }
};

// Signed distances at nodes; beyond them √(e² + a²) − a is added, e the distance to the grid. Sizes: origin [3], spacing a.
struct Sampled {
  static constexpr bool exact = false, convex = false;

  template <class V, class N> static V beyond(const Candidates<N, 3>& c, int solid, const V* p, V* out) {
    const N* m = c.measure + 6 * solid;
    const V spacing = V(m[3]);
    for (int j = 0; j < 3; j++) {
      const V first = V(m[j]), last = fma(spacing, V(c.grid[4 * solid + 1 + j] - 3), first);
      out[j] = p[j] - clamped(p[j], first, last);
    }
    return sqrt(fma(spacing, spacing, dot(out, out)));
  }
  template <int ORDER, class V, class N>
  static void derivatives(const Candidates<N, 3>& c, int solid, const V* p, V D[][ORDER + 1][ORDER + 1]) {
    const N* m = c.measure + 6 * solid;
    const int* grid = c.grid + 4 * solid;
    const V spacing = V(m[3]);
    const Basis<ORDER, V> x(p[0], V(m[0]), spacing), y(p[1], V(m[1]), spacing), z(p[2], V(m[2]), spacing);
    spline<ORDER>(c.sample + grid[0], grid + 1, x, y, z, D);
  }

  template <class V, class N> static V field(const Candidates<N, 3>& c, int solid, const V* p, V* n) {
    V D[2][2][2], off[3];
    const V far = beyond(c, solid, p, off);
    derivatives<1>(c, solid, p, D);
    n[0] = D[1][0][0] + off[0] / far, n[1] = D[0][1][0] + off[1] / far, n[2] = D[0][0][1] + off[2] / far;
    return D[0][0][0] + (far - V(c.measure[6 * solid + 3]));
  }

  template <class V, class N> static void curvature(const Candidates<N, 3>& c, int solid, const V* p, V* out) {
    V D[3][3][3], off[3];
    const V far = beyond(c, solid, p, off), one(1), zero(0);
    derivatives<2>(c, solid, p, D);
    const V second[9] = {D[2][0][0], D[1][1][0], D[1][0][1], D[1][1][0], D[0][2][0], D[0][1][1], D[1][0][1], D[0][1][1], D[0][0][2]};
    for (int j = 0; j < 3; j++)
      for (int k = 0; k < 3; k++) {
        const V out_of = j == k ? select(abs(off[j]) > zero, one, zero) : zero;
        out[3 * j + k] = second[3 * j + k] + fma(-(off[j] / far), off[k] / far, out_of) / far;
      }
  }
};

}  // namespace pbfd
