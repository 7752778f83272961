// A ball is dropped, in a register of worlds and in worlds by themselves: it comes to rest on the ground, and both agree to the bit.
#include "library.cpp"

#include <cmath>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <vector>

#include "check.h"

namespace {

constexpr double RADIUS = 0.1, MASS = 1.0, G = 9.81, DT = 0.01;
constexpr int NQ = 7, NV = 6, WORLDS = 11, STEPS = 100;

// the node; how many dofs each of its dofs rides on, and which; no point on a plane, one ball: on node 0, on plane 0
const int whole[] = {-1, FREE, 0, 0, 1,
                     0, 1, 2, 3, 4, 5,
                     0, 0, 0, 0, 0, 0,
                     0, 0, 0, 0, 0, 0,
                     0, 1, 0, 0, 0, 0,
                     0, 1, 2, 0, 0, 0,
                     0, 1, 2, 3, 0, 0,
                     0, 1, 2, 3, 4, 0,
                     0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
                     0, 0, 0};

std::vector<double> numbers() {
  const double inf = std::numeric_limits<double>::infinity(), second = MASS * RADIUS * RADIUS / 5;
  std::vector<double> n = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, MASS, 0, 0, 0, second, 0, 0, 0, second, 0, 0, 0, second, MASS};
  auto each = [&](double straight, double turning) {
    for (int i = 0; i < NV; i++) n.push_back(i < 3 ? straight : turning);
  };
  each(MASS * G, MASS * G * RADIUS), each(MASS, MASS * RADIUS), each(0, 1), each(0.5, 0.5);
  for (int what = 0; what < 4; what++) each(0, 0);  // no springs, damping, rotors, dry friction
  each(-inf, -inf), each(inf, inf), each(0, 0);
  n.insert(n.end(), {0, 0, 0, 1, 0, 0, 0});
  n.insert(n.end(), {0, 0, -G, RADIUS, 1, 0, 1e-3});
  n.insert(n.end(), {0, 0, 0, RADIUS, 0, MASS * G / 1e-6, 0.5, 0.01, 0.1, 1e-3, 0, 0, 1, 0});
  return n;
}

struct Worlds {
  std::vector<double> given[9], found[9], residual_norm;
  std::vector<int> made, counted[5];

  explicit Worlds(int count) {
    const int sizes[9] = {NQ, NV, NV, NV, NV, NV, 1, 1, 1};
    for (int i = 0; i < 9; i++) given[i].resize(sizes[i] * count), found[i].resize(sizes[i] * count * STEPS);
    residual_norm.resize(count * STEPS), made.resize(count);
    for (auto& x : counted) x.resize(count * STEPS);
  }
};

// Worlds `first` … of all, each dropped from its own height and set spinning.
Worlds dropped(int first, int count) {
  const std::vector<double> real = numbers();
  const pbfd_plan plan{8, 3, 1, NQ, NV, 0, 1, 1, 0, 0, 0, 0, whole, real.data()};
  CHECK(pbfd_whole_numbers(&plan) == long(sizeof(whole) / sizeof(int)));
  CHECK(pbfd_real_numbers(&plan) == long(real.size()));
  void* room = std::aligned_alloc(64, (pbfd_room(&plan) + 127) / 64 * 64);
  Worlds worlds(count);
  for (int w = 0; w < count; w++) {
    worlds.given[0][w * NQ + 2] = RADIUS + 0.01 * (first + w), worlds.given[0][w * NQ + 3] = 1;
    worlds.given[1][w * NV + 4] = first + w;
  }
  pbfd_steps s{DT, 1e-9, 1e-3, 40, count, 0, count, STEPS, 1, worlds.made.data(), {}, nullptr, {}, worlds.residual_norm.data(), {}, nullptr};
  for (int i = 0; i < 9; i++) s.given[i] = worlds.given[i].data(), s.found[i] = worlds.found[i].data();
  for (int i = 0; i < 5; i++) s.counted[i] = worlds.counted[i].data();
  pbfd_energy_momentum(&plan, &s, room);
  for (int w = 0; w < count; w++)
    while (worlds.made[w] < STEPS) {  // what the scheme refuses is taken as it is
      const int stopped = worlds.made[w]++ * count + w;
      for (int i = 0; i < 9; i++) {
        const int size = int(worlds.given[i].size()) / count;
        std::memcpy(worlds.given[i].data() + w * size, worlds.found[i].data() + stopped * size, size * sizeof(double));
      }
      pbfd_energy_momentum(&plan, &s, room);
    }
  std::free(room);
  return worlds;
}

}  // namespace

int main() {
  CHECK(pbfd_interface() > 0);
  CHECK(pbfd_lanes(4) == 2 * pbfd_lanes(8));
  const Worlds all = dropped(0, WORLDS);
  for (int w = 0; w < WORLDS; w++) {
    const int last = (STEPS - 1) * WORLDS + w;
    CHECK(all.made[w] == STEPS);
    CHECK(all.counted[0][last] == SOLVED);
    CHECK(std::fabs(all.found[0][last * NQ + 2] - RADIUS) < 2e-3);
    const Worlds alone = dropped(w, 1);
    for (int step = 0; step < STEPS; step++) {
      const int here = step * WORLDS + w;
      for (int i = 0; i < NQ; i++) CHECK(alone.found[0][step * NQ + i] == all.found[0][here * NQ + i]);
      for (int i = 0; i < NV; i++) CHECK(alone.found[1][step * NV + i] == all.found[1][here * NV + i]);
    }
  }
  return failures();
}
