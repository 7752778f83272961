// A ball is dropped, in a register of worlds and in worlds by themselves: it comes to rest on the ground; both agree to the bit.
#include "bodies.h"

#include <cmath>

using namespace bodies;

namespace {

constexpr double RADIUS = 0.1;
constexpr int WORLDS = 11, STEPS = 100;

// Worlds `first` … of all, each dropped from its own height and set spinning.
Run dropped(int first, int count) {
  const double inertia = 0.4 * RADIUS * RADIUS;
  const Scene scene({1.0, {inertia, inertia, inertia}, RADIUS, {0, 0, 0}});
  Run run(count, STEPS, VELOCITIES);
  for (int w = 0; w < count; w++)
    run.given[0][w * NQ + 2] = RADIUS + 0.01 * (first + w), run.given[1][w * NV + 4] = first + w;
  run.make(scene, pbfd_energy_momentum, 0.01);
  return run;
}

}  // namespace

int main() {
  CHECK(pbfd_interface() > 0);
  CHECK(pbfd_lanes(4) == 2 * pbfd_lanes(8));
  const Run all = dropped(0, WORLDS);
  for (int w = 0; w < WORLDS; w++) {
    CHECK(all.status(w, STEPS - 1) == SOLVED);
    CHECK(std::fabs(all.q(w, STEPS - 1)[2] - RADIUS) < 2e-3);
    CHECK(all.same(w, dropped(w, 1), 0));
  }
  return failures();
}
