// The candidates between bodies of all lanes: found anew at the start of every step, each lane's own, and in the same places of the
// same rows for all.
#pragma once
#include "branches.h"
#include "curved.h"
#include "finder.h"

namespace pbfd {

template <class V, class N, int D> struct Slots {
  using T = typename Kind<V>::Scalar;
  using M = typename Kind<V>::Mask;
  static constexpr int W = Kind<V>::lanes;

  const Plan<N, D>& plan;
  const Bodies<T>& bodies;
  Finder<T> finder;
  Coupling coupling;
  bool changed = true;  // J couples other bodies than when it was last asked
  Poses<V> before;      // of the nodes, at the start of the step
  const V* behind = nullptr;  // what anchors remember
  V* reach;             // [groups × links] how far colliders may move without one being missed
  V dropped;            // 1 where more was near than is kept
  Spot<V>* spot;        // [rows × SPOTS]
  int active, *rows;    // those with candidates in some lane
  int *most, *count;    // [rows] in any lane, [rows × W] in each
  int *found, *listed;   // [W × groups], [W × slots] of each lane, row · SPOTS + place of each candidate, as they were found
  V still[12];          // the world's own pose

  static int in(int bytes) { return (bytes + int(sizeof(V)) - 1) / int(sizeof(V)); }
  static int room(Sizes s) {
    const BodySizes& b = s.bodies;
    if (D != 3 || b.rows == 0) return 0;
    return b.groups * b.links + in(int(sizeof(Spot<V>)) * SPOTS * b.rows) + in(int(sizeof(int)) * ints(b)) +
           in(int(sizeof(T)) * Finder<T>::room(b, s.nodes + s.moving)) + in(Coupling::bytes(s.nodes, s.nv));
  }
  static int ints(const BodySizes& b) { return b.rows * (2 + W) + W * (b.groups + b.slots); }

  Slots(const Plan<N, D>& scene, Arena<V>& arena)
      : plan(scene), bodies(scene.pairing), finder(bodies, there(scene) ? plan.nodes + plan.moving : 0, scalars(arena)),
        coupling(there(scene) ? plan.nodes : 0, plan.nv, there(scene) ? bytes(arena, Coupling::bytes(plan.nodes, plan.nv)) : nullptr) {
    active = 0, dropped = V(0);
    for (int i = 0; i < 12; i++) still[i] = V(T(i < 9 && i % 4 == 0));
    if (!there(plan)) return;
    reach = arena.take(bodies.groups * bodies.links);
    spot = reinterpret_cast<Spot<V>*>(bytes(arena, int(sizeof(Spot<V>)) * SPOTS * bodies.rows));
    rows = reinterpret_cast<int*>(bytes(arena, int(sizeof(int)) * ints(bodies)));
    most = rows + bodies.rows, count = most + bodies.rows, found = count + W * bodies.rows, listed = found + W * bodies.groups;
    for (int i = 0; i < bodies.rows; i++) most[i] = 0;
    for (int i = 0; i < W * bodies.rows; i++) count[i] = 0;
    for (int i = 0; i < W * bodies.groups; i++) found[i] = 0;
    coupling.begin(plan);
  }

  // A step of these lanes begins at these poses, and leads to `free` without contact. `sorted`: nearest first, as in the reference.
  void find(M which, Poses<V> start, Poses<V> free, V dt, bool sorted) {
    before = start;
    for (int g = 0; g < bodies.groups; g++)
      for (int l = 0; l < bodies.links; l++) {  // half as far again as its free motion, and the slack
        V& far = reach[g * bodies.links + l];
        far = select(which, fma(V(1.5), travel(g, l, start, free), V(bodies.slack[g])), far);
      }
    for (int i = 0; i < W; i++)
      if (lane(which, i)) find(i, start, free, sorted);
    gather();
    each_row([&](auto pair, int r) {
      for (int j = 0; j < most[r]; j++) begin(pair, r, spot[SPOTS * r + j], dt);
    });
  }

  // A node that joints move, or −1.
  int on_tree(int node) const { return node < plan.nodes ? node : -1; }
  const V* rotation(Poses<V> at, int node) const {
    return node < 0 ? still : node < plan.nodes ? at.rotation + 9 * node : at.carriers + 12 * (node - plan.nodes);
  }
  const V* position(Poses<V> at, int node) const {
    return node < 0 ? still + 9 : node < plan.nodes ? at.position + 3 * node : at.carriers + 12 * (node - plan.nodes) + 9;
  }
  // A point as the body of a row's solid sees it.
  void seen(int row, Poses<V> at, const V* x, V* out) const {
    const V* p = position(at, bodies.second[row]);
    const V off[3] = {x[0] - p[0], x[1] - p[1], x[2] - p[2]};
    transposed_times(rotation(at, bodies.second[row]), off, out);
  }
  void center(int row, const Spot<V>& s, Poses<V> at, V* out) const {
    times(rotation(at, bodies.first[row]), s.position, out);
    for (int j = 0; j < 3; j++) out[j] += position(at, bodies.first[row])[j];
  }
  const T* solid(int row) const { return bodies.of_row + NUMBERS_OF_A_ROW * row + 1; }
  const T* own_frames(int row) const { return bodies.of_row + NUMBERS_OF_A_ROW * row + OWN_FRAMES; }
  T radius(int row) const { return bodies.of_row[NUMBERS_OF_A_ROW * row]; }
  Curved<T> curved(int row) const { return {bodies.of_row + NUMBERS_OF_A_ROW * row}; }
  Standing<V> standing(Poses<V> at, int node) const { return {rotation(at, node), position(at, node)}; }
  const N* laws(int row) const { return plan.laws + LAWS_OF_A_ROW * row; }

  // Where a candidate of a group is in a lane.
  int* slot(int group, int i, int which) const {
    int first = 0;
    for (int g = 0; g < group; g++) first += bodies.kept[g];
    return listed + W * first + bodies.kept[group] * i + which;
  }

  // visit(what a row's points touch, the row) of rows that have any.
  template <class F> void each_row(F&& visit) const {
    for (int k = 0; k < active; k++) {
      const int r = rows[k];
      switch (bodies.meeting[r]) {
        case CORNER_ON_FACE: visit(Pair<Face, Point>(), r); break;
        case BALL_ON_FACE: visit(Pair<Face, Ball>(), r); break;
        case BALL_ON_PILL: visit(Pair<Guarded<Pill>, Ball>(), r); break;
        case BALL_ON_BLOCK: visit(Pair<Guarded<Block>, Ball>(), r); break;
        case BALL_ON_DRUM: visit(Pair<Guarded<Drum>, Ball>(), r); break;
        case RIM_ON_FACE: visit(Pair<Face, Ellipsoid>(), r); break;
        case ROUND_ON_ROUND: visit(Pair<Near, Approaching>(), r); break;
      }
    }
  }

  // How far the farthest collider of a link moves at most.
  V travel(int group, int link, Poses<V> from, Poses<V> to) const {
    const int k = bodies.node[link];
    if (k < 0) return V(0);
    V turn[9], moved[9], shift[3];
    const T* frame = bodies.frame + 12 * link;
    for (int j = 0; j < 9; j++) turn[j] = rotation(to, k)[j] - rotation(from, k)[j];
    product(turn, frame, moved), times(turn, frame + 9, shift);
    V chord(0);
    for (int j = 0; j < 9; j++) chord = fma(moved[j], moved[j], chord);
    for (int j = 0; j < 3; j++) shift[j] += position(to, k)[j] - position(from, k)[j];
    return fma(V(bodies.extent[group * bodies.links + link]), sqrt(V(0.5) * chord), sqrt(dot(shift, shift)));
  }

 private:
  static bool there(const Plan<N, D>& plan) { return D == 3 && plan.bodies.rows > 0; }
  static char* bytes(Arena<V>& arena, int size) { return reinterpret_cast<char*>(arena.take(in(size))); }
  T* scalars(Arena<V>& arena) const {
    if (!there(plan)) return nullptr;
    return reinterpret_cast<T*>(bytes(arena, int(sizeof(T)) * Finder<T>::room(bodies, plan.nodes + plan.moving)));
  }

  void find(int i, Poses<V> start, Poses<V> free, bool sorted) {
    for (int k = 0; k < plan.nodes + plan.moving; k++) copy(start, k, i, finder.start[k]), copy(free, k, i, finder.ahead[k]);
    for (int g = 0; g < bodies.groups; g++)
      for (int c = 0; c < found[W * g + i]; c++) {  // what it had
        const int at = *slot(g, i, c);
        put(spot[at].there, i, T(0)), count[W * (at / SPOTS) + i] = 0;
      }
    bool more = false;
    for (int g = 0; g < bodies.groups; g++) {
      for (int l = g * bodies.links; l < (g + 1) * bodies.links; l++) finder.reach[l] = lane(reach[l], i);
      more = finder.find(g, sorted || bodies.memory[g] >= 0) || more;
      found[W * g + i] = finder.count;
      for (int c = 0; c < finder.count; c++) {
        const Found<T>& one = finder.found[finder.order[c]];
        Spot<V>& s = spot[*slot(g, i, c) = settle(i, one)];
        put(s.slot, i, T(c));
        if (bodies.memory[g] >= 0) inherit(g, i, one, s);
      }
    }
    put(dropped, i, T(more));
  }
  // What the anchor is behind by of the nearest candidate of the same pair in the step before.
  void inherit(int g, int i, const Found<T>& one, Spot<V>& s) const {
    const T* frames = own_frames(one.row);
    T nearest(HUGE_VAL), x[3], off[3], kept[3] = {}, anchor[3];
    for (int j = 0; j < 3; j++) off[j] = one.position[j] - frames[9 + j];
    transposed_times(frames, off, x);
    for (int m = 0; m < bodies.kept[g]; m++) {
      const V* memory = behind + bodies.memory[g] + NUMBERS_OF_AN_ANCHOR * m;
      if (lane(memory[6], i) != T(bodies.danger[one.row])) continue;
      for (int j = 0; j < 3; j++) off[j] = x[j] - lane(memory[3 + j], i);
      const T distance = dot(off, off);
      if (!(distance < nearest)) continue;
      nearest = distance;
      for (int j = 0; j < 3; j++) kept[j] = lane(memory[j], i);
    }
    times(frames + 12, kept, anchor);
    for (int j = 0; j < 3; j++) put(s.anchor[j], i, anchor[j]);
  }
  void copy(Poses<V> from, int k, int i, Pose<T>& to) const {
    for (int j = 0; j < 9; j++) to.rotation[j] = lane(rotation(from, k)[j], i);
    for (int j = 0; j < 3; j++) to.position[j] = lane(position(from, k)[j], i);
  }

  // A lane's candidate in a place of its row; which.
  int settle(int i, const Found<T>& c) {
    const int place = count[W * c.row + i]++, at = SPOTS * c.row + place;
    Spot<V>& s = spot[at];
    if (place >= most[c.row]) s.clear(), most[c.row] = place + 1;  // no lane has had it
    put(s.there, i, T(1)), put(s.offset, i, c.offset), put(s.passed, i, T(c.passed)), put(s.near, i, T(c.near));
    for (int j = 0; j < 3; j++) put(s.position[j], i, c.position[j]), put(s.normal[j], i, c.normal[j]);
    if (bodies.meeting[c.row] >= CURVED) {
      put(s.rim, i, T(c.rim)), put(s.lying, i, T(c.lying)), put(s.follows, i, T(c.follows));
      for (int j = 0; j < 2; j++) put(s.swept[j], i, T(c.swept[j]));
      for (int j = 0; j < 3; j++) put(s.other[j], i, c.other[j]);
    }
    return at;
  }

  // Which rows have candidates in some lane, and which bodies these couple.
  void gather() {
    bool* wanted = coupling.wanted;
    for (int i = 0; i < plan.nodes * plan.nodes; i++) wanted[i] = false;
    active = 0;
    for (int r = 0; r < bodies.rows; r++) {
      if (most[r] == 0) continue;
      most[r] = 0;
      for (int i = 0; i < W; i++) most[r] = most[r] > count[W * r + i] ? most[r] : count[W * r + i];
      if (most[r] == 0) continue;
      rows[active++] = r;
      const int a = on_tree(bodies.first[r]), b = on_tree(bodies.second[r]);
      if (a >= 0 && b >= 0) wanted[plan.nodes * (a > b ? a : b) + (a > b ? b : a)] = true;
    }
    changed = coupling.renew(plan) || changed;
  }

  // Where it is at the start, as the solid's body sees it.
  template <class Pair> void begin(Pair, int row, Spot<V>& s, V dt) {
    V c[3], ran[3], own[3], belt[3];
    Beside<V, 3> solid_there;
    center(row, s, before, c), seen(row, before, c, s.start);
    const int runs = bodies.first[row] >= plan.nodes ? bodies.first[row] : bodies.second[row];  // that of an obstacle
    for (int j = 0; j < 3; j++) own[j] = V(laws(row)[5 + j]);
    times(runs >= plan.nodes ? rotation(before, runs) : still, own, belt);
    transposed_times(rotation(before, bodies.second[row]), belt, ran);
    Pair::Surface::beside(s, solid(row), s.start, solid_there);
    s.began = V(radius(row)) - solid_there.distance;
    if constexpr (Pair::Support::wanders) s.began = curved_depth<typename Pair::Support>(row, s, c, solid_there);
    for (int j = 0; j < 3; j++) s.start[j] = fma(dt, ran[j], s.start[j]);
  }

  // Of a curved body beside a plane, and which part of its normal force it gives in this step.
  template <class Support> V curved_depth(int row, Spot<V>& s, const V* c, Beside<V, 3>& plane) const {
    const Standing<V> one = standing(before, bodies.first[row]), other = standing(before, bodies.second[row]);
    V axis[3];
    times(other.rotation, s.normal, plane.normal), times(one.rotation, curved(row).axis(), axis);
    s.share = Ellipsoid::share(s.lying, dot(axis, plane.normal));
    return sunk<Support>(s, curved(row), one, other, c, plane);
  }
};

}  // namespace pbfd
