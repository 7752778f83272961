// Vectors [D] and matrices [D × D], row by row, of one world or of several; in space, D = 3, or in a plane, D = 2.
//
// What turns is a vector [3] in space, and one number in a plane, [turns(D)]: a rotation's speed ω, a torque.
#pragma once
#include "scalar.h"

namespace pbfd {

constexpr int turns(int d) { return d == 3 ? 3 : 1; }

template <int D = 3, class V> inline V dot(const V* a, const V* b) {
  V sum = a[D - 1] * b[D - 1];
  for (int i = D - 2; i >= 0; i--) sum = fma(a[i], b[i], sum);
  return sum;
}

template <class V> inline void cross(const V* a, const V* b, V* out) {
  const V x = fma(a[1], b[2], -(a[2] * b[1])), y = fma(a[2], b[0], -(a[0] * b[2])), z = fma(a[0], b[1], -(a[1] * b[0]));
  out[0] = x;
  out[1] = y;
  out[2] = z;
}

// out += a × b
template <class V> inline void add_cross(const V* a, const V* b, V* out) {
  out[0] += fma(a[1], b[2], -(a[2] * b[1]));
  out[1] += fma(a[2], b[0], -(a[0] * b[2]));
  out[2] += fma(a[0], b[1], -(a[1] * b[0]));
}

// out = ω × x: how fast x moves.
template <int D, class V> inline void swing(const V* w, const V* x, V* out) {
  if constexpr (D == 3) {
    cross(w, x, out);
  } else {
    const V y = w[0] * x[0];
    out[0] = -(w[0] * x[1]);
    out[1] = y;
  }
}

// out += ω × x
template <int D, class V> inline void add_swing(const V* w, const V* x, V* out) {
  V moved[D];
  swing<D>(w, x, moved);
  for (int i = 0; i < D; i++) out[i] += moved[i];
}

// ω × x = [−[x]×] ω, [D × turns(D)].
template <int D, class V> inline void arms(const V* x, V* out) {
  if constexpr (D == 3) {
    out[0] = out[4] = out[8] = V(0);
    out[1] = x[2], out[2] = -x[1], out[3] = -x[2], out[5] = x[0], out[6] = x[1], out[7] = -x[0];
  } else {
    out[0] = -x[1], out[1] = x[0];
  }
}

// out = p × f: the torque of a force.
template <int D, class V> inline void lever(const V* p, const V* f, V* out) {
  if constexpr (D == 3)
    cross(p, f, out);
  else
    out[0] = fma(p[0], f[1], -(p[1] * f[0]));
}

// The torque of forces f at points p, out of Σ f pᵀ.
template <int D, class V> inline void curl(const V* M, V* out) {
  if constexpr (D == 3) {
    out[0] = M[7] - M[5];
    out[1] = M[2] - M[6];
    out[2] = M[3] - M[1];
  } else {
    out[0] = M[2] - M[1];
  }
}

// out = M x; what is x may be a scene's numbers
template <int D = 3, class V, class X> inline void times(const V* M, const X* x, V* out) {
  for (int i = 0; i < D; i++) {
    V sum = M[D * i + D - 1] * V(x[D - 1]);
    for (int j = D - 2; j >= 0; j--) sum = fma(M[D * i + j], V(x[j]), sum);
    out[i] = sum;
  }
}

// out = Mᵀ x
template <int D = 3, class V> inline void transposed_times(const V* M, const V* x, V* out) {
  for (int i = 0; i < D; i++) {
    V sum = M[D * (D - 1) + i] * x[D - 1];
    for (int j = D - 2; j >= 0; j--) sum = fma(M[D * j + i], x[j], sum);
    out[i] = sum;
  }
}

// out = A B
template <int D = 3, class A, class B, class V> inline void product(const A* a, const B* b, V* out) {
  for (int i = 0; i < D; i++)
    for (int j = 0; j < D; j++) {
      V sum = V(a[D * i + D - 1]) * V(b[D * (D - 1) + j]);
      for (int k = D - 2; k >= 0; k--) sum = fma(V(a[D * i + k]), V(b[D * k + j]), sum);
      out[D * i + j] = sum;
    }
}

// out = A Bᵀ
template <int D = 3, class A, class B, class V> inline void product_transposed(const A* a, const B* b, V* out) {
  for (int i = 0; i < D; i++)
    for (int j = 0; j < D; j++) {
      V sum = V(a[D * i + D - 1]) * V(b[D * j + D - 1]);
      for (int k = D - 2; k >= 0; k--) sum = fma(V(a[D * i + k]), V(b[D * j + k]), sum);
      out[D * i + j] = sum;
    }
}

template <int D = 3, class V> inline V trace(const V* M) {
  V sum = M[0];
  for (int i = 1; i < D; i++) sum += M[(D + 1) * i];
  return sum;
}

template <int D, class V> inline V determinant(const V* M) {
  if constexpr (D == 3) {
    V c[3];
    cross(M + 3, M + 6, c);
    return dot(M, c);
  } else {
    return fma(M[0], M[3], -(M[1] * M[2]));
  }
}

// tr(M) 1 − M: how Σ m x xᵀ answers a turning; in a plane a number.
template <int D, class V> inline void resistance(const V* M, V* out) {
  if constexpr (D == 3) {
    out[0] = M[4] + M[8], out[4] = M[0] + M[8], out[8] = M[0] + M[4];
    out[1] = -M[1], out[2] = -M[2], out[3] = -M[3], out[5] = -M[5], out[6] = -M[6], out[7] = -M[7];
  } else {
    out[0] = M[0] + M[3];
  }
}

}  // namespace pbfd
