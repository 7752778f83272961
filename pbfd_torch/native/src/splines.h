// Uniform cubic B-splines through samples, as contact/splines.py: every lane gathers its own coefficients.
#pragma once
#include "candidates.h"
#include "target.h"

namespace pbfd {

// Σ_j w[j] values[K j + k], k < K. One world's are found side by side in a register, to the bit the same.
template <int K, class V> inline void contract(const V* w, const V* values, V* out) {
  if constexpr (Kind<V>::lanes == 1) {
    constexpr int REGISTER = register_bytes / int(sizeof(V)), W = K < REGISTER ? K : REGISTER;
    using Wide = Lanes<V, W>;
    auto read = [](const V* from) {
      Wide x;
      for (int i = 0; i < W; i++) put(x, i, from[i]);
      return x;
    };
    for (int k = 0; k < K; k += W) {
      const V* first = values + k;
      const Wide last = Wide(w[3]) * read(first + 3 * K);
      const Wide sum = fma(Wide(w[0]), read(first), fma(Wide(w[1]), read(first + K), fma(Wide(w[2]), read(first + 2 * K), last)));
      for (int i = 0; i < W; i++) out[k + i] = lane(sum, i);
    }
  } else {
    for (int k = 0; k < K; k++)
      out[k] = fma(w[0], values[k], fma(w[1], values[K + k], fma(w[2], values[2 * K + k], w[3] * values[3 * K + k])));
  }
}

// A place within the cells along one axis: the cell, and the basis and its derivatives there, [4] each.
template <int ORDER, class V> struct Basis {
  V cell, w[ORDER + 1][4];

  Basis(V x, V origin, V spacing) {
    const V place = (x - origin) / spacing, near = rounded(place), one(1);
    cell = select(near > place, near - one, near);
    const V t = place - cell, s = one - t, sixth(1.0 / 6);
    w[0][0] = s * s * s * sixth, w[0][1] = (V(4) - V(3) * t * t * (V(2) - t)) * sixth;
    w[0][2] = (V(4) - V(3) * s * s * (V(2) - s)) * sixth, w[0][3] = t * t * t * sixth;
    V per = one / spacing;
    w[1][0] = V(-0.5) * s * s * per, w[1][1] = t * fma(V(1.5), t, V(-2)) * per;
    w[1][2] = -(s * fma(V(1.5), s, V(-2))) * per, w[1][3] = V(0.5) * t * t * per;
    if constexpr (ORDER >= 2) {
      per = per / spacing;
      w[2][0] = s * per, w[2][1] = fma(V(3), t, V(-2)) * per, w[2][2] = fma(V(3), s, V(-2)) * per, w[2][3] = t * per;
    }
    if constexpr (ORDER >= 3) {
      per = per / spacing;
      w[3][0] = -per, w[3][1] = V(3) * per, w[3][2] = V(-3) * per, w[3][3] = per;
    }
  }

  // Which of `size` coefficients count in a lane, [4]: beyond the border the outermost ones repeat.
  void nodes(int i, int size, int* out) const {
    const int first = int(lane(clamped(cell, V(-3), V(size)), i));
    for (int j = 0; j < 4; j++) out[j] = first + j < 0 ? 0 : first + j < size ? first + j : size - 1;
  }
  V along(int order, const V* values) const {
    const V* x = w[order];
    return fma(x[0], values[0], fma(x[1], values[1], fma(x[2], values[2], x[3] * values[3])));
  }
};

// Partial derivatives of a spline over the plane, D[a][b] = ∂ᵃ₁ ∂ᵇ₂, a + b ≤ ORDER.
template <int ORDER, class V>
inline void spline(const typename Kind<V>::Scalar* sample, const int* size, const Basis<ORDER, V>& x, const Basis<ORDER, V>& y, V D[][ORDER + 1]) {
  V values[16], columns[4];
  for (int i = 0; i < Kind<V>::lanes; i++) {
    int rows[4], places[4];
    x.nodes(i, size[0], rows), y.nodes(i, size[1], places);
    for (int a = 0; a < 4; a++) {
      const auto* row = sample + rows[a] * size[1];
      for (int b = 0; b < 4; b++) put(values[4 * a + b], i, row[places[b]]);
    }
  }
  for (int a = 0; a <= ORDER; a++) {
    contract<4>(x.w[a], values, columns);
    for (int b = 0; a + b <= ORDER; b++) D[a][b] = y.along(b, columns);
  }
}

// The same over space, D[a][b][c].
template <int ORDER, class V>
inline void spline(
    const typename Kind<V>::Scalar* sample, const int* size, const Basis<ORDER, V>& x, const Basis<ORDER, V>& y, const Basis<ORDER, V>& z,
    V D[][ORDER + 1][ORDER + 1]) {
  V values[64], sheets[16], columns[4];
  for (int i = 0; i < Kind<V>::lanes; i++) {
    int rows[4], lines[4], places[4];
    x.nodes(i, size[0], rows), y.nodes(i, size[1], lines), z.nodes(i, size[2], places);
    for (int a = 0; a < 4; a++)
      for (int b = 0; b < 4; b++) {
        const auto* line = sample + (rows[a] * size[1] + lines[b]) * size[2];
        for (int c = 0; c < 4; c++) put(values[16 * a + 4 * b + c], i, line[places[c]]);
      }
  }
  for (int a = 0; a <= ORDER; a++) {
    contract<16>(x.w[a], values, sheets);
    for (int b = 0; a + b <= ORDER; b++) {
      contract<4>(y.w[b], sheets, columns);
      for (int c = 0; a + b + c <= ORDER; c++) D[a][b][c] = z.along(c, columns);
    }
  }
}

}  // namespace pbfd
