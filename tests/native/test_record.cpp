// The record of a ball that falls, spins and strikes the ground: energies, momenta and contacts in closed form. A register of
// steps does not know how many are asked for.
#include "bodies.h"

#include <cmath>

using namespace bodies;

namespace {

constexpr double RADIUS = 0.1, MASS = 2.0, DT = 0.01, SPIN = 0.3;
constexpr int WORLDS = 3, STEPS = 60, TOTAL = WORLDS * STEPS;

// The ball's link is turned and moved on its node; its contact is in the second of two slots.
struct Seen {
  bodies::Numbers q, v, poses, center, kinetic, potential, linear, angular, depth, point, normal, force, slip;
  std::vector<int> suspect;

  Seen()
      : q(TOTAL * NQ), v(TOTAL * NV), poses(TOTAL * 12), center(TOTAL * 3), kinetic(TOTAL), potential(TOTAL), linear(TOTAL * 3),
        angular(TOTAL * 3), depth(TOTAL * 2, -7.0), point(TOTAL * 6), normal(TOTAL * 6), force(TOTAL * 6), slip(TOTAL * 6), suspect(TOTAL) {}

  // own: what is listed is given for each world.
  void write(const Scene& scene, const Run& run, int first, int last, bool own = false) {
    const int carrier = 0, slot = 1, danger = 4;
    const double real[19] = {0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, MASS + 1, 0, 0, 5, 5 * G, -1, 3};
    bodies::Numbers each;
    for (int w = 0; w < WORLDS; w++) each.insert(each.end(), real, real + 19);
    const pbfd_roster roster{1, 2, -1, own, &carrier, &slot, &danger, own ? each.data() : real};
    const double dt = DT;
    pbfd_record record{&dt, 1, nullptr, WORLDS, first, last, {}, {}, run.counted[3].data(), nullptr, q.data(), v.data(), poses.data(),
                       center.data(), kinetic.data(), potential.data(), linear.data(), angular.data(), depth.data(), point.data(),
                       normal.data(), force.data(), slip.data(), suspect.data()};
    for (std::size_t i = 0; i < run.given.size(); i++)
      record.given[i] = run.given[i].data(), record.found[i] = run.found[i].data();
    void* room = std::aligned_alloc(64, (pbfd_room(&scene.plan) + 127) / 64 * 64);
    pbfd_energy_momentum_record(&scene.plan, &roster, &record, room);
    std::free(room);
  }
};

bool near(double a, double b) { return std::fabs(a - b) < 1e-12; }

}  // namespace

int main() {
  const double inertia = 0.4 * RADIUS * RADIUS * MASS;
  const Scene scene({MASS, {inertia, inertia, inertia}, RADIUS, {0, 0, 0}});
  Run run(WORLDS, STEPS, VELOCITIES);
  for (int w = 0; w < WORLDS; w++) run.given[0][w * NQ + 2] = 0.3 + 0.1 * w, run.given[1][w * NV + 5] = SPIN;
  run.make(scene, pbfd_energy_momentum, DT);
  Seen seen, each, parts;
  seen.write(scene, run, 0, TOTAL), each.write(scene, run, 0, TOTAL, true);
  for (int at = 0; at < TOTAL; at += 7) parts.write(scene, run, at, at + 7 < TOTAL ? at + 7 : TOTAL);
  CHECK(seen.kinetic == parts.kinetic && seen.potential == parts.potential);
  CHECK(seen.force == parts.force && seen.poses == parts.poses);
  CHECK(seen.center == each.center && seen.potential == each.potential && seen.poses == each.poses && seen.suspect == each.suspect);

  bool struck = false;
  for (int i = 0; i < TOTAL; i++) {
    const double z = seen.q[NQ * i + 2], speed = seen.v[NV * i + 2], spin = seen.v[NV * i + 5], deep = RADIUS - z;
    const double stiffness = MASS * G / 1e-6, press = deep > 0 ? deep : 0;
    CHECK(run.found[0][NQ * i + 2] == z);
    CHECK(near(seen.kinetic[i], 0.5 * (MASS * speed * speed + inertia * spin * spin)));
    CHECK(near(seen.potential[i] - 5 * G, MASS * G * z + stiffness * press * press * press / 3));
    CHECK(near(seen.center[3 * i + 2], (MASS * z + 5) / (MASS + 1)));
    CHECK(near(seen.linear[3 * i + 2], MASS * speed) && near(seen.angular[3 * i + 2], inertia * spin));
    const double* pose = seen.poses.data() + 12 * i;
    CHECK(near(pose[11], z + 0.3) && near(pose[3] * pose[3] + pose[7] * pose[7], 0.05) && near(pose[4], -pose[1]));
    CHECK(seen.depth[2 * i] == -7.0 && near(seen.depth[2 * i + 1], deep));
    CHECK(near(seen.point[6 * i + 5], z - RADIUS) && seen.normal[6 * i + 5] == 1.0);
    CHECK(seen.force[6 * i + 5] >= 0 && seen.force[6 * i + 5] <= stiffness * press * press * (1 + 1e-9));
    CHECK(seen.suspect[i] == (run.counted[3][i] ? 4 : -1));
    struck |= seen.force[6 * i + 5] > 0;
    if (i < WORLDS) CHECK(near(spin, SPIN) && near(speed, -G * DT));
  }
  CHECK(struck);
  return failures();
}
