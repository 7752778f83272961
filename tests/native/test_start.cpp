// A ball that lies on the ground starts with what the ground gives it, one that falls with nothing, one that strikes it with
// nothing yet; in a register of worlds and in worlds by themselves, which agree to the bit.
#include "bodies.h"

#include <cmath>

using namespace bodies;

namespace {

constexpr double RADIUS = 0.1, DT = 0.01, INERTIA = 0.4 * RADIUS * RADIUS;
constexpr int WORLDS = 11, LYING = 0, FALLING = 1, STRIKING = 2;

Run begun(int first, int count, Step start, const std::vector<int>& widths) {
  const Scene scene({1.0, {INERTIA, INERTIA, INERTIA}, RADIUS, {0, 0, 0}});
  Run run(count, 1, widths);
  for (int w = 0; w < count; w++) {
    double *q = run.given[0].data() + w * NQ, *v = run.given[1].data() + w * NV;
    const int kind = (first + w) % 3;
    q[2] = kind == LYING ? RADIUS - 1e-3 : RADIUS + 0.05;  // pressed in as deep as weight presses it
    if (kind == STRIKING) v[2] = -10;
  }
  run.make(scene, start, DT);
  return run;
}

double up(const Run& run, int field, int world) { return run.found[field][world * run.widths[field] + 2]; }
bool near(double a, double b) { return std::fabs(a - b) < 1e-6; }

}  // namespace

int main() {
  const Run fast = begun(0, WORLDS, pbfd_start_energy_momentum, VELOCITIES);
  const Run slow = begun(0, WORLDS, pbfd_start_implicit_euler, POSITIONS);
  for (int w = 0; w < WORLDS; w++) {
    CHECK(fast.status(w, 0) <= HALVED && slow.status(w, 0) <= HALVED);
    const double start = w % 3 == STRIKING ? -10 : 0, push = w % 3 == LYING ? DT * G : 0, a = w % 3 == LYING ? 0 : -G;
    CHECK(near(up(fast, 1, w), start - 0.5 * push) && near(up(fast, 2, w), push) && near(up(fast, 3, w), push));
    CHECK(near(up(slow, 2, w), a) && near(up(slow, 1, w), slow.q(w, 0)[2] - DT * start + 0.5 * DT * DT * a));
    CHECK(fast.same(w, begun(w, 1, pbfd_start_energy_momentum, VELOCITIES), 0));
    CHECK(slow.same(w, begun(w, 1, pbfd_start_implicit_euler, POSITIONS), 0));
  }
  return failures();
}
