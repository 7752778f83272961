// Powers and exponentials of one number or of several: each lane by itself, as a single world has them.
#pragma once
#include "scalar.h"

namespace pbfd {

template <class V> inline V exponential(V x) {
  using T = typename Kind<V>::Scalar;
  V out = x;
  for (int i = 0; i < Kind<V>::lanes; i++) put(out, i, T(std::exp(lane(x, i))));
  return out;
}

// x ≥ 0 to an exponent ≥ 0, as `power` in terms/normal_force.py: whole ones up to 4 by products.
template <class V> [[gnu::noinline]] V power(V x, typename Kind<V>::Scalar exponent) {
  using T = typename Kind<V>::Scalar;
  const int whole = exponent <= T(4) ? int(exponent) : 0;
  V out(1);
  if (T(whole) == exponent) {
    for (int i = 0; i < whole; i++) out = i ? out * x : x;
    return out;
  }
  for (int i = 0; i < Kind<V>::lanes; i++) {
    const T base = lane(x, i);
    put(out, i, base > T(0) ? T(std::exp(exponent * std::log(base))) : T(0));
  }
  return out;
}

}  // namespace pbfd
