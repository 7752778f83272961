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

template <class V, int D> void energy_momentum(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  using T = typename Kind<V>::Scalar;
  Arena<V> arena{static_cast<V*>(room)};
  const Plan<T, D> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  Machine<V, T, D> machine(plan, arena);
  auto given = [&](int i) { return static_cast<const T*>(s->given[i]); };
  auto found = [&](int i) { return static_cast<T*>(s->found[i]); };
  const Journey<T> journey{
      s->worlds, s->steps, s->held != 0, s->made,
      given(0), given(1), given(2), given(3), given(4), given(5), given(6), given(7), given(8), static_cast<const T*>(s->control),
      found(0), found(1), found(2), found(3), found(4), found(5), found(6), found(7), found(8), static_cast<T*>(s->residual_norm),
      s->counted[0], s->counted[1], s->counted[2], s->counted[3], s->counted[4]};
  machine.newton.balance.contacts.own_grip = static_cast<const T*>(s->grip);
  machine.scheme.surplus_allowed = V(T(s->surplus));
  machine.run(journey, s->first, s->last, T(s->dt), T(s->tolerance), s->evaluations);
}

template <class T, int D>
void balance_of(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  auto row = [](const void* array, long world, int count) { return static_cast<const T*>(array) + world * count; };
  const Plan<T, D> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  for (int w = s->first; w < s->last; w++)
    inspect(plan, s->grip ? row(s->grip, w, p->candidates) : nullptr, row(s->given[0], w, p->nq), row(s->given[1], w, p->nv), row(s->control, w, p->nu), row(q, w, p->nq),
            T(s->dt), Arena<T>{static_cast<T*>(room)}, static_cast<T*>(residual) + long(w) * p->nv,
            static_cast<T*>(jacobian) + long(w) * p->nv * p->nv);
}

// A single world is spared the work of lanes that nobody needs.
template <class T, int D> void energy_momentum_of(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  if (s->last - s->first == 1)
    energy_momentum<T, D>(p, s, room);
  else
    energy_momentum<Lanes<T, register_bytes / int(sizeof(T))>, D>(p, s, room);
}

}  // namespace

long pbfd_whole_numbers(const pbfd_plan* p) {
  return p->dimension == 3 ? Plan<double>::whole_numbers(sizes(p)) : Plan<double, 2>::whole_numbers(sizes(p));
}

long pbfd_real_numbers(const pbfd_plan* p) {
  return p->dimension == 3 ? Plan<double>::real_numbers(sizes(p)) : Plan<double, 2>::real_numbers(sizes(p));
}

long pbfd_room(const pbfd_plan* p) {
  // lanes of either scalar fill one register, and need the same number of them but for what is counted in bytes
  const int wide = Machine<Lanes<double, register_bytes / 8>, double>::room(sizes(p));
  const int narrow = Machine<Lanes<float, register_bytes / 4>, float>::room(sizes(p));
  return long(register_bytes) * (wide > narrow ? wide : narrow);
}

void pbfd_energy_momentum(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  const bool plane = p->dimension == 2;
  if (p->bytes == 8)
    plane ? energy_momentum_of<double, 2>(p, s, room) : energy_momentum_of<double, 3>(p, s, room);
  else
    plane ? energy_momentum_of<float, 2>(p, s, room) : energy_momentum_of<float, 3>(p, s, room);
}

void pbfd_balance(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  const bool plane = p->dimension == 2;
  if (p->bytes == 8)
    (plane ? balance_of<double, 2> : balance_of<double, 3>)(p, s, q, residual, jacobian, room);
  else
    (plane ? balance_of<float, 2> : balance_of<float, 3>)(p, s, q, residual, jacobian, room);
}
