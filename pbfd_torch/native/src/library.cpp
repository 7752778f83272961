// The one translation unit of the core: setup.py compiles it once per kind of processor. Everything else is headers.
#include "interface.h"

#include "machine.h"
#include "target.h"

using namespace pbfd;

int pbfd_interface() { return 4; }

int pbfd_lanes(int bytes) { return register_bytes / bytes; }

const char* pbfd_target() { return target; }

namespace {

Sizes sizes(const pbfd_plan* p) { return {p->nodes, p->nq, p->nv, p->nu, p->candidates, p->halvings}; }

template <template <class, class> class Scheme, class V> void make(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  using T = typename Kind<V>::Scalar;
  const Plan<T> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  Arena<V> arena{static_cast<V*>(room)};
  Machine<V, T, Scheme<V, T>> machine(plan, arena);
  const Journey<T> journey{
      s->worlds,  s->steps, s->held != 0, s->given, static_cast<const T*>(s->control), s->found, static_cast<T*>(s->residual_norm),
      s->counted[0], s->counted[1], s->counted[2], s->counted[3], s->fallbacks};
  machine.run(journey, Rules{s->dt, s->tolerance, s->surplus, p->halvings, s->evaluations}, s->first, s->last);
}

// A single world is spared the work of lanes that nobody needs.
template <template <class, class> class Scheme, class T> void make_of(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  if (s->last - s->first == 1)
    make<Scheme, T>(p, s, room);
  else
    make<Scheme, Lanes<T, register_bytes / int(sizeof(T))>>(p, s, room);
}

// Room for lanes of V, in bytes.
template <class V, class T> long room_of(Sizes s) {
  const int one = Machine<V, T, EnergyMomentum<V, T>>::room(s), other = Machine<V, T, ImplicitEuler<V, T>>::room(s);
  return long(sizeof(V)) * (one > other ? one : other);
}

}  // namespace

long pbfd_whole_numbers(const pbfd_plan* p) { return Plan<double>::whole_numbers(sizes(p)); }

long pbfd_real_numbers(const pbfd_plan* p) { return Plan<double>::real_numbers(sizes(p)); }

long pbfd_room(const pbfd_plan* p) {
  // lanes of either scalar fill one register, and need the same number of them but for what is counted in bytes
  const long wide = room_of<Lanes<double, register_bytes / 8>, double>(sizes(p));
  const long narrow = room_of<Lanes<float, register_bytes / 4>, float>(sizes(p));
  return wide > narrow ? wide : narrow;
}

void pbfd_energy_momentum(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  p->bytes == 8 ? make_of<EnergyMomentum, double>(p, s, room) : make_of<EnergyMomentum, float>(p, s, room);
}

void pbfd_implicit_euler(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  p->bytes == 8 ? make_of<ImplicitEuler, double>(p, s, room) : make_of<ImplicitEuler, float>(p, s, room);
}
