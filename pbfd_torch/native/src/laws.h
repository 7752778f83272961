// Laws of contact other than the usual one, which is C d² with Coulomb's friction or with anchors (release.h, friction.h): of what a
// contact is made of, by kinds that are the same in all worlds.
#pragma once
#include "friction.h"
#include "powers.h"
#include "relaxed.h"
#include "release.h"
#include "tree.h"

namespace pbfd {

// Friction: Coulomb's; stronger at rest (terms/static_friction.py); the paper's, which goes by the depth (terms/pbfd_friction.py);
// and the whole gradient of the paper's energy (terms/pbd_friction.py).
enum Manner { COULOMB, STATIC, PAPER, GRADIENT };

// What holds a contact that slips by y: the drag G, ∂G/∂d and (∂G/∂y)/y; and what it adds to the normal force, likewise.
template <class V> struct Grasp {
  V drag, by_depth, by_size, lift, lift_by_depth, lift_by_size;
};

constexpr double HARDER = 300;  // times less deep a contact gets that throws back

// One of them as a step has it.
template <class V> struct Law {
  using T = typename Kind<V>::Scalar;
  int manner;
  T exponent, slip, sunk;  // α; e and γ of G = μ yᵉ d^(γ+1)
  V excess, per_fall;      // μ_s − μ_k, and 1 / (v_s Δt)
  T restitution, threshold;
  V patch, per_turn;  // ℓμ, and 1 / (ε_ω Δt)

  bool torsional() const { return any(patch > V(0)); }
  bool throws() const { return restitution > T(0); }
  // How far the solid is moved out for a step Δt, by the gaps at its start and at the ends of its free motion and of that without
  // gravity; 0 where nothing bounces (terms/restitution.py).
  [[gnu::noinline]] V bounce(V gap, V free, V coasting, V dt) const {
    const V zero(0), square(restitution * restitution), closing = gap - coasting, pull = max(coasting - free, zero);
    const V left = square * closing * (closing + pull) - V(2) * (V(1) - square) * pull * gap;
    const auto bounces = (gap >= zero) & (free < zero) & (closing > V(threshold) * dt) & (left > zero);
    const V root = sqrt(pull * pull + V(4) * select(bounces, left, V(1)));
    return select(bounces, gap + V(0.5) * (root - pull), zero);
  }
  // What gives way is lost to the rebound.
  [[gnu::noinline]] V harder(V stiffness, V bounce) const {
    return stiffness * select(bounce > V(0), V(power(T(HARDER), exponent)), V(1));
  }

  // N and dN/dd, as `release_law` with α for 2.
  [[gnu::noinline]] void press(V stiffness, V depth, V start, V per_range, V& push, V& slope) const {
    const V d = max(depth, V(0)), whole = stiffness * power(d, exponent);
    V share, falls;
    released(depth, start, per_range, share, falls);
    push = share * whole;
    slope = fma(share, V(exponent) * stiffness * power(d, exponent - T(1)), falls * whole);
  }

  // Of other friction than Coulomb's; `holding`: see `feels`.
  [[gnu::noinline]] Grasp<V> hold(const Relaxed<V>& relaxed, V mu, V per_width, V holding, V push, V rises, V depth, V size) const {
    Grasp<V> out;
    const V zero(0), per_size = select(size > zero, V(1) / select(size > zero, size, V(1)), zero);
    out.lift = out.lift_by_depth = out.lift_by_size = zero;
    if (manner == STATIC) {
      V factor, falls;
      slip_law(size, per_width, factor, falls);
      relaxed.felt(holding, push, rises);
      const V x = max(size - V(1) / per_width, zero) * per_fall, more = excess * exponential(-(x * x));
      const V all = mu + more, slope = fma(falls, all, -(factor * V(2) * x * more * per_fall * per_size));
      out.drag = push * factor * all, out.by_depth = rises * factor * all, out.by_size = push * slope;
      return out;
    }
    V deepens(1), deep = depth;
    if (manner == PAPER) relaxed.felt(holding, deep, deepens);
    const V d = max(deep, zero), slips = power(size, slip);
    out.drag = mu * power(d, sunk + T(1)) * slips;
    out.by_depth = deepens * (V(sunk + T(1)) * mu * power(d, sunk) * slips);
    out.by_size = V(slip) * out.drag * per_size * per_size;
    if (manner != GRADIENT) return out;
    const V stiffness = V((sunk + T(1)) / (slip + T(2))) * mu, further = slips * size * size;  // y^(β+1)
    out.lift = stiffness * power(d, sunk) * further, out.lift_by_size = out.by_depth;
    out.lift_by_depth = select(deep > zero, V(sunk) * stiffness * power(d, sunk - T(1)) * further, zero);
    return out;
  }

  // What friction feels where it is lagged: the normal force or the depth, or nothing, as it follows the slip alone.
  V feels(V push, V depth) const { return manner == PAPER ? depth : manner == GRADIENT ? V(0) : push; }
};

template <class V> inline bool squared(const Law<V>* law) { return !law || law->exponent == typename Law<V>::T(2); }

template <class V>
inline void normal_force(const Law<V>* law, V stiffness, V depth, V start, V per_range, V& push, V& slope) {
  if (squared(law)) return release_law(stiffness, depth, start, per_range, push, slope);
  V found, rises;  // of their own, so that no register has to be in memory for them
  law->press(stiffness, depth, start, per_range, found, rises);
  push = found, slope = rises;
}

template <class V>
inline void friction(const Law<V>* law, const Relaxed<V>& relaxed, V mu, V per_width, V holding, V push, V rises, V depth, V size,
                     Grasp<V>& out) {
  if (law && law->manner != COULOMB) {
    const Grasp<V> other = law->hold(relaxed, mu, per_width, holding, push, rises, depth, size);
    out.drag = other.drag, out.by_depth = other.by_depth, out.by_size = other.by_size;
    out.lift = other.lift, out.lift_by_depth = other.lift_by_depth, out.lift_by_size = other.lift_by_size;
    return;
  }
  V factor, falls;
  slip_law(size, per_width, factor, falls);
  relaxed.felt(holding, push, rises);
  out.drag = mu * push * factor, out.by_depth = mu * rises * factor, out.by_size = mu * push * falls;
  out.lift = out.lift_by_depth = out.lift_by_size = V(0);
}

// Those of a scene, as a plan lists them.
template <class V, class N, int D> struct Laws {
  const Plan<N, D>& plan;
  const Relaxed<V>& relaxed;
  Law<V>* law;  // [uncommon]
  bool throwing = false, torsional = false;  // some of them
  Poses<V> coasting;      // where the nodes would end the step without gravity

  static int listed(Sizes s) { return int((s.uncommon * sizeof(Law<V>) + sizeof(V) - 1) / sizeof(V)); }
  static int room(Sizes s) { return s.uncommon > 0 ? listed(s) + D * s.nodes : 0; }
  Laws(const Plan<N, D>& scene, const Relaxed<V>& easier, Arena<V>& arena) : plan(scene), relaxed(easier) {
    law = reinterpret_cast<Law<V>*>(arena.take(listed(plan)));
    if (plan.uncommon > 0) coasting.position = arena.take(D * plan.nodes);
  }

  // A step begins.
  void begin(V dt) {
    throwing = torsional = false;
    const N* x = plan.particulars;
    for (int j = 0; j < plan.uncommon; j++, x += PARTICULARS) {
      Law<V>& l = law[j];
      l.manner = plan.manner[j], l.exponent = lane(x[0], 0), l.slip = lane(x[1], 0), l.sunk = lane(x[2], 0);
      l.excess = V(x[3]), l.per_fall = V(x[4]) / (dt * relaxed.width);
      l.restitution = lane(x[5], 0), l.threshold = lane(x[6], 0), throwing = throwing || l.throws();
      l.patch = V(x[7]), l.per_turn = V(x[8]) / (dt * relaxed.width), torsional = torsional || l.torsional();
    }
  }
  // It would lead to `free` without contacts.
  void coast(Poses<V> free, V dt) {
    if (!throwing) return;
    coasting.rotation = free.rotation, coasting.carriers = free.carriers;
    for (int i = 0; i < D * plan.nodes; i++) coasting.position[i] = fma(-(dt * dt), V(plan.gravity[i % D]), free.position[i]);
  }

  // That of a number, if it has one.
  const Law<V>* at(int number) const { return number < 0 ? nullptr : law + number; }
};

}  // namespace pbfd
