// The core's functions but those that follow steps back (descent.cpp). Everything else is headers.
#include <algorithm>

#include "finding.h"
#include "given.h"
#include "inspection.h"
#include "record.h"
#include "starts.h"
#include "target.h"

using namespace pbfd;

int pbfd_interface() { return 15; }

int pbfd_lanes(int bytes) { return register_bytes / bytes; }

const char* pbfd_target() { return target; }

namespace {

template <class T> Journey<T> journey(const pbfd_plan* p, const pbfd_steps* s, const void* const* given, void* const* found) {
  auto real = [](void* array) { return static_cast<T*>(array); };
  return {s->worlds, s->steps, s->held != 0, s->alike != 0, static_cast<const T*>(s->dt), given,
          static_cast<const T*>(s->control), found, real(s->residual_norm), s->counted[0], s->counted[1], s->counted[2],
          s->counted[3], s->fallbacks, timetable<T>(p, s), {s->halved, s->eased, real(s->ends)},
          {static_cast<const T*>(s->wish), real(s->pace), real(s->spacing), s->made, s->before_last}, {real(s->estimate), real(s->strike)}};
}

Rules rules(const pbfd_steps* s) {
  return {s->tolerance, s->surplus, s->share, s->jump, s->halvings, s->evaluations, s->accuracy, s->shortest, s->trust};
}

// The same; worlds that differ by their μ, if at all, share a plan: there is less to be read. Others are seen in space.
template <class V, int D, class F> void with_several(const pbfd_plan* p, const void* rows, Arena<V> arena, F&& make) {
  using T = typename Kind<V>::Scalar;
  const T* real = static_cast<const T*>(p->real);
  const Plan<T, D> plan = plan_of<T, D>(p, real);
  [[maybe_unused]] const int first = int(plan.contact.grip - real), end = first + p->candidates;
  if constexpr (D == 3)
    if (p->varied && (p->which[0] < first || p->which[p->varied - 1] >= end)) return with_each<V, D>(p, rows, arena, make);
  Numbers<V> own = numbers_of(p, rows, first, p->candidates, arena);
  make(plan, own, static_cast<const V*>(own.lanes), arena);
}

// Steps of a scheme, and starts.
template <template <class, class, int> class Scheme> struct Going {
  template <class V, class N, int D>
  static void make(const pbfd_plan* p, const pbfd_steps* s, const Plan<N, D>& plan, Numbers<V>& own, const V* grip,
                   Arena<V>& arena) {
    Machine<V, N, D, Scheme<V, N, D>> machine(plan, own, arena);
    machine.newton.balance.contacts.grip = grip;
    machine.run(journey<typename Kind<V>::Scalar>(p, s, s->given, s->found), rules(s), s->first, s->last);
  }
};

template <template <class, class, int> class Scheme> struct Starting {
  template <class V, class N, int D>
  static void make(const pbfd_plan* p, const pbfd_steps* s, const Plan<N, D>& plan, Numbers<V>& own, const V* grip,
                   Arena<V>& arena) {
    using T = typename Kind<V>::Scalar;
    Starts<V, N, D, Scheme<V, N, D>> starts(plan, own, arena);
    starts.balance.contacts.grip = grip;
    const void* before[] = {s->given[0], s->trial[0], s->trial[1], s->trial[2]};
    Rules trial = rules(s);
    trial.share = 1;
    const T* speeds = static_cast<const T*>(s->given[1]);
    starts.run(journey<T>(p, s, before, s->trial + 3), trial, s->trial, speeds, s->found, s->first, s->last);
  }
};

template <class T, int D>
void balance_of(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  auto row = [](const void* array, long world, int count) { return static_cast<const T*>(array) + world * count; };
  with_each<T, D>(p, s->own, {static_cast<T*>(room)}, [&](const Plan<T, D>& plan, Numbers<T>& own, const T*, Arena<T>& arena) {
    for (int w = s->first; w < s->last; w++) {
      own.load(0, w);
      inspect(plan, plan.remembered() ? row(s->given[9], w, plan.remembered()) : nullptr, row(s->given[0], w, p->nq),
              row(s->given[1], w, p->nv), row(s->control, w, p->nu), row(q, w, p->nq), *row(s->dt, s->alike ? 0 : w, 1),
              timetable<T>(p, s).at(0, w), timetable<T>(p, s).at(1 << s->halvings, w), arena,
              static_cast<T*>(residual) + long(w) * p->nv, static_cast<T*>(jacobian) + long(w) * p->nv * p->nv);
    }
  });
}

// A single world is spared the work of lanes that nobody needs.
template <class What, class T, int D> void make_of(const pbfd_plan* p, const pbfd_steps* s, void* room) {
  using V = Lanes<T, register_bytes / int(sizeof(T))>;
  auto make = [&](auto& plan, auto& own, auto* grip, auto& arena) { What::make(p, s, plan, own, grip, arena); };
  if (s->last - s->first == 1)
    with_each<T, D>(p, s->own, {static_cast<T*>(room)}, make);
  else
    with_several<V, D>(p, s->own, {static_cast<V*>(room)}, make);
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

template <template <class, class, int> class Scheme> struct Recording {
  template <class V, class N>
  static void make(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, const Plan<N, 3>& plan, Numbers<V>& own, const V* grip,
                   Arena<V>& arena) {
    using T = typename Kind<V>::Scalar;
    auto out = [](void* array) { return static_cast<T*>(array); };
    const Roster<T> roster{r->links, r->slots, r->first_limit, r->own != 0,
                           r->carrier, r->slot, r->danger, r->meeting_slot, r->meeting_danger, static_cast<const T*>(r->real)};
    const Record<T> record{static_cast<const T*>(a->dt), a->alike != 0, static_cast<const T*>(a->spacing), a->worlds, a->given, a->found, a->hazards, timetable<T>(p, a), out(a->q), out(a->v), out(a->link_poses),
                           out(a->center_of_mass), out(a->kinetic_energy), out(a->potential_energy), out(a->linear_momentum),
                           out(a->angular_momentum), out(a->contact_depth), out(a->contact_point), out(a->contact_normal),
                           out(a->contact_force), out(a->contact_slip), a->suspect};
    Recorder<V, N, Scheme<V, N, 3>> recorder(plan, own, roster, arena);
    recorder.balance.contacts.grip = grip;
    recorder.write(record, a->first, a->last);
  }
};

template <template <class, class, int> class Scheme, class T>
void record_of(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  using V = Lanes<T, register_bytes / int(sizeof(T))>;
  with_several<V, 3>(p, a->own, {static_cast<V*>(room)}, [&](auto& plan, auto& own, auto* grip, auto& arena) {
    Recording<Scheme>::make(p, r, a, plan, own, grip, arena);
  });
}

template <template <class, class, int> class Scheme>
void record_by(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  (p->bytes == 8 ? record_of<Scheme, double> : record_of<Scheme, float>)(p, r, a, room);
}

// Room for lanes V, in V; a plane needs less.
template <class V> int room_of(Sizes s) {
  using First = EnergyMomentum<V, V, 3>;
  using Second = ImplicitEuler<V, V, 3>;
  using Third = Bdf2<V, V, 3>;
  return Plan<V, 3>::real_numbers(s) +
         std::max({Machine<V, V, 3, First>::room(s), Machine<V, V, 3, Second>::room(s), Machine<V, V, 3, Third>::room(s),
                   Starts<V, V, 3, First>::room(s), Starts<V, V, 3, Second>::room(s), Starts<V, V, 3, Third>::room(s),
                   Recorder<V, V, First>::room(s), Recorder<V, V, Second>::room(s), Recorder<V, V, Third>::room(s)});
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
  return std::max(long(register_bytes) * std::max(wide, narrow), room_back(sizes(p)));
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

void pbfd_bdf2_record(const pbfd_plan* p, const pbfd_roster* r, const pbfd_record* a, void* room) {
  record_by<Bdf2>(p, r, a, room);
}

void pbfd_balance(const pbfd_plan* p, const pbfd_steps* s, const void* q, void* residual, void* jacobian, void* room) {
  const bool plane = p->dimension == 2;
  if (p->bytes == 8)
    (plane ? balance_of<double, 2> : balance_of<double, 3>)(p, s, q, residual, jacobian, room);
  else
    (plane ? balance_of<float, 2> : balance_of<float, 3>)(p, s, q, residual, jacobian, room);
}

void pbfd_meet(int bytes, const int* whole, const void* real, int count, const int* pairs, const void* poses, const void* moves,
               int* counts, void* found, void* apart) {
  (bytes == 8 ? find_pairs<double> : find_pairs<float>)(whole, real, count, pairs, poses, moves, counts, found, apart);
}
