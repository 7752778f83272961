// Steps followed back, and ahead: a translation unit of its own, so that both are compiled side by side.
#include <algorithm>
#include <cstring>

#include "adjoint.h"
#include "bdf2.h"
#include "energy_momentum.h"
#include "implicit_euler.h"
#include "tangent.h"
#include "target.h"

using namespace pbfd;

namespace {

// Steps of a scheme followed back, or ahead.
template <template <class, int, template <class, class, int> class> class Way, int D, template <class, class, int> class Scheme>
void follow(const pbfd_plan* p, const pbfd_descent* d, void* room) {
  using L = Lanes<double, register_bytes / 8>;
  using Followed = Way<L, D, Scheme>;
  const Descent<double> of = {
      d->worlds, d->steps, d->rows, d->halvings, d->held != 0, d->alike != 0, d->refined != 0, d->dropped != 0,
      static_cast<const double*>(d->dt), d->given, d->found, static_cast<const double*>(d->control), timetable<double>(p, d),
      d->detour, d->halved, d->eased, static_cast<const double*>(d->ends), d->constant, d->cotangent, d->seen,
      static_cast<double*>(d->by_control), static_cast<double*>(d->by_number), static_cast<double*>(d->by_dt), d->singular};
  const Rules rules = {0, HUGE_VAL, d->share, d->jump, d->halvings, 0, 0, 0, 0};
  with_each<L, D>(p, d->own, {static_cast<L*>(room)}, [&](const Plan<L, D>& plan, Numbers<L>& own, const L*, Arena<L>& arena) {
    Arena<Traced<L>> written{reinterpret_cast<Traced<L>*>(arena.next + Followed::room(plan))};
    std::memset(static_cast<void*>(written.next), 0, Followed::written_room(plan) * sizeof(Traced<L>));  // nothing there is a node
    Followed(p, plan, own, arena, written).run(of, rules, d->first, d->last);
  });
}

template <template <class, int, template <class, class, int> class> class Way, template <class, class, int> class Scheme>
void go(const pbfd_plan* p, const pbfd_descent* d, void* room) {
  p->dimension == 3 ? follow<Way, 3, Scheme>(p, d, room) : follow<Way, 2, Scheme>(p, d, room);
}

template <template <class, class, int> class Scheme> long room_for_scheme(Sizes s) {
  using L = Lanes<double, register_bytes / 8>;
  using Followed = Retrace<L, 3, Scheme>;
  return (Plan<L, 3>::real_numbers(s) + Followed::room(s)) * long(sizeof(L)) + Followed::written_room(s) * long(sizeof(Traced<L>));
}

}  // namespace

long pbfd::room_back(Sizes s) {
  return std::max({room_for_scheme<EnergyMomentum>(s), room_for_scheme<ImplicitEuler>(s), room_for_scheme<Bdf2>(s)});
}

void pbfd_energy_momentum_back(const pbfd_plan* p, const pbfd_descent* d, void* room) { go<Adjoint, EnergyMomentum>(p, d, room); }

void pbfd_energy_momentum_ahead(const pbfd_plan* p, const pbfd_descent* d, void* room) { go<Tangent, EnergyMomentum>(p, d, room); }

void pbfd_implicit_euler_back(const pbfd_plan* p, const pbfd_descent* d, void* room) { go<Adjoint, ImplicitEuler>(p, d, room); }

void pbfd_implicit_euler_ahead(const pbfd_plan* p, const pbfd_descent* d, void* room) { go<Tangent, ImplicitEuler>(p, d, room); }

void pbfd_bdf2_back(const pbfd_plan* p, const pbfd_descent* d, void* room) { follow<Adjoint, 3, Bdf2>(p, d, room); }

void pbfd_bdf2_ahead(const pbfd_plan* p, const pbfd_descent* d, void* room) { follow<Tangent, 3, Bdf2>(p, d, room); }
