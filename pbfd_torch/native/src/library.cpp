// The one translation unit of the core: setup.py compiles it once per kind of processor. Everything else is headers.
#include "interface.h"

#include "inspection.h"
#include "machine.h"
#include "record.h"
#include "target.h"

#include <algorithm>

using namespace pbfd;

int pbfd_interface() { return 6; }

int pbfd_lanes(int bytes) { return register_bytes / bytes; }

const char* pbfd_target() { return target; }

namespace {

Sizes sizes(const pbfd_plan* p) {
  return {{p->candidates, p->anchors, p->planes, p->solids, p->samples, p->forms}, p->nodes, p->nq, p->nv, p->nu, p->halvings, p->pushes};
}

template <template <class, class, int> class Scheme, class V, int D>
void make(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  using T = typename Kind<V>::Scalar;
  Arena<V> arena{static_cast<V*>(room)};
  const Plan<T, D> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  Machine<V, T, D, Scheme<V, T, D>> machine(plan, arena);
  machine.newton.balance.contacts.own_grip = static_cast<const T*>(s->grip);
  const Journey<T> journey{s->worlds, s->steps, s->held != 0, s->given, static_cast<const T*>(s->control), s->found,
                           static_cast<T*>(s->residual_norm), s->counted[0], s->counted[1], s->counted[2], s->counted[3], s->fallbacks};
  machine.run(journey, Rules{s->dt, s->tolerance, s->surplus, s->share, p->halvings, s->evaluations}, s->first, s->last);
}

template <class T, int D>
void balance_of(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  auto row = [](const void* array, long world, int count) { return static_cast<const T*>(array) + world * count; };
  const Plan<T, D> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  for (int w = s->first; w < s->last; w++)
    inspect(plan, s->grip ? row(s->grip, w, p->candidates) : nullptr, p->anchors ? row(s->given[9], w, 3 * p->anchors) : nullptr,
            row(s->given[0], w, p->nq), row(s->given[1], w, p->nv), row(s->control, w, p->nu), row(q, w, p->nq), T(s->dt), Arena<T>{static_cast<T*>(room)}, static_cast<T*>(residual) + long(w) * p->nv,
            static_cast<T*>(jacobian) + long(w) * p->nv * p->nv);
}

// A single world is spared the work of lanes that nobody needs.
template <template <class, class, int> class Scheme, class T, int D> void make_of(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  if (s->last - s->first == 1)
    make<Scheme, T, D>(p, s, room);
  else
    make<Scheme, Lanes<T, register_bytes / int(sizeof(T))>, D>(p, s, room);
}

template <template <class, class, int> class Scheme> void make_by(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  const bool plane = p->dimension == 2;
  if (p->bytes == 8)
    plane ? make_of<Scheme, double, 2>(p, s, room) : make_of<Scheme, double, 3>(p, s, room);
  else
    plane ? make_of<Scheme, float, 2>(p, s, room) : make_of<Scheme, float, 3>(p, s, room);
}

template <template <class, class, int> class Scheme, class T>
void record_of(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  using V = Lanes<T, register_bytes / int(sizeof(T))>;
  auto real = [](const void* array) { return static_cast<const T*>(array); };
  auto out = [](void* array) { return static_cast<T*>(array); };
  Arena<V> arena{static_cast<V*>(room)};
  const Plan<T, 3> plan(sizes(p), p->whole, real(p->real));
  const Roster<T> roster{r->links, r->slots, r->first_limit, r->still_suspect, r->carrier, r->slot, r->danger, real(r->frame),
                         real(r->mass), real(r->still_moment), real(r->still_energy), real(r->still_strain)};
  const Record<T> record{T(a->dt), a->worlds, a->given, a->found, a->hazards, out(a->q), out(a->v), out(a->link_poses),
                         out(a->center_of_mass), out(a->kinetic_energy), out(a->potential_energy), out(a->linear_momentum),
                         out(a->angular_momentum), out(a->contact_depth), out(a->contact_point), out(a->contact_normal),
                         out(a->contact_force), out(a->contact_slip), a->suspect};
  Recorder<V, T, Scheme<V, T, 3>> recorder(plan, roster, arena);
  recorder.balance.contacts.own_grip = real(a->grip);
  recorder.write(record, a->first, a->last);
}

template <template <class, class, int> class Scheme>
void record_by(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  (p->bytes == 8 ? record_of<Scheme, double> : record_of<Scheme, float>)(p, r, a, room);
}

// Room for lanes V, in V; a plane needs less.
template <class V> int room_of(Sizes s) {
  using T = typename Kind<V>::Scalar;
  using One = EnergyMomentum<V, T, 3>;
  using Other = ImplicitEuler<V, T, 3>;
  return std::max({Machine<V, T, 3, One>::room(s), Machine<V, T, 3, Other>::room(s), Recorder<V, T, One>::room(s),
                   Recorder<V, T, Other>::room(s)});
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
  using Wide = Lanes<double, register_bytes / 8>;
  using Narrow = Lanes<float, register_bytes / 4>;
  const int wide = room_of<Wide>(sizes(p)), narrow = room_of<Narrow>(sizes(p));
  return long(register_bytes) * (wide > narrow ? wide : narrow);
}

void pbfd_energy_momentum(const pbfd_plan* p, const pbfd_steps* s, void* room) { make_by<EnergyMomentum>(p, s, room); }

void pbfd_implicit_euler(const pbfd_plan* p, const pbfd_steps* s, void* room) { make_by<ImplicitEuler>(p, s, room); }

void pbfd_energy_momentum_record(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  record_by<EnergyMomentum>(p, r, a, room);
}

void pbfd_implicit_euler_record(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  record_by<ImplicitEuler>(p, r, a, room);
}

void pbfd_balance(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  const bool plane = p->dimension == 2;
  if (p->bytes == 8)
    (plane ? balance_of<double, 2> : balance_of<double, 3>)(p, s, q, residual, jacobian, room);
  else
    (plane ? balance_of<float, 2> : balance_of<float, 3>)(p, s, q, residual, jacobian, room);
}
