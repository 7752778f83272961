// Vectors [3] and matrices [9], row by row, of one world or of several.
#pragma once
#include "scalar.h"

namespace pbfd {

template <class V> inline V dot(const V* a, const V* b) { return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2])); }

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

// out = M x; what is x may be a scene's numbers
template <class V, class X> inline void times(const V* M, const X* x, V* out) {
  for (int i = 0; i < 3; i++) out[i] = fma(M[3 * i], V(x[0]), fma(M[3 * i + 1], V(x[1]), M[3 * i + 2] * V(x[2])));
}

// out = Mᵀ x
template <class V> inline void transposed_times(const V* M, const V* x, V* out) {
  for (int i = 0; i < 3; i++) out[i] = fma(M[i], x[0], fma(M[3 + i], x[1], M[6 + i] * x[2]));
}

// out = A B
template <class A, class B, class V> inline void product(const A* a, const B* b, V* out) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      out[3 * i + j] = fma(V(a[3 * i]), V(b[j]), fma(V(a[3 * i + 1]), V(b[3 + j]), V(a[3 * i + 2]) * V(b[6 + j])));
}

// out = A Bᵀ
template <class V> inline void product_transposed(const V* a, const V* b, V* out) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      out[3 * i + j] = fma(a[3 * i], b[3 * j], fma(a[3 * i + 1], b[3 * j + 1], a[3 * i + 2] * b[3 * j + 2]));
}

template <class V> inline V trace(const V* M) { return M[0] + M[4] + M[8]; }

}  // namespace pbfd
