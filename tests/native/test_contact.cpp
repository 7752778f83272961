// Every kind of contact: J is the derivative of r, friction that is held at the forces of a place is there what it was, what a
// direction promises sets out along r·d and dᵀJd, and a world gets the same numbers in a register of worlds and by itself.
#include "outlook.h"

#include <cmath>
#include <limits>
#include <vector>

#include "check.h"

using namespace pbfd;

namespace {

constexpr double DT = 0.01, MASS = 1.0, SECOND = 0.01, INF = std::numeric_limits<double>::infinity();
constexpr int NQ = 7, NV = 6, WORLDS = 11, KINDS = Candidates<double, 3>::KINDS, CELLS = 9;

// The usual law, anchors, and all uncommon manners, some with another exponent; torsional friction with some, sticking and sliding.
struct Holding {
  bool anchored, uncommon;
  int manner;
  double mu, particulars[PARTICULARS];
};
const Holding HOLDINGS[] = {{false, false, 0, 0.5, {}},
                            {true, false, 0, 0.5, {}},
                            {false, true, COULOMB, 0.5, {1.5, 0, 0, 0, 0}},
                            {true, true, COULOMB, 0.5, {2.5, 0, 0, 0, 0}},
                            {false, true, STATIC, 0.5, {2, 0, 0, 0.4, 1 / 0.05}},
                            {false, true, PAPER, 1e6, {2, 1, 1, 0, 0}},
                            {false, true, PAPER, 3e6, {1.7, 0.6, 1.3, 0, 0}},
                            {false, true, GRADIENT, 1e5, {2, 0, 1, 0, 0}},
                            {false, true, GRADIENT, 1e6, {2, 0.5, 1.4, 0, 0}},
                            {false, true, COULOMB, 0.5, {2, 0, 0, 0, 0, 0, 0, 0.05, 1 / 0.5}},
                            {true, true, COULOMB, 0.5, {2, 0, 0, 0, 0, 0, 0, 0.05, 1 / 0.05}},
                            {false, true, PAPER, 1e6, {2, 1, 1, 0, 0, 0, 0, 0.05, 1 / 0.5}},
                            {false, true, GRADIENT, 1e6, {1.7, 0.5, 1.4, 0, 0, 0, 0, 0.05, 1 / 0.05}}};

enum Solid { HULL = 4, TERRAIN, SAMPLED };  // after the ball, the capsule, the box and the cylinder

// The faces and edges of a box, as polyhedron.h reads them.
std::vector<double> block(double x, double y, double z) {
  const double half[3] = {x, y, z};
  std::vector<double> out;
  for (int k = 0; k < 6; k++)
    for (int j = 0; j < 4; j++) out.push_back(j == 3 ? half[k / 2] : j == k / 2 ? (k % 2 ? 1 : -1) : 0);
  for (int k = 0; k < 12; k++) {  // along the axis k / 4
    double ends[6];
    for (int e = 0; e < 2; e++)
      for (int j = 0, bit = 0; j < 3; j++) ends[3 * e + j] = half[j] * (j == k / 4 ? 2 * e - 1 : (k >> bit++) % 2 ? 1 : -1);
    out.insert(out.end(), ends, ends + 6);
  }
  return out;
}

// A free body at z = 1.2 or so that touches a solid whose top is at z = 1, by a candidate of one kind.
struct Scene {
  std::vector<int> whole;
  std::vector<double> real, heights;
  Sizes sizes;

  Scene(int kind, const Holding& how) {
    const bool anchored = how.anchored;
    const bool plane = kind < 3, rim = kind == 2 || kind >= 10;  // see kinds.h
    const int solid = plane ? -1 : kind < 10 ? kind - 3 : kind - 5;
    if (solid == HULL) heights = block(0.5, 0.6, 1);
    const int samples = solid == TERRAIN ? CELLS * CELLS : solid == SAMPLED ? CELLS * CELLS * CELLS : int(heights.size());
    whole = {-1, FREE, 0, 0, 1, 0, 1, 2, 3, 4, 5};  // how many dofs each dof rides on, and which
    for (int i = 0; i < NV; i++)
      for (int j = 0; j < NV; j++) whole.push_back(j < i ? j : 0);
    for (int k = 0; k < KINDS; k++) whole.push_back(k == kind);
    whole.insert(whole.end(), {0, 0, 0, anchored ? 0 : -1, how.uncommon - 1});  // carrier, solid, form, anchor, law
    if (solid == HULL)
      whole.insert(whole.end(), {0, 6, 12, 0});
    else if (!plane)
      whole.insert(whole.end(), {0, CELLS, CELLS, solid == SAMPLED ? CELLS : 1});
    if (how.uncommon) whole.push_back(how.manner);
    real = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, MASS, 0.01, 0, 0.02, SECOND, 0, 0, 0, SECOND, 0, 0, 0, 2 * SECOND, MASS};
    auto each = [&](double straight, double turning) {
      for (int i = 0; i < NV; i++) real.push_back(i < 3 ? straight : turning);
    };
    each(10, 1), each(MASS, 0.1), each(0, 1), each(0.5, 0.5);
    for (int what = 0; what < 4; what++) each(0, 0);
    each(-INF, -INF), each(INF, INF), each(0, 0);
    real.insert(real.end(), {0, 0, 0, 1, 0, 0, 0});
    real.insert(real.end(), {0, 0, -9.81, 0.2, 1, 0, 1e-3});
    real.insert(real.end(), {0.05, 0.02, 0, rim || kind == 0 ? 0 : 0.2, kind == 0 ? 0.2 : 0, 1e4, how.mu, 0.01, 1 / 0.3, anchored ? 1 / 1e-3 : 1 / 1e-2});
    if (plane) real.insert(real.end(), {0, 0, 1, 1});
    if (!plane) {
      real.insert(real.end(), {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, solid == TERRAIN ? 1.0 : 0.0});  // a frame; terrain lies at z = 1
      const double sizes[7][6] = {{1}, {0.6, 0.4}, {0.5, 0.6, 1}, {0.7, 1}, {1}, {-0.4, -0.4, 0.1, 0.1}, {-0.4, -0.4, 0.6, 0.1}};
      real.insert(real.end(), sizes[solid], sizes[solid] + 6);
      real.push_back(solid <= HULL ? 1 : INF);
      for (int i = 0; i < samples && solid > HULL; i++)  // hills, or heights above z = 1, with waves
        heights.push_back(solid == TERRAIN ? 0.02 * std::sin(0.9 * i) : 0.1 * (i % CELLS) - 0.5 + 0.01 * std::cos(1.7 * i));
    }
    if (rim) real.insert(real.end(), {0.04, 0, 0, 0, 0.05, 0, 0, 0, 0.03, 0, 1, 0, 0});
    if (how.uncommon) real.insert(real.end(), how.particulars, how.particulars + PARTICULARS);
    sizes = {{1, anchored, plane, !plane, samples, rim, how.uncommon}, 1, NQ, NV, 0, 0};
    CHECK(Plan<double>::whole_numbers(sizes) == int(whole.size()));
    CHECK(Plan<double>::real_numbers(sizes) == int(real.size()));
  }
};

// Room for a balance and an outlook.
template <class V> struct Room {
  std::vector<V> memory;
  explicit Room(Sizes s) : memory(Balance<V, double>::room(s) + Outlook<V, double>::room(s)) {}
  Arena<V> arena() { return {memory.data()}; }
};

// The step of a world: it has begun a little beside q.
template <class V> void begin(Balance<V, double>& b, const V* q, V* v, V* room) {
  V before[NQ];
  for (int i = 0; i < NV; i++) v[i] = V(0.2 * std::sin(3.0 * i + 1));
  retract(b.plan, q, v, V(-DT), before);
  b.dt = V(DT), b.share = V(0.5);
  for (int i = 0; i < NV; i++) b.fitted[i] = V(0.5);
  begin_energy_momentum(b, before, v, room);
  b.begin();
}

void start(double* q, int world, double height) {
  const double turn[3] = {0.2 * std::sin(1.0 * world), 0.15 * std::cos(2.0 * world), 0.1 * world};
  q[0] = 0.03 * std::sin(4.0 * world), q[1] = 0.02 * std::cos(5.0 * world), q[2] = height;
  quaternion_exp(turn, q + 3);
}

// J at q, where `b` has been evaluated, is how r differs at the places beside it.
void derive(const Balance<double, double>& b, Balance<double, double>& moved, const double* q) {
  double largest = 1, d[NV], shifted[NQ], off[NV][NV];  // differences of r less J
  for (int i = 0; i < NV * NV; i++) largest = std::fmax(largest, std::fabs(b.matrix[i]));
  for (int j = 0; j < NV; j++) {
    double column[2][NV];
    for (int side = 0; side < 2; side++) {
      for (int i = 0; i < NV; i++) d[i] = i == j ? (side ? 1e-6 : -1e-6) : 0;
      retract(b.plan, q, d, 1.0, shifted);
      moved.evaluate(shifted);
      for (int i = 0; i < NV; i++) column[side][i] = moved.residual[i];
    }
    for (int i = 0; i < NV; i++) off[i][j] = (column[1][i] - column[0][i]) / 2e-6 - b.matrix[NV * i + j];
  }
  for (int i = 0; i < NV; i++)
    for (int j = 0; j < NV; j++) {
      const bool turns = i >= 3 && j >= 3;  // torques along axes that turn themselves: J is that of a chart which does not
      CHECK(std::fabs(turns ? 0.5 * (off[i][j] + off[j][i]) : off[i][j]) < 1e-6 * largest);
    }
}

// Friction from here on feels the forces where `b` is.
void hold(Balance<double, double>& b, const Balance<double, double>& at) {
  b.relaxed.lagged = b.relaxed.lagging = true;
  at.each_normal_force(at.now, [&](int i, double force, double felt) { b.relaxed.hold(true, i, force, felt); });
}

void of_kind(int kind, const Holding& how) {
  const Scene scene(kind, how);
  const Plan<double> plan(scene.sizes, scene.whole.data(), scene.real.data(), scene.heights.data());
  const double height = scene.sizes.forms ? 1.15 : 1.17;
  using V = Lanes<double, 4>;
  Room<double> alone(scene.sizes), beside(scene.sizes);
  Room<V> together(scene.sizes);
  Arena<double> arena = alone.arena(), second = beside.arena();
  Arena<V> wide = together.arena();
  Balance<double, double> b(plan, arena), moved(plan, second);
  Outlook<double, double> outlook(plan, arena);
  Balance<V, double> all(plan, wide);
  const V grip(plan.contact.grip[0]);
  b.contacts.grip = moved.contacts.grip = plan.contact.grip, all.contacts.grip = &grip;
  double v[NV], room[18];
  V q_all[NQ], v_all[NV], room_all[18];
  int touched = 0;
  const double behind[3] = {4e-4, -3e-4, 2e-4};
  const V behind_all[3] = {V(behind[0]), V(behind[1]), V(behind[2])};
  b.contacts.behind = moved.contacts.behind = behind, all.contacts.behind = behind_all;
  for (int world = 0; world < WORLDS; world++) {
    double q[NQ], d[NV];
    b.relaxed.none(), moved.relaxed.none();
    start(q, world, height);
    begin(b, q, v, room), begin(moved, q, v, room);
    b.evaluate(q), b.assemble(q, true);
    touched += b.pushes[0].any;
    derive(b, moved, q);
    double work = 0, curve = 0, known;
    for (int i = 0; i < NV; i++) d[i] = 0.01 * std::cos(2.0 * i + world), work += b.residual[i] * d[i];
    for (int i = 0; i < NV; i++)
      for (int j = 0; j < NV; j++) curve += d[i] * b.matrix[NV * i + j] * d[j];
    outlook.look(b, q, d, work, curve, true);
    CHECK(std::fabs(outlook.work(0, known) - work) <= 1e-12 * std::fabs(work));
    CHECK(outlook.count == 1);
    for (double a : {0.2, 1.3}) {  // how it rises further on
      double slope, none;
      outlook.work(a, slope);
      const double differed = (outlook.work(a + 1e-5, none) - outlook.work(a - 1e-5, none)) / 2e-5;
      CHECK(std::fabs(differed - slope) <= 1e-6 * (std::fabs(slope) + std::fabs(work)));
    }

    for (int i = 0; i < Kind<V>::lanes; i++) {
      double other[NQ];
      start(other, world + 3 * i, height);
      for (int j = 0; j < NQ; j++) put(q_all[j], i, other[j]);
    }
    begin(all, q_all, v_all, room_all);
    all.evaluate(q_all), all.assemble(q_all, true);
    for (int i = 0; i < NV; i++) CHECK(lane(all.residual[i], 0) == b.residual[i]);
    for (int i = 0; i < NV * NV; i++) CHECK(lane(all.matrix[i], 0) == b.matrix[i]);

    double residual[NV], size = 0;
    for (int i = 0; i < NV; i++) residual[i] = b.residual[i], size = std::fmax(size, std::fabs(residual[i]));
    hold(moved, b), hold(b, b);
    b.evaluate(q), b.assemble(q, true);
    for (int i = 0; i < NV; i++) CHECK(std::fabs(b.residual[i] - residual[i]) <= 1e-12 * size);
    derive(b, moved, q);
  }
  CHECK(touched == WORLDS);
}

}  // namespace

int main() {
  for (int kind = 0; kind < KINDS; kind++) {
    const int before = failures();
    for (const Holding& how : HOLDINGS) of_kind(kind, how);
    if (failures() > before) std::fprintf(stderr, "kind %d\n", kind);
  }
  return failures();
}
