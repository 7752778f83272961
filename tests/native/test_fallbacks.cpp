// A plate is thrown at the ground in long steps, spinning fast: they are refused, made easier, halved, led along detours, by both
// schemes; in a register of worlds and in worlds by themselves, which agree to the bit. Its corners have anchors.
#include "bodies.h"

#include <cmath>

using namespace bodies;

namespace {

constexpr int WORLDS = 19, STEPS = 30, CORNERS = 4;

Run thrown(int first, int count, Step step, const std::vector<int>& widths, double dt) {
  const Scene scene({1.0, {0.004, 0.002, 0.0055}, 0, {0.15, 0.1, 0, 0.15, -0.1, 0, -0.15, 0.1, 0, -0.15, -0.1, 0}, true});
  std::vector<int> with_memory = widths;
  with_memory.push_back(3 * CORNERS);
  Run run(count, STEPS, with_memory);
  for (int w = 0; w < count; w++) {
    const int k = first + w;
    double *q = run.given[0].data() + w * NQ, *other = run.given[1].data() + w * widths[1];
    q[2] = 0.05 + 0.07 * k;
    if (widths[1] == NV) {  // velocities
      other[0] = 0.5 * k, other[2] = -3, other[3] = 7.0 * (k % 5), other[4] = -9.0 * (k % 3), other[5] = 2.0 * (k % 7);
    } else {  // where it was one step before
      const double half = 0.15 * (k % 11);
      for (int i = 0; i < NQ; i++) other[i] = q[i];
      other[0] -= 0.5 * k * dt, other[2] += 6 * dt, other[3] = std::cos(half), other[4] = std::sin(half);
    }
  }
  if (count > 5) run.given[0][5 * NQ] = std::numeric_limits<double>::quiet_NaN();
  run.make(scene, step, dt);
  return run;
}

// Adds how often each status was seen.
void compare(Step step, const std::vector<int>& widths, double dt, int* seen) {
  const Run all = thrown(0, WORLDS, step, widths, dt);
  for (int w = 0; w < WORLDS; w++) {
    for (int k = 0; k < STEPS; k++) seen[all.status(w, k)]++;
    for (int k = 0; k < STEPS; k++) CHECK(all.counted[1][k * WORLDS + w] <= 5000);
    if (w == 5) {
      CHECK(all.status(w, 0) == NON_FINITE);
    } else {
      CHECK(all.same(w, thrown(w, 1, step, widths, dt), 0));
      for (int k = 0; k < STEPS; k++) {  // the last part ends where the step does
        const int at = k * WORLDS + w, parts = 1 << all.halved[at];
        CHECK((parts > 1) == (all.status(w, k) == HALVED));
        CHECK((all.eased[PARTS * at] > 0) == (all.status(w, k) == EASED) || parts > 1);
        for (int j = 0; j < NQ; j++) CHECK(all.ends[(PARTS * at + parts - 1) * NQ + j] == all.q(w, k)[j]);
      }
    }
  }
}

}  // namespace

int main() {
  int seen[8] = {}, detours[8] = {};
  for (double dt : {0.1, 0.2}) compare(pbfd_energy_momentum, VELOCITIES, dt, seen);
  for (double dt : {0.2, 0.25, 0.3, 0.5}) compare(pbfd_implicit_euler, POSITIONS, dt, detours);
  CHECK(seen[SOLVED] > 0 && seen[EASED] > 0 && seen[HALVED] > 0 && detours[SOLVED] > 0 && detours[WARM_STARTED] > 0);
  for (int unsolved : {STALLED, ITERATION_LIMIT}) CHECK(seen[unsolved] + detours[unsolved] == 0);
  return failures();
}
