// The one translation unit of the core: setup.py compiles it once per kind of processor. Everything else is headers.
#include "interface.h"

#include "inspection.h"
#include "machine.h"
#include "target.h"

using namespace pbfd;

int pbfd_interface() { return 3; }

int pbfd_lanes(int bytes) { return register_bytes / bytes; }

const char* pbfd_target() { return target; }

namespace {

Sizes sizes(const pbfd_plan* p) {
  return {{p->candidates, p->planes, p->solids, p->samples, p->forms}, p->nodes, p->nq, p->nv, p->nu, p->pushes};
}

template <class V> void energy_momentum(const pbfd_plan* p, const pbfd_step* s, void* room) {
  using T = typename Kind<V>::Scalar;
  const Plan<T> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  Arena<V> arena{static_cast<V*>(room)};
  Machine<V, T> machine(plan, arena);
  auto given = [&](int i) { return static_cast<const T*>(s->given[i]); };
  auto found = [&](int i) { return static_cast<T*>(s->found[i]); };
  const StepArrays<T> arrays{
      given(0), given(1), given(2), given(3), given(4), given(5), given(6), given(7), given(8), given(9),
      found(0), found(1), found(2), found(3), found(4), found(5), found(6), found(7), found(8), found(9),
      s->counted[0], s->counted[1], s->counted[2], s->counted[3], s->counted[4]};
  machine.newton.balance.contacts.own_grip = static_cast<const T*>(s->grip);
  machine.scheme.surplus_allowed = V(T(s->surplus));
  machine.run(arrays, s->worlds, s->first, s->last, T(s->dt), T(s->tolerance), s->evaluations);
}

template <class T>
void balance_of(const pbfd_plan* p, const pbfd_step* s, const void* q, void* residual, void* jacobian, void* room) {
  using V = Lanes<T, register_bytes / int(sizeof(T))>;
  const Plan<T> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  Arena<V> arena{static_cast<V*>(room)};
  auto given = [&](int i) { return static_cast<const T*>(s->given[i]); };
  const BalanceArrays<T> arrays{
      given(0), given(1), given(9), static_cast<const T*>(s->grip),
      static_cast<const T*>(q), static_cast<T*>(residual), static_cast<T*>(jacobian)};
  inspect(plan, arrays, s->worlds, s->first, s->last, V(T(s->dt)), arena);
}

// A single world is spared the work of lanes that nobody needs.
template <class T> void energy_momentum_of(const pbfd_plan* p, const pbfd_step* s, void* room) {
  if (s->last - s->first == 1)
    energy_momentum<T>(p, s, room);
  else
    energy_momentum<Lanes<T, register_bytes / int(sizeof(T))>>(p, s, room);
}

}  // namespace

long pbfd_whole_numbers(const pbfd_plan* p) { return Plan<double>::whole_numbers(sizes(p)); }

long pbfd_real_numbers(const pbfd_plan* p) { return Plan<double>::real_numbers(sizes(p)); }

long pbfd_room(const pbfd_plan* p) {
  // lanes of either scalar fill one register, and need the same number of them but for what is counted in bytes
  const int wide = Machine<Lanes<double, register_bytes / 8>, double>::room(sizes(p));
  const int narrow = Machine<Lanes<float, register_bytes / 4>, float>::room(sizes(p));
  return long(register_bytes) * (wide > narrow ? wide : narrow);
}

void pbfd_energy_momentum(const pbfd_plan* p, const pbfd_step* s, void* room) {
  p->bytes == 8 ? energy_momentum_of<double>(p, s, room) : energy_momentum_of<float>(p, s, room);
}

void pbfd_balance(const pbfd_plan* p, const pbfd_step* s, const void* q, void* residual, void* jacobian, void* room) {
  (p->bytes == 8 ? balance_of<double> : balance_of<float>)(p, s, q, residual, jacobian, room);
}
