// The one translation unit of the core: setup.py compiles it once per kind of processor. Everything else is headers.
#include "interface.h"

#include <algorithm>

#include "inspection.h"
#include "record.h"
#include "starts.h"
#include "target.h"

using namespace pbfd;

int pbfd_interface() { return 6; }

int pbfd_lanes(int bytes) { return register_bytes / bytes; }

const char* pbfd_target() { return target; }

namespace {

Sizes sizes(const pbfd_plan* p) {
  return {{p->candidates, p->anchors, p->planes, p->solids, p->samples, p->forms}, p->nodes, p->nq, p->nv, p->nu, p->halvings, p->pushes};
}

template <class T> Journey<T> journey(const pbfd_steps* s, const void* const* given, void* const* found) {
  return {s->worlds, s->steps, s->held != 0, given, static_cast<const T*>(s->control), found,
          static_cast<T*>(s->residual_norm), s->counted[0], s->counted[1], s->counted[2], s->counted[3], s->fallbacks};
}

Rules rules(const pbfd_plan* p, const pbfd_steps* s) { return {s->dt, s->tolerance, s->surplus, s->share, s->jump, p->halvings, s->evaluations}; }

// Steps of a scheme, and starts.
template <template <class, class, int> class Scheme> struct Going {
  template <class V, class T, int D>
  static void make(const Plan<T, D>& plan, const pbfd_plan* p, const pbfd_steps* s, Arena<V> arena) {
    Machine<V, T, D, Scheme<V, T, D>> machine(plan, arena);
    machine.newton.balance.contacts.own_grip = static_cast<const T*>(s->grip);
    machine.run(journey<T>(s, s->given, s->found), rules(p, s), s->first, s->last);
  }
};

template <template <class, class, int> class Scheme> struct Starting {
  template <class V, class T, int D>
  static void make(const Plan<T, D>& plan, const pbfd_plan* p, const pbfd_steps* s, Arena<V> arena) {
    Starts<V, T, D, Scheme<V, T, D>> starts(plan, arena);
    starts.balance.contacts.own_grip = static_cast<const T*>(s->grip);
    const void* before[] = {s->given[0], s->trial[0], s->trial[1], s->trial[2]};
    Rules trial = rules(p, s);
    trial.share = 1;
    starts.run(journey<T>(s, before, s->trial + 3), trial, s->trial, static_cast<const T*>(s->given[1]), s->found, s->first, s->last);
  }
};

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
template <class What, class T, int D> void make_of(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  using Several = Lanes<T, register_bytes / int(sizeof(T))>;
  const Plan<T, D> plan(sizes(p), p->whole, static_cast<const T*>(p->real));
  if (s->last - s->first == 1)
    What::make(plan, p, s, Arena<T>{static_cast<T*>(room)});
  else
    What::make(plan, p, s, Arena<Several>{static_cast<Several*>(room)});
}

template <class What> void in_space(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  p->bytes == 8 ? make_of<What, double, 3>(p, s, room) : make_of<What, float, 3>(p, s, room);
}

template <class What> void make_by(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  if (p->dimension == 3)
    in_space<What>(p, s, room);
  else
    p->bytes == 8 ? make_of<What, double, 2>(p, s, room) : make_of<What, float, 2>(p, s, room);
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
  using First = EnergyMomentum<V, T, 3>;
  using Second = ImplicitEuler<V, T, 3>;
  using Third = Bdf2<V, T, 3>;
  return std::max({Machine<V, T, 3, First>::room(s), Machine<V, T, 3, Second>::room(s), Machine<V, T, 3, Third>::room(s),
                   Starts<V, T, 3, First>::room(s), Starts<V, T, 3, Second>::room(s), Starts<V, T, 3, Third>::room(s),
                   Recorder<V, T, First>::room(s), Recorder<V, T, Second>::room(s), Recorder<V, T, Third>::room(s)});
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

void pbfd_energy_momentum(const pbfd_plan* p, const pbfd_steps* s, void* room) { make_by<Going<EnergyMomentum>>(p, s, room); }

void pbfd_implicit_euler(const pbfd_plan* p, const pbfd_steps* s, void* room) { make_by<Going<ImplicitEuler>>(p, s, room); }

void pbfd_bdf2(const pbfd_plan* p, const pbfd_steps* s, void* room) { in_space<Going<Bdf2>>(p, s, room); }

void pbfd_start_energy_momentum(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  make_by<Starting<EnergyMomentum>>(p, s, room);
}

void pbfd_start_implicit_euler(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  make_by<Starting<ImplicitEuler>>(p, s, room);
}

void pbfd_start_bdf2(const pbfd_plan* p, const pbfd_steps* s, void* room) { in_space<Starting<Bdf2>>(p, s, room); }

void pbfd_energy_momentum_record(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  record_by<EnergyMomentum>(p, r, a, room);
}

void pbfd_implicit_euler_record(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  record_by<ImplicitEuler>(p, r, a, room);
}

void pbfd_bdf2_record(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) { record_by<Bdf2>(p, r, a, room); }

void pbfd_balance(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  const bool plane = p->dimension == 2;
  if (p->bytes == 8)
    (plane ? balance_of<double, 2> : balance_of<double, 3>)(p, s, q, residual, jacobian, room);
  else
    (plane ? balance_of<float, 2> : balance_of<float, 3>)(p, s, q, residual, jacobian, room);
}
