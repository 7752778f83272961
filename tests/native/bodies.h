// One free body with points or balls at it above the ground, many worlds of it stepped by the library.
#pragma once
#include "itinerary.h"

#include <cstdlib>
#include <limits>
#include <vector>

#include "check.h"
#include "given.h"

using namespace pbfd;

namespace bodies {

constexpr double G = 9.81;
constexpr int NQ = 7, NV = 6, HALVINGS = 3, PARTS = 8;
using Numbers = std::vector<double>;

// [mass, moments of inertia] of the body, radius of all candidates at these positions.
struct Body {
  double mass, inertia[3], radius;
  Numbers positions;  // [3] each
  bool anchored = false;
};

struct Scene {
  std::vector<int> whole;
  Numbers real;
  pbfd_plan plan;

  explicit Scene(const Body& b) {
    const int candidates = int(b.positions.size()) / 3;
    const double inf = std::numeric_limits<double>::infinity(), sum = 0.5 * (b.inertia[0] + b.inertia[1] + b.inertia[2]);
    auto add = [&](std::initializer_list<double> x) { real.insert(real.end(), x); };
    auto each = [&](double straight, double turning) { add({straight, straight, straight, turning, turning, turning}); };
    auto all = [&](double x) { real.insert(real.end(), candidates, x); };
    whole = {-1, FREE, 0, 0, 1, 0, 1, 2, 3, 4, 5};  // how many dofs each dof rides on, and which
    for (int i = 0; i < NV; i++)
      for (int j = 0; j < NV; j++) whole.push_back(j < i ? j : 0);
    for (int kind = 0; kind < pbfd::Candidates<double, 3>::KINDS; kind++) whole.push_back(kind == (b.radius > 0) ? candidates : 0);
    whole.insert(whole.end(), 3 * candidates, 0);  // all on node 0, all against plane 0
    for (int i = 0; i < candidates; i++) whole.push_back(b.anchored ? i : -1);
    whole.insert(whole.end(), candidates, -1);  // by the usual law
    add({1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, b.mass, 0, 0, 0});
    add({sum - b.inertia[0], 0, 0, 0, sum - b.inertia[1], 0, 0, 0, sum - b.inertia[2], b.mass});
    const double weight = b.mass * G, reach = 0.1;
    each(weight, weight * reach), each(b.mass, b.mass * reach), each(0, 1), each(b.mass, sum);
    for (int what = 0; what < 4; what++) each(0, 0);  // no springs, damping, rotors, dry friction
    each(-inf, -inf), each(inf, inf), each(0, 0), add({0, 0, 0, 1, 0, 0, 0});
    add({0, 0, -G, reach, 1, 0, 1e-3});
    real.insert(real.end(), b.positions.begin(), b.positions.end());
    all(b.radius), all(0), all(weight / 1e-6), all(0.5), all(0.01), all(1 / 0.1), all(b.anchored ? 1 / 1e-4 : 1 / 1e-3), add({0, 0, 1, 0});
    plan = {8, 3, 1, NQ, NV, 0, candidates, b.anchored ? candidates : 0, 1, 0, 0, 0, 0, 0, 0, whole.data(), real.data(), nullptr, nullptr};
    CHECK(pbfd_whole_numbers(&plan) == long(whole.size()));
    CHECK(pbfd_real_numbers(&plan) == long(real.size()));
  }
};

using Step = void (*)(const pbfd_plan*, const pbfd_steps*, void*);

// What all steps of all worlds have come to; `given` and the state after each step in arrays of these widths.
struct Run {
  int worlds, steps;
  std::vector<int> widths;
  std::vector<Numbers> given, found;
  Numbers residual_norm, trial[7];
  std::vector<int> counted[4], fallbacks, halved, eased, made;
  Numbers ends, wish, pace, spacing;  // of ways and frames
  std::vector<Numbers> before_last;

  Run(int count, int length, std::vector<int> sizes) : worlds(count), steps(length), widths(sizes) {
    for (int width : widths) given.emplace_back(width * count), found.emplace_back(width * count * length);
    for (int w = 0; w < count; w++) given[0][w * NQ + 3] = 1;
    residual_norm.resize(count * length), fallbacks.resize(4 * count * length);
    for (auto& x : counted) x.resize(count * length);
    halved.resize(count * length), eased.resize(PARTS * count * length), ends.resize(PARTS * NQ * count * length);
    made.resize(count * length), pace.resize(count * length), spacing.resize(count * length), before_last = found;
    for (auto& x : trial) x.resize(count * NQ);
  }

  // own: numbers of each world, where the plan says which these are. accuracy: of frames, 0: steps, whose ways are asked for. trust:
  // of explicit steps.
  void make(const Scene& scene, Step step, double dt, const double* own = nullptr, double accuracy = 0, double trust = 0) {
    void* room = std::aligned_alloc(64, (pbfd_room(&scene.plan) + 127) / 64 * 64);
    pbfd_steps s{&dt, 1, HALVINGS, 1e-9, 1e-3, 1, 1e300, 5000, worlds, 0, worlds, steps, 1, {}, nullptr, {}, residual_norm.data(), {}, fallbacks.data(), own, {}};
    if (accuracy > 0) {
      wish.assign(worlds, dt), s.accuracy = accuracy, s.shortest = dt / 4096;
      s.wish = wish.data(), s.pace = pace.data(), s.spacing = spacing.data(), s.made = made.data();
      for (std::size_t i = 0; i < given.size(); i++) s.before_last[i] = before_last[i].data();
    } else {
      s.halved = halved.data(), s.eased = eased.data(), s.ends = ends.data();
    }
    std::vector<double> estimate(residual_norm.size()), strike(residual_norm.size());
    s.trust = trust, s.estimate = estimate.data(), s.strike = strike.data();
    for (std::size_t i = 0; i < given.size(); i++) s.given[i] = given[i].data(), s.found[i] = found[i].data();
    for (int i = 0; i < 4; i++) s.counted[i] = counted[i].data();
    for (int i = 0; i < 7; i++) s.trial[i] = trial[i].data();
    step(&scene.plan, &s, room);
    std::free(room);
  }

  int status(int world, int step) const { return counted[0][step * worlds + world]; }
  const double* q(int world, int step) const { return found[0].data() + (step * worlds + world) * NQ; }

  // Whether a world has gone the way of another run's, to the bit.
  bool same(int world, const Run& other, int other_world) const {
    for (int step = 0; step < steps; step++)
      for (std::size_t i = 0; i < widths.size(); i++)
        for (int j = 0; j < widths[i]; j++)
          if (found[i][(step * worlds + world) * widths[i] + j] !=
              other.found[i][(step * other.worlds + other_world) * widths[i] + j])
            return false;
    return true;
  }
};

const std::vector<int> VELOCITIES = {NQ, NV, NV, NV, NV, NV, 1, 1, 1}, POSITIONS = {NQ, NQ, NV};

}  // namespace bodies
