// Frames of as many steps as each world needs: the same to the bit in any lane and batch, of more steps where more happens, and as
// far as a falling body falls.
#include "bodies.h"

#include <cmath>

using namespace bodies;

namespace {

constexpr int WORLDS = 11, STEPS = 8, CORNERS = 4;
constexpr double DT = 0.1;

Run fallen(int first, int count, Step step, const std::vector<int>& widths, bool struck, double trust) {
  const Scene scene({1.0, {0.004, 0.002, 0.0055}, 0, {0.15, 0.1, 0, 0.15, -0.1, 0, -0.15, 0.1, 0, -0.15, -0.1, 0}});
  Run run(count, STEPS, widths);
  for (int w = 0; w < count; w++) {
    double *q = run.given[0].data() + w * NQ, *other = run.given[1].data() + w * widths[1];
    q[2] = struck ? 0.2 + 0.05 * (first + w) : 10.0;
    if (widths[1] == NV) other[0] = 0.1 * (first + w);
    for (int i = 0; widths[1] == NQ && i < NQ; i++) other[i] = q[i];
  }
  run.make(scene, step, DT, nullptr, 1e-4, trust);
  return run;
}

}  // namespace

int main() {
  for (bool struck : {false, true})
    for (int scheme = 0; scheme < 3; scheme++) {  // energy–momentum, implicit Euler, explicit steps
      const auto& widths = scheme == 1 ? POSITIONS : VELOCITIES;
      const Step step = scheme == 1 ? pbfd_implicit_euler : pbfd_energy_momentum;
      const double trust = scheme == 2 ? 1e-4 : 0;
      const Run all = fallen(0, WORLDS, step, widths, struck, trust);
      for (int w = 0; w < WORLDS; w++) {
        CHECK(all.same(w, fallen(w, 1, step, widths, struck, trust), 0));
        int steps = 0;
        for (int k = 0; k < STEPS; k++) {
          const int at = k * WORLDS + w;
          steps += all.made[at];
          CHECK(all.status(w, k) <= EASED && all.spacing[at] <= (trust > 0 ? 1.0 : 0.5) * DT && all.pace[at] <= DT);
        }
        if (scheme == 0) CHECK(struck ? steps > 2 * STEPS : steps == 2 * STEPS);
        if (scheme == 2) CHECK(struck ? all.status(w, 0) == EXPLICIT && steps > STEPS : steps == STEPS);
        if (scheme != 1 && !struck) CHECK(std::fabs(10.0 - all.q(w, STEPS - 1)[2] - 0.5 * G * 0.64) < 1e-12);
      }
    }
  return failures();
}
