// What may touch between bodies: which colliders on which nodes, and what finds them (contact/*_pairs.py). The same for all worlds.
//
// A row is a pair of colliders the one of which gives points and the other a solid, so that its two bodies are known: polytopes
// have two rows, as either may give the points. −1 for a node: the world, in whose axes its frame is then; obstacles that move are
// counted on after the nodes, and as links.
// `Bodies` walks once over two arrays that native/plan_bodies.py has written in this order: this file and that one change together.
#pragma once
#include "hulls.h"
#include "vectors.h"

namespace pbfd {

// How many there are; slots: of all groups.
struct BodySizes {
  int links = 0, groups = 0, rows = 0, pairs = 0, colliders = 0, slots = 0;
};

// What a row's points touch, and with what: planes by points or balls, and solids by balls.
enum Meeting { CORNER_ON_FACE, BALL_ON_FACE, BALL_ON_PILL, BALL_ON_BLOCK, BALL_ON_DRUM };
// Who finds the pairs of a group.
enum FinderKind { ROUND_PAIRS, BALL_PAIRS, POLYTOPE_PAIRS };

constexpr int SPOTS = 8;          // points of a row at most
constexpr int NUMBERS_OF_A_PAIR = 14;  // round ones: the ends of both axes on their nodes, and radii; a ball's centre and radius
constexpr int NUMBERS_OF_A_ROW = 17;   // radius of the points; of a solid frame [12], sizes [3], thickness
constexpr int LAWS_OF_A_ROW = 8;       // C⊥, μ, deep, 1/release, 1/width, velocity [3] of a belt on its node: + the solid's, − the points'

template <class T> struct Bodies : BodySizes {
  const int* node;         // [links]
  const int *kept, *finder, *first_pair;  // [groups], [groups], [groups + 1]: how many candidates it keeps, what it is, its pairs
  const int *first, *second, *meeting, *group, *danger;  // [rows]: nodes, what touches what, whose it is, which pair of the term's
  const int *row, *one, *other, *boxes;  // [pairs]: its first row; of polytopes, its colliders and whether both are boxes
  const int* link;  // [2 · pairs] whose colliders these are; −1: of what does not move
  const int *collider_node, *collider_link;  // [colliders]
  const T *frame, *extent, *slack;  // [12 · links] on its node, rotation and position; [groups · links], [groups] [m]
  const T *collider, *numbers, *of_row;  // [12 · colliders] on the node, see above
  Hulls<T> hulls;

  Bodies() = default;
  Bodies(BodySizes sizes, const int* ints, const T* reals) : BodySizes(sizes) {
    auto whole = [&](int count) { const int* here = ints; ints += count; return here; };
    auto real = [&](int count) { const T* here = reals; reals += count; return here; };
    node = whole(links), kept = whole(groups), finder = whole(groups), first_pair = whole(groups + 1);
    first = whole(rows), second = whole(rows), meeting = whole(rows), group = whole(rows), danger = whole(rows);
    row = whole(pairs), one = whole(pairs), other = whole(pairs), boxes = whole(pairs), link = whole(2 * pairs);
    collider_node = whole(colliders), collider_link = whole(colliders);
    frame = real(12 * links), extent = real(groups * links), slack = real(groups);
    collider = real(12 * colliders), numbers = real(NUMBERS_OF_A_PAIR * pairs), of_row = real(NUMBERS_OF_A_ROW * rows);
    hulls = {ints, reals};
  }
};

}  // namespace pbfd
