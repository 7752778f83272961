// Candidates between bodies at the start of a step, of one world, as contact/round_pairs.py, ball_pairs.py, polytope_pairs.py,
// curved_pairs.py and closest_pairs.py.
#pragma once
#include <algorithm>

#include "bodies.h"
#include "closest.h"
#include "manifold.h"
#include "solids.h"

namespace pbfd {

// A candidate: a point on a body, and on the other one a plane, on its node or, beside a solid, in that solid's frame. There the
// plane stands for the solid where `passed`, and not only near the solid's middle unless `near` (contact/surface.py, `Tangent`).
template <class T> struct Found {
  int row;
  T position[3], normal[3], offset, gap;
  bool passed, near;
  // of curved bodies, see facets.h
  bool rim, follows, swept[2];
  int lying;
  T other[3];

  void on_plane() { passed = true, near = rim = follows = swept[0] = swept[1] = false, lying = 0, other[0] = other[1] = other[2] = T(0); }
};

// The sizes of one solid, as solids ask for them.
template <class T> struct Measure {
  const T* measure;
};

template <class T> inline void seen_from(const Pose<T>& pose, const T* x, T* out) {
  const T off[3] = {x[0] - pose.position[0], x[1] - pose.position[1], x[2] - pose.position[2]};
  transposed_times(pose.rotation, off, out);
}
// A frame of a body's, rotation and position [12], in the world.
template <class T> inline void placed(const Pose<T>& body, const T* frame, Pose<T>& out) {
  product(body.rotation, frame, out.rotation);
  placed(body, frame + 9, out.position);
}
template <class T> inline T apart(const T* a, const T* b) {
  const T off[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
  return sqrt(dot(off, off));
}

// The distance of a point from the segment ab.
template <class T> inline T from_segment(const T* x, const T* a, const T* b) {
  T along[3], off[3];
  for (int j = 0; j < 3; j++) along[j] = b[j] - a[j], off[j] = x[j] - a[j];
  const T share = share_of(dot(off, along), dot(along, along));
  for (int j = 0; j < 3; j++) off[j] = fma(-share, along[j], off[j]);
  return sqrt(dot(off, off));
}

template <class T> struct Finder {
  const Bodies<T>& bodies;
  Pose<T> world;
  Pose<T> *start, *ahead;  // [nodes]
  T* reach;                // [groups × links] how far their colliders may move without one being missed
  Pose<T>* places;         // [colliders], and the boxes around them
  T *lower, *upper;
  Found<T>* found;
  int* order;
  int count;

  // In scalars.
  static int room(BodySizes s, int nodes) {
    const int places = int(sizeof(Pose<T>) / sizeof(T)), candidate = int((sizeof(Found<T>) + sizeof(int)) / sizeof(T)) + 2;
    return 2 * places * nodes + s.groups * s.links + (places + 6) * s.colliders + candidate * SPOTS * s.pairs + 2;
  }
  Finder(const Bodies<T>& all, int nodes, T* room) : bodies(all) {
    auto take = [&](int size) { T* here = room; room += size; return here; };
    auto poses = [&](int size) { return reinterpret_cast<Pose<T>*>(take(int(sizeof(Pose<T>) / sizeof(T)) * size)); };
    for (int j = 0; j < 9; j++) world.rotation[j] = T(j % 4 == 0);
    for (T& x : world.position) x = T(0);
    start = poses(nodes), ahead = poses(nodes), reach = take(all.groups * all.links), places = poses(all.colliders);
    lower = take(3 * all.colliders), upper = take(3 * all.colliders);
    const int most = SPOTS * all.pairs;
    found = reinterpret_cast<Found<T>*>(take(int(sizeof(Found<T>) / sizeof(T)) * most));
    order = reinterpret_cast<int*>(take(most));
  }

  // Of a group: the nearest ones, in `order`, as many as it keeps; whether more were near. `sorted`: nearest first, as slots are.
  bool find(int group, bool sorted) {
    count = 0;
    const int kind = bodies.finder[group], first = bodies.first_pair[group], last = bodies.first_pair[group + 1];
    if (kind == POLYTOPE_PAIRS || kind == CURVED_PAIRS) surround(group, first, last);
    for (int p = first; p < last; p++) {
      if (kind == ROUND_PAIRS)
        find_round(group, p);
      else if (kind == BALL_PAIRS)
        find_ball(group, p);
      else if (kind == CLOSEST_PAIRS)
        find_closest(group, p);
      else if (overlap(bodies.one[p], bodies.other[p])) {
        if (kind == POLYTOPE_PAIRS || !met_at_one_point(group, p)) find_polytopes(group, p);
      }
    }
    for (int i = 0; i < count; i++) order[i] = i;
    const bool dropped = count > bodies.kept[group];
    if (dropped || sorted)
      std::sort(order, order + count, [&](int i, int j) { return found[i].gap < found[j].gap || (!(found[j].gap < found[i].gap) && i < j); });
    if (dropped) count = bodies.kept[group];
    return dropped;
  }

  static constexpr double SHORT = 1e-3;  // of a cylinder's length: rims nearer to one another are one

  const Pose<T>& standing(int node) const { return node < 0 ? world : start[node]; }
  const Pose<T>& going(int node) const { return node < 0 ? world : ahead[node]; }

 private:
  T reach_of(int group, int link) const { return link < 0 ? bodies.slack[group] : reach[group * bodies.links + link]; }
  T moves(int group, int p) const { return reach_of(group, bodies.link[2 * p]) + reach_of(group, bodies.link[2 * p + 1]); }

  // Between spheres and capsules: spheres on the first one's axis, where it is nearest and at both ends of what lies side by side.
  void find_round(int group, int p) {
    const int row = bodies.row[p], first = bodies.first[row], second = bodies.second[row];
    const T *axes = bodies.numbers + NUMBERS_OF_A_PAIR * p, *radii = axes + 12, within = moves(group, p);
    T ends[12], shift[12];
    for (int k = 0; k < 4; k++) {
      placed(standing(k < 2 ? first : second), axes + 3 * k, ends + 3 * k);
      placed(going(k < 2 ? first : second), axes + 3 * k, shift + 3 * k);
      for (int j = 3 * k; j < 3 * k + 3; j++) shift[j] -= ends[j];
    }
    const T *a = ends, *b = ends + 3, *c = ends + 6, *d = ends + 9;
    T u[3], v[3], w[3], x[3], y[3];
    for (int j = 0; j < 3; j++) u[j] = b[j] - a[j], v[j] = d[j] - c[j], w[j] = a[j] - c[j], x[j] = -w[j], y[j] = d[j] - a[j];
    const T uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w);
    const T s = share_of(uv * vw - vv * uw, uu * vv - uv * uv), t = share_of(vw + s * uv, vv);
    const T shares[3] = {share_of(t * uv - uw, uu), share_of(dot(x, u), uu), share_of(dot(y, u), uu)};
    const bool is_long = axes[0] != axes[3] || axes[1] != axes[4] || axes[2] != axes[5];
    for (int i = 0; i < (is_long ? 3 : 1); i++) {
      T center[3], freely(0);
      for (int j = 0; j < 3; j++) center[j] = fma(shares[i], u[j], a[j]);
      const T gap = from_segment(center, c, d) - (radii[0] + radii[1]);
      if (!(gap < within)) continue;
      Found<T>& out = found[count++];
      out.row = row, out.gap = gap;
      for (int j = 0; j < 3; j++) out.position[j] = fma(shares[i], axes[3 + j] - axes[j], axes[j]);
      for (int k = 2; k < 4; k++) {
        T off[3];
        for (int j = 0; j < 3; j++) off[j] = fma(shares[i], shift[3 + j] - shift[j], shift[j]) - shift[3 * k + j];
        freely = max(freely, sqrt(dot(off, off)));
      }
      guard<Pill>(out, center, freely, within);
    }
  }

  // Of a ball beside a box or a cylinder.
  void find_ball(int group, int p) {
    const int row = bodies.row[p], first = bodies.first[row], second = bodies.second[row];
    const T *numbers = bodies.numbers + NUMBERS_OF_A_PAIR * p, within = moves(group, p);
    T center[3], later[3], seen[3], seen_later[3];
    placed(standing(first), numbers, center), placed(going(first), numbers, later);
    seen_from(standing(second), center, seen), seen_from(going(second), later, seen_later);
    Found<T>& out = found[count];
    out.row = row;
    for (int j = 0; j < 3; j++) out.position[j] = numbers[j];
    const T freely = apart(seen, seen_later);
    const T distance = bodies.meeting[row] == BALL_ON_BLOCK ? guard<Block>(out, center, freely, within)
                                                            : guard<Drum>(out, center, freely, within);
    out.gap = distance - numbers[3];
    if (out.gap < within) count++;
  }

  // The plane that touches a solid where a point is nearest, and where it is to stand for it; the distance.
  template <class Solid> T guard(Found<T>& out, const T* center, T freely, T most) {
    const T *solid = bodies.of_row + NUMBERS_OF_A_ROW * out.row + 1, thickness = solid[15];
    const Measure<T> measure{solid + 12};
    Pose<T> frame;
    placed(standing(bodies.second[out.row]), solid, frame);
    T p[3];
    seen_from(frame, center, p);
    const T distance = Solid::field(measure, 0, p, out.normal);
    const bool outside = distance > T(0), led = outside && freely > fma(T(0.25), thickness, distance);
    out.passed = led || (outside && most > fma(T(0.5), thickness, distance)), out.near = !led;
    out.offset = dot(p, out.normal) - distance;
    return distance;
  }

  // Boxes around the colliders of these pairs, with room for what they may move.
  void surround(int group, int first, int last) {
    for (int c = 0; c < bodies.colliders; c++) lower[3 * c] = T(1), upper[3 * c] = T(-1);  // none yet
    for (int p = first; p < last; p++)
      for (int c : {bodies.one[p], bodies.other[p]})
        if (lower[3 * c] > upper[3 * c]) surround(group, c);
  }
  void surround(int group, int c) {
    placed(standing(bodies.collider_node[c]), bodies.collider + 12 * c, places[c]);
    const Hull<T> hull = bodies.hulls[c];
    const T room = hull.radius() + reach_of(group, bodies.collider_link[c]);
    for (int j = 0; j < 3; j++) {
      T least, most;
      const T* row = places[c].rotation + 3 * j;
      hull.lowest(row, least), hull.highest(row, most);
      lower[3 * c + j] = places[c].position[j] + least - room, upper[3 * c + j] = places[c].position[j] + most + room;
    }
  }
  bool overlap(int a, int b) const {
    bool all = true;
    for (int j = 0; j < 3; j++) all = all && lower[3 * a + j] <= upper[3 * b + j] && lower[3 * b + j] <= upper[3 * a + j];
    return all;
  }

  void find_polytopes(int group, int p) {
    const int a = bodies.one[p], b = bodies.other[p];
    const T within = moves(group, p);
    Met<T> met;
    meet(bodies.hulls, a, b, bodies.boxes[p] != 0, places[a], places[b], within, met);
    const T* points = bodies.collider + 12 * (met.swapped ? b : a);
    const T* plane = bodies.collider + 12 * (met.swapped ? a : b);
    const Hull<T> hull = bodies.hulls[met.swapped ? b : a];
    const auto add = [&](const T* point, T gap) -> Found<T>& {
      Found<T>& out = found[count++];
      out.on_plane();
      out.row = bodies.row[p] + met.swapped, out.gap = gap;
      times(points, point, out.position), times(plane, met.normal, out.normal);
      for (int j = 0; j < 3; j++) out.position[j] += points[9 + j];
      out.offset = met.offset + dot(out.normal, plane + 9);
      // beside curved bodies points reach a little too (terms/supported.py)
      if (bodies.finder[group] == CURVED_PAIRS && bodies.meeting[out.row] < CURVED) out.offset += T(Ellipsoid::POINT);
      return out;
    };
    for (int i = 0; i < met.count; i++) {
      if (!(met.gap[i] < within) || (hull.curved && hull.half() == 0)) continue;
      add(met.point[i], met.gap[i]).lying = hull.curved;
    }
    if (!hull.curved || met.count == 0) return;
    // its rims, at both ends of where it overlaps; an ellipsoid has one, itself
    T low = met.point[0][2], high = low, own[3], n[3];
    for (int i = 1; i < met.count; i++) low = min(low, met.point[i][2]), high = max(high, met.point[i][2]);
    const T half = hull.half(), ends[2] = {clamped(low, -half, half), clamped(high, -half, half)};
    const Pose<T>&over = places[met.swapped ? b : a], &under = places[met.swapped ? a : b];
    times(under.rotation, met.normal, n), transposed_times(over.rotation, n, own);
    const T squares[3] = {own[0] * own[0], own[1] * own[1], own[2] * own[2]}, reach = sqrt(dot(hull.form(), squares));
    for (int i = 0; i < (ends[1] - ends[0] > T(SHORT) * half ? 2 : 1); i++) {
      const T center[3] = {T(0), T(0), ends[i]};
      T x[3], seen[3];
      placed(over, center, x), seen_from(under, x, seen);
      const T gap = dot(seen, met.normal) - met.offset - reach;
      if (!(gap < within)) continue;
      Found<T>& out = add(center, gap);
      out.rim = true, out.lying = half > 0 ? -1 : 0;
    }
  }

  // Of round bodies that have no flat caps.
  void find_closest(int group, int p) {
    const T *numbers = bodies.numbers + NUMBERS_OF_A_PAIR * p, within = moves(group, p);
    RoundPair<T> pair;
    Sought<T> found;
    round_pair(p, pair);
    if (apart(pair.center[0], pair.center[1]) - numbers[12] >= within) return;
    seek(pair, found);
    if (found.gap < within) add_met(p, pair, found, !held_apart(pair, found.gap, within));
  }
  // Whether two bodies are round and touch at one point alone; then adds it. What may come past the other body meets planes with all
  // its corners, as polytopes do.
  bool met_at_one_point(int group, int p) {
    if (bodies.numbers[NUMBERS_OF_A_PAIR * p + 13] == 0) return false;
    const T within = moves(group, p);
    RoundPair<T> pair;
    Sought<T> found;
    round_pair(p, pair);
    seek(pair, found);
    if (!found.alone || held_apart(pair, found.gap, within)) return false;
    if (found.gap < within) add_met(p, pair, found, true);
    return true;
  }

  // In the world.
  int round_row(int p) const { return bodies.row[p] + (bodies.numbers[NUMBERS_OF_A_PAIR * p + 11] > 0); }
  void round_pair(int p, RoundPair<T>& out) const {
    const T* numbers = bodies.numbers + NUMBERS_OF_A_PAIR * p;
    const int row = round_row(p), nodes[2] = {bodies.first[row], bodies.second[row]};
    const T *of_row = bodies.of_row + NUMBERS_OF_A_ROW * row, ball = of_row[0] * of_row[0];
    out.thin = numbers[8];
    for (int i = 0; i < 2; i++) {
      const Pose<T>& body = standing(nodes[i]);
      T form[9], half[9];
      for (int j = 0; j < 9; j++) form[j] = of_row[1 + 12 * i + j] + (i == 0 && j % 4 == 0 ? ball : T(0));
      product(body.rotation, form, half), product_transposed(half, body.rotation, out.form[i]);
      placed(body, numbers + 3 * i, out.center[i]), times(body.rotation, of_row + 10 + 12 * i, out.axis[i]);
      out.half[i] = numbers[6 + i], out.capped[i] = numbers[9 + i] > 0;
    }
  }
  void add_met(int p, const RoundPair<T>& pair, const Sought<T>& sought, bool follows) {
    Found<T>& out = found[count++];
    Spotted<T> met;
    spot(pair, sought, met), out.on_plane();
    out.row = round_row(p), out.gap = sought.gap, out.rim = true, out.follows = follows;
    const Pose<T>&over = standing(bodies.first[out.row]), &under = standing(bodies.second[out.row]);
    seen_from(over, met.center[0], out.position), seen_from(under, met.center[1], out.other);
    transposed_times(under.rotation, met.normal, out.normal);
    out.offset = dot(out.normal, out.other) + met.reach;
    for (int i = 0; i < 2; i++) out.swept[i] = met.swept[i];
  }
};

}  // namespace pbfd
