// J is the slope of r, by central differences: of a free body that carries a hinge and a slide, askew, with inertia on the chord of
// the step and at its end.
#include "integrators.h"

#include <cmath>
#include <vector>

#include "check.h"

using namespace pbfd;

namespace {

constexpr int NODES = 3, NQ = 9, NV = 8;
constexpr double DT = 0.05, H = 1e-6;

std::vector<int> whole_numbers() {
  std::vector<int> w = {-1, 0, 1, FREE, HINGE, SLIDE, 0, 7, 8, 0, 6, 7, 0, 0, 0};
  for (int i = 0; i < NV; i++) w.push_back(i);
  for (int i = 0; i < NV; i++)
    for (int j = 0; j < NV; j++) w.push_back(j < i ? j : 0);
  w.insert(w.end(), Candidates<double, 3>::KINDS, 0);  // nothing touches
  return w;
}

std::vector<double> real_numbers() {
  const double c = std::cos(0.7), s = std::sin(0.7);
  std::vector<double> n = {1, 0, 0, 0, 1, 0, 0, 0, 1, c, -s, 0, s * c, c * c, -s, s * s, c * s, c, c, 0, s, 0, 1, 0, -s, 0, c};
  auto add = [&](std::vector<double> x) { n.insert(n.end(), x.begin(), x.end()); };
  auto each = [&](double x) { n.insert(n.end(), NV, x); };
  add({0, 0, 0, 0.3, 0.1, -0.2, 0.1, 0.4, 0.2}), add({0, 0.1, 0.2}), add({1, 1, 1});
  add({2, 1, 0.5}), add({0.1, 0.2, 0, -0.1, 0.1, 0.3, 0, 0.2, 0.1});
  for (int k = 0; k < NODES; k++) add({0.1, 0.01, 0.02, 0.01, 0.2, 0.03, 0.02, 0.03, 0.15});
  add({3.5, 1.5, 0.5});
  each(1), each(1), each(1), each(0.5);           // scales, hefts, what turns, inertia that is felt
  each(0.3), each(0.2), each(0.1), each(0);       // springs, damping, rotors, no dry friction
  each(-1e9), each(1e9), each(0);                 // no limits
  add({0, 0, 0, 1, 0, 0, 0, 0, 0}), add({0, 0, -9.81, 1, 1, 0, 1e-3});
  return n;
}

}  // namespace

int main() {
  const Sizes sizes{{0, 0, 0, 0, 0, 0}, NODES, NQ, NV, 0, 0};
  const std::vector<int> whole = whole_numbers();
  const std::vector<double> real = real_numbers();
  CHECK(Plan<double>::whole_numbers(sizes) == int(whole.size()));
  CHECK(Plan<double>::real_numbers(sizes) == int(real.size()));
  const Plan<double> plan(sizes, whole.data(), real.data(), nullptr);
  std::vector<double> memory(Balance<double, double>::room(sizes));
  Arena<double> arena{memory.data()};
  Balance<double, double> b(plan, arena);
  const double q[NQ] = {0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5, 0.4, 0.2}, v[NV] = {1, -2, 0.5, 3, 2, -4, 5, 1};
  const double moved[NV] = {0.03, 0.02, -0.01, 0.2, -0.1, 0.15, 0.1, 0.05};
  for (double share : {0.5, 1.0}) {
    double room[18 * NODES], x[NQ], y[NQ];
    b.dt = DT;
    begin_energy_momentum(b, q, v, room);
    b.share = share;
    for (int i = 0; i < NV; i++) b.fitted[i] = 0.5;
    b.begin();
    retract(plan, q, moved, 1.0, x);
    b.evaluate(x);
    // components of r along the body's own axes turn with it: the exponential chart's slopes are less by ½ [r]×
    const double* r = b.residual + 3;
    const double turned[9] = {0, -r[2], r[1], r[2], 0, -r[0], -r[1], r[0], 0};
    b.assemble(x, true);
    std::vector<double> J(b.matrix, b.matrix + NV * NV), ahead(NV);
    for (int j = 0; j < NV; j++) {
      double d[NV] = {};
      d[j] = 1;
      retract(plan, x, d, H, y);
      b.evaluate(y);
      ahead.assign(b.residual, b.residual + NV);
      retract(plan, x, d, -H, y);
      b.evaluate(y);
      for (int i = 0; i < NV; i++) {
        const bool own = i >= 3 && i < 6 && j >= 3 && j < 6;
        const double slope = (ahead[i] - b.residual[i]) / (2 * H) - (own ? 0.5 * turned[3 * (i - 3) + j - 3] : 0.0);
        CHECK(std::fabs(slope - J[NV * i + j]) < 1e-4);
      }
    }
  }
  return failures();
}
