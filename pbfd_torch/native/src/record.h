// The record of steps that have been made, as records/recording.py: what is seen of the state after each, and of its contacts. A step
// is known by the states before and after it, so a register may hold several of one world. It is made in space, whatever the steps.
#pragma once
#include "energy_momentum.h"
#include "implicit_euler.h"

namespace pbfd {

// What a record is asked for: arrays as interface.h has them.
template <class T> struct Record {
  const T* dt;
  bool alike;        // of all worlds
  const T* spacing;  // [steps] of frames, the length of the last step in each, which what is given sets out from; null: they are none
  int worlds;
  const void *const *given, *const *found;
  const int* hazards;
  Timetable<T> timetable;
  T *q, *v, *link_poses, *center_of_mass, *kinetic_energy, *potential_energy, *linear_momentum, *angular_momentum;
  T *depth, *point, *normal, *force, *slip;
  int* suspect;
};

// The links, the slots of contacts and the dangers that a record lists, and what rides on the world: arrays as interface.h has them.
template <class T> struct Roster {
  int links, slots, first_limit;
  bool own;
  const int *carrier, *slot, *danger;
  const int *meeting_slot, *meeting_danger;  // of contact between bodies the first ones of each group
  const T* real;

  // Of `real`: after the links' frames.
  int numbers() const { return 12 * links + 7; }
  int mass() const { return 12 * links; }
  int still_moment() const { return 12 * links + 1; }
  int still_energy() const { return 12 * links + 4; }
  int still_strain() const { return 12 * links + 5; }
  int still_suspect() const { return 12 * links + 6; }
};

template <class V, class N, class Scheme> struct Recorder {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  using State = typename Scheme::State;
  static constexpr int W = Kind<V>::lanes, D = 3;

  const Plan<N, D>& plan;
  Numbers<V>& own;  // of the worlds in the lanes
  const Roster<T>& roster;
  Balance<V, N, D> balance;
  Scheme scheme;
  State before, after;
  V dt;  // of the steps or frames
  V *velocity, *rates, *rest, *gap, *guess;
  int world[W];  // in each lane

  static int room(Sizes s) {
    return Balance<V, N, D>::room(s) + Scheme::room(s) + 2 * room_for<State>(s) + 12 * s.nodes + 2 * s.nv + 2 * s.nq;
  }
  Recorder(const Plan<N, D>& scene, Numbers<V>& numbers, const Roster<T>& listing, Arena<V>& arena)
      : plan(scene), own(numbers), roster(listing), balance(plan, arena), scheme(plan, arena) {
    before = taken<State>(arena, plan), after = taken<State>(arena, plan);
    velocity = arena.take(plan.nv), rates = arena.take(12 * plan.nodes), gap = arena.take(plan.nv);
    rest = arena.take(plan.nq), guess = arena.take(plan.nq);
  }

  // Of steps first … last − 1 of all steps of all worlds.
  void write(const Record<T>& to, int first, int last) {
    record = &to;
    balance.recall(before.behind);
    for (at = first; at < last; at += W) {
      count = last - at < W ? last - at : W;
      for (int i = 0; i < W; i++) load(i, at + (i < count ? i : count - 1));
      place(plan, after.q, balance.now, balance.axes);
      balance.contacts.look(balance.now);
      balance.laws.begin(balance.dt), write_state();
      if (record->suspect) write_step();
    }
  }

 private:
  const Record<T>* record;
  int at, count;  // which steps the lanes hold

  // Between a lane and the arrays.
  void load(int i, int step) {
    world[i] = step % record->worlds;
    put(dt, i, record->dt[record->alike ? 0 : world[i]]), put(balance.dt, i, record->spacing ? record->spacing[step] : lane(dt, i));
    if (own.varied) own.load(i, world[i]);
    if (const long k = step / record->worlds; plan.moving > 0)
      balance.carriers.load(i, record->timetable.at(k, world[i]), record->timetable.at(k + 1, world[i]));
    const bool given = record->spacing || step < record->worlds;
    const long earlier = given ? step : step - record->worlds;
    int k = 0;
    State::each(plan, [&](auto member, int width) {
      const T* end = static_cast<const T*>(record->found[k]) + long(step) * width;
      const T* start = static_cast<const T*>(given ? record->given[k] : record->found[k]) + earlier * width;
      for (int j = 0; j < width; j++) put((after.*member)[j], i, end[j]), put((before.*member)[j], i, start[j]);
      k++;
    });
  }
  // One of the roster's numbers, as the worlds in the lanes have it.
  V listed(int j) const {
    if (!roster.own) return V(roster.real[j]);
    V x(0);
    for (int i = 0; i < W; i++) put(x, i, roster.real[long(world[i]) * roster.numbers() + j]);
    return x;
  }
  // values [width], at a place in each step's row.
  void store(T* array, const V* values, int width, int row, int place = 0) const {
    for (int i = 0; i < count; i++) {
      T* to = array + long(at + i) * row + place;
      for (int j = 0; j < width; j++) to[j] = lane(values[j], i);
    }
  }

  void write_state() {
    scheme.velocity(after, dt, velocity);
    scheme.speeds(after, balance.now, balance.axes, velocity, dt, rates);
    V center[D], linear[D], angular[D], levered[D], rotors(0);
    sum_up(center, linear, angular);
    const V potential = stored(center), per_mass = V(1) / listed(roster.mass());
    for (int i = 0; i < D; i++) center[i] = per_mass * (center[i] + listed(roster.still_moment() + i));
    cross(center, linear, levered);
    for (int i = 0; i < D; i++) angular[i] = angular[i] - levered[i];
    for (int i = 0; i < plan.nv; i++) rotors = fma(V(plan.armature[i]) * velocity[i], velocity[i], rotors);
    const V kinetic = fma(V(0.5), rotors, kinetic_energy(plan, rates));
    store(record->q, after.q, plan.nq, plan.nq), store(record->v, velocity, plan.nv, plan.nv);
    store(record->center_of_mass, center, D, D), store(record->linear_momentum, linear, D, D);
    store(record->angular_momentum, angular, D, D);
    store(record->kinetic_energy, &kinetic, 1, 1), store(record->potential_energy, &potential, 1, 1);
    for (int k = 0; k < roster.links; k++) show(k);
  }

  // First moment, momentum and moment of momentum of all bodies, about the world's origin.
  void sum_up(V* first, V* linear, V* angular) const {
    for (int i = 0; i < D; i++) first[i] = linear[i] = angular[i] = V(0);
    for (int k = 0; k < plan.nodes; k++) {
      const V *R = balance.now.rotation + D * D * k, *rate = rates + 12 * k, mass = V(plan.mass[k]);
      V x[D], speed[D], spread[D * D], moment[D * D], spin[D], levered[D];
      times<D>(R, plan.center + D * k, x), times<D>(rate, plan.center + D * k, speed);
      for (int i = 0; i < D; i++) {
        x[i] += balance.now.position[D * k + i], speed[i] = mass * (speed[i] + rate[D * D + i]);
        first[i] = fma(mass, x[i], first[i]), linear[i] += speed[i];
      }
      product<D>(rate, plan.second + D * D * k, spread);
      product_transposed<D>(spread, R, moment);
      curl<D>(moment, spin), cross(x, speed, levered);
      for (int i = 0; i < D; i++) angular[i] += spin[i] + levered[i];
    }
  }

  // Of gravity, springs, limits and the contacts' normal forces; `first`: the bodies' first moment.
  V stored(const V* first) {
    V sum = listed(roster.still_energy());
    for (int i = 0; i < D; i++) sum = fma(-V(plan.gravity[i]), first[i], sum);
    for (int i = 0; i < plan.nq; i++) rest[i] = V(plan.rest[i]);
    difference(plan, rest, after.q, gap);
    for (int i = 0; i < plan.nv; i++) sum = fma(V(0.5) * V(plan.spring[i]) * gap[i], gap[i], sum);
    each_limit(plan, after.q, [&](int i, V past) {
      const V x = max(past, V(0));
      sum = fma(V(plan.limit[i]) / V(3), x * x * x, sum);
    });
    each_kind(plan.contact, [&](auto pair, int from, int to) {
      for (int i = from; i < to; i++) sum += balance.contacts.stored(pair, i);
    });
    return sum;
  }

  // A link's pose [3 × 4]; one without a node rides on the world.
  void show(int link) const {
    const int k = roster.carrier[link];
    V frame[12], pose[12];
    for (int i = 0; i < 12; i++) frame[i] = listed(12 * link + i);
    for (int i = 0; i < D; i++)
      for (int j = 0; j < 4; j++) {
        if (k < 0) {
          pose[4 * i + j] = frame[4 * i + j];
          continue;
        }
        const V* R = balance.now.rotation + D * D * k + D * i;
        V sum = j == D ? balance.now.position[D * k + i] : V(0);
        for (int a = 0; a < D; a++) sum = fma(R[a], frame[4 * a + j], sum);
        pose[4 * i + j] = sum;
      }
    store(record->link_poses, pose, 12, 12 * roster.links, 12 * link);
  }

  // The contacts at the end of the step, and what is deepest beyond its measure.
  void write_step() {
    Contacts<V, N, D>& contacts = balance.contacts;
    scheme.begin(balance, before, guess, M(false));
    balance.laws.coast(balance.target, balance.dt);
    contacts.begin(M(true), balance.start, balance.target, balance.dt);
    balance.meetings.begin(M(true), balance.start, balance.target, balance.dt, true);
    balance.meetings.look(balance.now);  // at the rows that have just been found
    V worst = listed(roster.still_strain()), number = listed(roster.still_suspect());
    auto strained = [&](V share, int danger) {  // of those strained alike, the first
      const V this_one = V(T(danger));
      const M more = (share > worst) | ((share >= worst) & (this_one < number));
      worst = select(more, share, worst), number = select(more, this_one, number);
    };
    each_kind(plan.contact, [&](auto pair, int from, int to) {
      for (int i = from; i < to; i++) {
        Touching<V, D> t;
        contacts.center(i, balance.now, t.center);
        const V sunk = contacts.depth(pair, i, balance.now, t.center, t.solid);
        t.depth = sunk + contacts.moved_out(i), t.holding = V(0);
        contacts.touch(pair, i, t);
        Force<V, D> found;
        force<typename decltype(pair)::Support>(t, found);
        for (int j = 0; j < count; j++) show(j, roster.slot[i], t, found);
        const M far = (sunk > V(0)) & contacts.turned_far(i);
        strained(sunk / V(plan.contact.deep[i]) + select(far, V(1), V(0)), roster.danger[i]);
      }
    });
    show_meetings(strained);
    if (roster.first_limit >= 0)
      each_limit(plan, after.q, [&](int i, V past) { strained(max(past, V(-1)) / V(TOO_FAR), roster.first_limit + i); });
    for (int i = 0; i < count; i++) record->suspect[at + i] = record->hazards[at + i] ? int(lane(number, i)) : -1;
  }

  // Between bodies: every lane has its own, and in its own slots.
  template <class F> void show_meetings(F&& strained) {
    Meetings<V, N, D>& meetings = balance.meetings;
    const auto& bodies = meetings.bodies;
    Touching<V, D> t;
    Force<V, D> none;
    t.depth = V(-Meetings<V, N, D>::NOWHERE);
    for (int i = 0; i < D; i++) t.solid.normal[i] = none.p[i] = none.f[i] = none.u[i] = V(0);
    for (int g = 0; g < bodies.groups; g++)
      for (int i = 0; i < count; i++)
        for (int c = 0; c < bodies.kept[g]; c++) show(i, roster.meeting_slot[g] + c, t, none);
    meetings.slots.each_row([&](auto pair, int r) {
      meetings.each_spot(r, [&](Spot<V>& s, int) {
        const V sunk = meetings.depth(pair, r, s, balance.now, t.center, t.solid);
        t.depth = sunk + s.bounce, t.holding = V(0);
        meetings.touch(pair, r, s, t);
        Force<V, D> found;
        force<typename decltype(pair)::Support>(t, found);
        const int g = bodies.group[r];
        for (int i = 0; i < count; i++)
          if (lane(s.there, i) > T(0)) show(i, roster.meeting_slot[g] + int(lane(s.slot, i)), t, found);
        const M far = (sunk > V(0)) & meetings.turned_far(r);
        const V deep = V(meetings.slots.laws(r)[2]);
        strained(sunk / deep + select(far, V(1), V(0)), roster.meeting_danger[g] + bodies.danger[r]);
      });
    });
  }

  // A contact of one of the steps, in a slot of its row.
  void show(int i, int slot, const Touching<V, D>& t, const Force<V, D>& found) const {
    const long to = long(at + i) * roster.slots + slot;
    record->depth[to] = lane(t.depth, i);
    for (int j = 0; j < D; j++) {
      record->point[D * to + j] = lane(found.p[j], i), record->normal[D * to + j] = lane(t.solid.normal[j], i);
      record->force[D * to + j] = lane(found.f[j], i), record->slip[D * to + j] = lane(found.u[j], i);
    }
  }
};

}  // namespace pbfd
