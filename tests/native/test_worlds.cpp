// Steps and starts of worlds with numbers of their own, in a register and by themselves: to the bit what a scene with these numbers
// does, for numbers that lanes of a shared plan have (the friction of candidates) and for others.
#include "bodies.h"

#include <cmath>

using namespace bodies;

namespace {

constexpr int WORLDS = 19, STEPS = 25;
constexpr double DT = 0.02;

// Worlds `first` … of a plate that slides over the ground.
Run sliding(const Scene& scene, int first, int count, int steps, Step step, const std::vector<int>& widths, const double* own) {
  Run run(count, steps, widths);
  for (int w = 0; w < count; w++) {
    const int k = first + w;
    double *q = run.given[0].data() + w * NQ, *other = run.given[1].data() + w * widths[1];
    q[2] = 0.002 * (k % 5);
    for (int i = 0; i < NQ && widths[1] == NQ; i++) other[i] = q[i];
    other[0] += widths[1] == NQ ? -0.05 * DT * k : 0.05 * k;
  }
  run.make(scene, step, DT, own);
  return run;
}

void compare(Step step, const std::vector<int>& widths, std::vector<int> which, double middle, int steps = STEPS) {
  Scene scene({1.0, {0.004, 0.002, 0.0055}, 0.01, {0.15, 0.1, 0, 0.15, -0.1, 0, -0.15, 0.1, 0, -0.15, -0.1, 0}});
  const int varied = int(which.size());
  bodies::Numbers own;
  for (int w = 0; w < WORLDS; w++)
    for (int j = 0; j < varied; j++) own.push_back(middle * (1 + 0.3 * std::sin(3.0 * w + j)));
  scene.plan.varied = varied, scene.plan.which = which.data();
  const Run all = sliding(scene, 0, WORLDS, steps, step, widths, own.data());
  for (int w = 0; w < WORLDS; w++) {
    const Run alone = sliding(scene, w, 1, steps, step, widths, own.data() + w * varied);
    Scene same = scene;
    same.plan.varied = 0, same.plan.real = same.real.data(), same.plan.whole = same.whole.data();
    for (int j = 0; j < varied; j++) same.real[which[j]] = own[w * varied + j];
    CHECK(all.status(w, steps - 1) <= HALVED);
    CHECK(all.same(w, alone, 0) && all.same(w, sliding(same, w, 1, steps, step, widths, nullptr), 0));
    if (w > 0) CHECK(!all.same(w, all, 0));
  }
}

}  // namespace

int main() {
  const Scene scene({1.0, {1, 1, 1}, 0.01, {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0}});
  const pbfd::Plan<double> plan(sizes(&scene.plan), scene.whole.data(), scene.real.data(), nullptr);
  const int mass = int(plan.mass - scene.real.data()), carried = int(plan.carried - scene.real.data());
  const int grip = int(plan.contact.grip - scene.real.data()), damping = int(plan.damping - scene.real.data());
  const std::vector<int>* widths[] = {&VELOCITIES, &POSITIONS};
  for (int scheme = 0; scheme < 2; scheme++) {
    const Step step = scheme ? pbfd_implicit_euler : pbfd_energy_momentum;
    compare(step, *widths[scheme], {mass, carried}, 1.0);
    compare(step, *widths[scheme], {grip, grip + 1, grip + 2, grip + 3}, 0.5);
    compare(step, *widths[scheme], {damping, damping + 1, damping + 2}, 0.7);
  }
  compare(pbfd_start_energy_momentum, VELOCITIES, {mass, carried}, 1.0, 1);
  return failures();
}
