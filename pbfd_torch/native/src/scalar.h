// Numbers of one world (float, double), or of W worlds side by side in one register (Lanes).
//
// The same operations in the same order for every lane: what a world gets does not depend on who sits beside it. Products are
// fused with sums only where the source says so (`fma`), and always there, so that one lane rounds as eight do.
#pragma once
#include <cmath>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace pbfd {

// One world ---------------------------------------------------------------------------------------------------------------
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
inline double fma(double a, double b, double c) { return std::fma(a, b, c); }
inline float fma(float a, float b, float c) { return std::fma(a, b, c); }
#else  // in software it would be a hundred times slower
inline double fma(double a, double b, double c) { return a * b + c; }
inline float fma(float a, float b, float c) { return a * b + c; }
#endif
inline double sqrt(double a) { return std::sqrt(a); }
inline float sqrt(float a) { return std::sqrt(a); }
inline double select(bool which, double a, double b) { return which ? a : b; }
inline float select(bool which, float a, float b) { return which ? a : b; }
inline bool any(bool mask) { return mask; }

template <class V> struct Kind {
  using Scalar = V;
  using Mask = bool;
  static constexpr int lanes = 1;
};
// Whether it is a number that derivatives are followed back from (traced.h), so that nobody asks for slopes beside it.
template <class V> constexpr bool derived = false;
// What one lane holds, and putting something there.
inline double lane(double value, int) { return value; }
inline float lane(float value, int) { return value; }
inline bool lane(bool mask, int) { return mask; }
inline void put(double& all, int, double value) { all = value; }
inline void put(float& all, int, float value) { all = value; }
inline void put(bool& mask, int, bool value) { mask = value; }

// Several worlds ----------------------------------------------------------------------------------------------------------
template <class T, int W> struct Mask {
  typedef T Register __attribute__((vector_size(W * sizeof(T))));
  typedef decltype(Register{} < Register{}) Bits;
  Bits bits;
  Mask() = default;
  explicit Mask(Bits b) : bits(b) {}
  Mask(bool all) : bits(all ? ~Bits{} : Bits{}) {}
  friend Mask operator&(Mask a, Mask b) { return Mask(a.bits & b.bits); }
  friend Mask operator|(Mask a, Mask b) { return Mask(a.bits | b.bits); }
  friend Mask operator!(Mask a) { return Mask(~a.bits); }
};

template <class T, int W> struct Lanes {
  using Register = typename Mask<T, W>::Register;
  Register v;
  Lanes() = default;
  Lanes(T x) : v(x - Register{}) {}  // minus: 0 - (-0) would be +0
  explicit Lanes(Register r) : v(r) {}
  friend Lanes operator+(Lanes a, Lanes b) { return Lanes(a.v + b.v); }
  friend Lanes operator-(Lanes a, Lanes b) { return Lanes(a.v - b.v); }
  friend Lanes operator*(Lanes a, Lanes b) { return Lanes(a.v * b.v); }
  friend Lanes operator/(Lanes a, Lanes b) { return Lanes(a.v / b.v); }
  friend Lanes operator-(Lanes a) { return Lanes(-a.v); }
  Lanes& operator+=(Lanes b) { v += b.v; return *this; }
  Lanes& operator-=(Lanes b) { v -= b.v; return *this; }
  Lanes& operator*=(Lanes b) { v *= b.v; return *this; }
  friend Mask<T, W> operator<(Lanes a, Lanes b) { return Mask<T, W>(a.v < b.v); }
  friend Mask<T, W> operator<=(Lanes a, Lanes b) { return Mask<T, W>(a.v <= b.v); }
  friend Mask<T, W> operator>(Lanes a, Lanes b) { return Mask<T, W>(a.v > b.v); }
  friend Mask<T, W> operator>=(Lanes a, Lanes b) { return Mask<T, W>(a.v >= b.v); }
  friend Mask<T, W> operator!=(Lanes a, Lanes b) { return Mask<T, W>(a.v != b.v); }
};

template <class T, int W> struct Kind<Lanes<T, W>> {
  using Scalar = T;
  using Mask = pbfd::Mask<T, W>;
  static constexpr int lanes = W;
};

template <class T, int W> inline T lane(const Lanes<T, W>& value, int i) { return value.v[i]; }
template <class T, int W> inline void put(Lanes<T, W>& all, int i, T value) { all.v[i] = value; }
template <class T, int W> inline bool lane(const Mask<T, W>& mask, int i) { return mask.bits[i] != 0; }
template <class T, int W> inline void put(Mask<T, W>& mask, int i, bool value) { mask.bits[i] = value ? -1 : 0; }

template <class T, int W> inline Lanes<T, W> select(Mask<T, W> which, Lanes<T, W> a, Lanes<T, W> b) {
  return Lanes<T, W>(which.bits ? a.v : b.v);
}

// Where `all` is −1 the numbers, where it is 0 zeros.
template <class T, int W> inline Lanes<T, W> kept(Lanes<T, W> x, int all) {
  using Bits = typename Mask<T, W>::Bits;
  return Lanes<T, W>((decltype(x.v))((Bits)x.v & (all - Bits{})));
}

template <class T, int W> inline bool any(Mask<T, W> mask) {
#if defined(__AVX512F__)
  if constexpr (sizeof(mask.bits) == 64) return _mm512_test_epi64_mask((__m512i)mask.bits, (__m512i)mask.bits) != 0;
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(mask.bits) == 32) return !_mm256_testz_si256((__m256i)mask.bits, (__m256i)mask.bits);
#endif
  bool found = false;
  for (int i = 0; i < W; i++) found |= mask.bits[i] != 0;
  return found;
}

// Registers that the machine has an instruction for; GCC takes others apart. (The masked forms of AVX-512: its headers make the
// others of a register that is not initialised, and GCC 12 warns of it.)
template <class T, int W> inline Lanes<T, W> sqrt(Lanes<T, W> a) {
#if defined(__AVX512F__)
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 8) return Lanes<T, W>((decltype(a.v))_mm512_maskz_sqrt_pd(0xff, (__m512d)a.v));
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 4) return Lanes<T, W>((decltype(a.v))_mm512_maskz_sqrt_ps(0xffff, (__m512)a.v));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 8) return Lanes<T, W>((decltype(a.v))_mm256_sqrt_pd((__m256d)a.v));
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 4) return Lanes<T, W>((decltype(a.v))_mm256_sqrt_ps((__m256)a.v));
#endif
  Lanes<T, W> root;
  for (int i = 0; i < W; i++) root.v[i] = std::sqrt(a.v[i]);
  return root;
}

template <class T, int W> inline Lanes<T, W> fma(Lanes<T, W> a, Lanes<T, W> b, Lanes<T, W> c) {
#if defined(__AVX512F__)
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 8)
    return Lanes<T, W>((decltype(a.v))_mm512_fmadd_pd((__m512d)a.v, (__m512d)b.v, (__m512d)c.v));
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 4)
    return Lanes<T, W>((decltype(a.v))_mm512_fmadd_ps((__m512)a.v, (__m512)b.v, (__m512)c.v));
#endif
#if defined(__FMA__)
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 8)
    return Lanes<T, W>((decltype(a.v))_mm256_fmadd_pd((__m256d)a.v, (__m256d)b.v, (__m256d)c.v));
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 4)
    return Lanes<T, W>((decltype(a.v))_mm256_fmadd_ps((__m256)a.v, (__m256)b.v, (__m256)c.v));
#endif
  Lanes<T, W> sum;
  for (int i = 0; i < W; i++) sum.v[i] = fma(a.v[i], b.v[i], c.v[i]);
  return sum;
}

// a < b ? a : b and a > b ? a : b, as the machine's own instructions have it.
inline double min(double a, double b) { return a < b ? a : b; }
inline double max(double a, double b) { return a > b ? a : b; }
inline double abs(double a) { return std::fabs(a); }
inline float min(float a, float b) { return a < b ? a : b; }
inline float max(float a, float b) { return a > b ? a : b; }
inline float abs(float a) { return std::fabs(a); }

template <class T, int W> inline Lanes<T, W> min(Lanes<T, W> a, Lanes<T, W> b) {
#if defined(__AVX512F__)
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 8)
    return Lanes<T, W>((decltype(a.v))_mm512_maskz_min_pd(0xff, (__m512d)a.v, (__m512d)b.v));
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 4)
    return Lanes<T, W>((decltype(a.v))_mm512_maskz_min_ps(0xffff, (__m512)a.v, (__m512)b.v));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 8) return Lanes<T, W>((decltype(a.v))_mm256_min_pd((__m256d)a.v, (__m256d)b.v));
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 4) return Lanes<T, W>((decltype(a.v))_mm256_min_ps((__m256)a.v, (__m256)b.v));
#endif
  return select(a < b, a, b);
}

template <class T, int W> inline Lanes<T, W> max(Lanes<T, W> a, Lanes<T, W> b) {
#if defined(__AVX512F__)
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 8)
    return Lanes<T, W>((decltype(a.v))_mm512_maskz_max_pd(0xff, (__m512d)a.v, (__m512d)b.v));
  if constexpr (sizeof(a.v) == 64 && sizeof(T) == 4)
    return Lanes<T, W>((decltype(a.v))_mm512_maskz_max_ps(0xffff, (__m512)a.v, (__m512)b.v));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 8) return Lanes<T, W>((decltype(a.v))_mm256_max_pd((__m256d)a.v, (__m256d)b.v));
  if constexpr (sizeof(a.v) == 32 && sizeof(T) == 4) return Lanes<T, W>((decltype(a.v))_mm256_max_ps((__m256)a.v, (__m256)b.v));
#endif
  return select(a > b, a, b);
}

template <class T, int W> inline Lanes<T, W> abs(Lanes<T, W> a) {
  using Bits = typename Mask<T, W>::Bits;
  const Bits sign = (Bits)Lanes<T, W>(T(-0.0)).v;
  return Lanes<T, W>((decltype(a.v))((Bits)a.v & ~sign));
}

// Both ---------------------------------------------------------------------------------------------------------------------
template <class V> inline V clamped(V a, V low, V high) { return min(max(a, low), high); }

template <class V> inline V infinite() { return V(typename Kind<V>::Scalar(HUGE_VAL)); }

// The nearest whole number: what is added pushes all other bits out.
template <class V> inline V rounded(V a) {
  const V shift = sizeof(typename Kind<V>::Scalar) == 8 ? V(6755399441055744.0) : V(12582912.0);
  return (a + shift) - shift;
}

}  // namespace pbfd
