// Rotations: sine and cosine, quaternions (w, x, y, z), exponential and logarithm, as in tree/rotations.py.
#pragma once
#include "vectors.h"

namespace pbfd {

constexpr double SMALL = 1e-2;  // [rad] below it the series are used

// Cody and Waite's reduction to a quarter turn, and Taylor's series there; right to an ulp or two up to some 1e5 rad.
template <class V> inline void sine_cosine(V angle, V& sine, V& cosine) {
  const V quarters = rounded(angle * V(0.63661977236758134308));
  V x = fma(quarters, V(-1.5707963267948966192), angle);
  x = fma(quarters, V(-6.123233995736766036e-17), x);
  if (sizeof(typename Kind<V>::Scalar) == 4) {  // π/2 in two parts that a float holds
    x = fma(quarters, V(-1.5707963705062866f), angle);
    x = fma(quarters, V(4.3711388286737929e-8f), x);
  }
  const V z = x * x;
  V s = V(-7.6471637318198164759e-13);
  s = fma(s, z, V(1.6059043836821614599e-10));
  s = fma(s, z, V(-2.5052108385441718775e-8));
  s = fma(s, z, V(2.7557319223985890653e-6));
  s = fma(s, z, V(-1.9841269841269841270e-4));
  s = fma(s, z, V(8.3333333333333333333e-3));
  s = fma(s, z, V(-1.6666666666666666667e-1));
  s = fma(s * z, x, x);
  V c = V(4.7794773323873852974e-14);
  c = fma(c, z, V(-1.1470745597729724714e-11));
  c = fma(c, z, V(2.0876756987868098979e-9));
  c = fma(c, z, V(-2.7557319223985890653e-7));
  c = fma(c, z, V(2.4801587301587301587e-5));
  c = fma(c, z, V(-1.3888888888888888889e-3));
  c = fma(c, z, V(4.1666666666666666667e-2));
  c = fma(c, z, V(-0.5));
  c = fma(c, z, V(1));
  const V quadrant = fma(rounded(quarters * V(0.25)), V(-4), quarters);  // −2, −1, 0, 1 or 2
  const auto odd = abs(abs(quadrant) - V(1)) < V(0.5), back = abs(quadrant) > V(1.5);
  const V larger = select(odd, c, s), smaller = select(odd, s, c);
  sine = select(back | (quadrant < V(-0.5)), -larger, larger);
  cosine = select(back | (quadrant > V(0.5)), -smaller, smaller);
}

// atan(√z)/√z for √z below .66 (Cephes' rational approximation).
template <class V> inline V arctangent_ratio(V z) {
  V p = V(-8.750608600031904122785e-1);
  p = fma(p, z, V(-1.615753718733365076637e1));
  p = fma(p, z, V(-7.500855792314704667340e1));
  p = fma(p, z, V(-1.228866684490136173410e2));
  p = fma(p, z, V(-6.485021904942025371773e1));
  V q = z + V(2.485846490142306297962e1);
  q = fma(q, z, V(1.650270098316988542046e2));
  q = fma(q, z, V(4.328810604912902668951e2));
  q = fma(q, z, V(4.853903996359136964868e2));
  q = fma(q, z, V(1.945506571482613964425e2));
  return fma(z, p / q, V(1));
}

// atan x for x ≥ 0, infinite too (Cephes' rational approximation).
template <class V> inline V arctangent(V x) {
  const auto steep = x > V(2.41421356237309504880), middle = x > V(0.66);
  const V y = select(steep, V(1.57079632679489661923), select(middle, V(0.78539816339744830962), V(0)));
  const V t = select(steep, V(-1) / x, select(middle, (x - V(1)) / (x + V(1)), x));
  return fma(t, arctangent_ratio(t * t), y);
}

// A rotation matrix of a unit quaternion.
template <class V> inline void quaternion_matrix(const V* q, V* R) {
  const V w = q[0], x = q[1], y = q[2], z = q[3], two = V(2);
  R[0] = V(1) - two * fma(y, y, z * z);
  R[1] = two * fma(x, y, -(w * z));
  R[2] = two * fma(x, z, w * y);
  R[3] = two * fma(x, y, w * z);
  R[4] = V(1) - two * fma(x, x, z * z);
  R[5] = two * fma(y, z, -(w * x));
  R[6] = two * fma(x, z, -(w * y));
  R[7] = two * fma(y, z, w * x);
  R[8] = V(1) - two * fma(x, x, y * y);
}

template <class V> inline void quaternion_product(const V* a, const V* b, V* out) {
  const V w = fma(a[0], b[0], -fma(a[1], b[1], fma(a[2], b[2], a[3] * b[3])));
  const V x = fma(a[0], b[1], fma(a[1], b[0], fma(a[2], b[3], -(a[3] * b[2]))));
  const V y = fma(a[0], b[2], fma(a[2], b[0], fma(a[3], b[1], -(a[1] * b[3]))));
  const V z = fma(a[0], b[3], fma(a[3], b[0], fma(a[1], b[2], -(a[2] * b[1]))));
  out[0] = w;
  out[1] = x;
  out[2] = y;
  out[3] = z;
}

// exp of a rotation vector [rad].
template <class V> inline void quaternion_exp(const V* v, V* q) {
  const V half[3] = {V(0.5) * v[0], V(0.5) * v[1], V(0.5) * v[2]};
  const V square = dot(half, half);
  const auto small = square < V(SMALL * SMALL);
  const V angle = sqrt(select(small, V(1), square));
  V sine, cosine;
  sine_cosine(angle, sine, cosine);
  const V s = V(1) - square * V(1.0 / 6) * (V(1) - square * V(1.0 / 20) * (V(1) - square * V(1.0 / 42)));
  const V c = V(1) - square * V(0.5) * (V(1) - square * V(1.0 / 12) * (V(1) - square * V(1.0 / 30)));
  const V scale = select(small, s, sine / angle);
  q[0] = select(small, c, cosine);
  for (int i = 0; i < 3; i++) q[1 + i] = scale * half[i];
}

// log of a unit quaternion, angle in [0, π].
template <class V> inline void quaternion_log(const V* q, V* v) {
  const V sign = select(q[0] < V(0), V(-1), V(1)), square = dot(q + 1, q + 1);
  const auto small = square < V(SMALL * SMALL);
  const V sine = sqrt(select(small, V(1), square));
  const V series = V(2) * (V(1) + square * V(1.0 / 6) * (V(1) + square * V(9.0 / 20) * (V(1) + square * V(25.0 / 42))));
  const V scale = sign * select(small, series, V(2) * arctangent(sine / abs(q[0])) / sine);
  for (int i = 0; i < 3; i++) v[i] = scale * q[1 + i];
}

// log of A Bᵀ, both rotation matrices, angle in [0, π); in a plane (−π, π).
template <int D = 3, class V> inline void rotation_between(const V* A, const V* B, V* v) {
  V M[D * D], twice[turns(D)];  // 2 sin(angle) · axis
  product_transposed<D>(A, B, M);
  curl<D>(M, twice);
  const V square = V(0.25) * dot<turns(D)>(twice, twice), cosine = V(0.5) * (trace<D>(M) - V(D - 2));
  // the half angle's tangent is sin/(1 + cos)
  const V per = V(1) / max(V(1) + cosine, V(1e-12)), tangent2 = square * per * per;
  const auto wide = tangent2 > V(0.66 * 0.66);
  V scale = per * arctangent_ratio(min(tangent2, V(0.66 * 0.66)));
  if (any(wide)) {
    const V sine = sqrt(max(square, V(1e-12)));
    scale = select(wide, arctangent(sine * per) / sine, scale);
  }
  for (int i = 0; i < turns(D); i++) v[i] = scale * twice[i];
}

// The coefficient of [φ]² in the inverse Jacobians of the exponential, of ‖φ‖².
template <class V> inline V log_curvature(V square) {
  const auto small = square < V(SMALL * SMALL);
  const V safe = select(small, V(1), square), half = V(0.5) * sqrt(safe);
  V sine, cosine;
  sine_cosine(half, sine, cosine);
  const V series = (V(1) + square * V(1.0 / 60) * (V(1) + square * V(1.0 / 42))) * V(1.0 / 12);
  return select(small, series, (V(1) - half * cosine / sine) / safe);
}

// 1 + a [φ]× + c [φ]², c the coefficient above: a = −½ is the inverse left Jacobian, 0 the symmetric part of both.
template <int D = 3, class V> inline void log_jacobian(const V* phi, V a, V* out) {
  if constexpr (D == 2) {
    out[0] = V(1);
    return;
  }
  const V square = dot(phi, phi), c = log_curvature(square);
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) out[3 * i + j] = c * phi[i] * phi[j];
  for (int i = 0; i < 3; i++) out[4 * i] += V(1) - c * square;
  out[1] -= a * phi[2];
  out[2] += a * phi[1];
  out[3] += a * phi[2];
  out[5] -= a * phi[0];
  out[6] -= a * phi[1];
  out[7] += a * phi[0];
}

}  // namespace pbfd
