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

// How many there are; slots: of all groups; remembered: numbers that anchors remember.
struct BodySizes {
  int links = 0, groups = 0, rows = 0, pairs = 0, colliders = 0, slots = 0, remembered = 0;
};

// What a row's points touch, and with what: planes by points or balls, and solids by balls; from CURVED on, where curved bodies give
// the points, planes by ellipsoids and what holds these, and there also where round bodies come closest.
enum Meeting { CORNER_ON_FACE, BALL_ON_FACE, BALL_ON_PILL, BALL_ON_BLOCK, BALL_ON_DRUM, RIM_ON_FACE, ROUND_ON_ROUND };
constexpr int CURVED = RIM_ON_FACE;
// Who finds the pairs of a group.
enum FinderKind { ROUND_PAIRS, BALL_PAIRS, POLYTOPE_PAIRS, CURVED_PAIRS, CLOSEST_PAIRS };

constexpr int RIMS = 2;                // of a curved body at most
constexpr int SPOTS = 8 + RIMS;        // points of a row at most
// Round ones: the ends of both axes on their nodes, and radii; a ball's centre and radius; of shapes that may touch where they come
// closest the centres on their nodes, half lengths, half the thickness of the thinner one, whether they have flat caps, whether the
// second one gives the point, the radii around both together, and 1 for such a pair, else 0 (closest.h).
constexpr int NUMBERS_OF_A_PAIR = 14;
// Radius of the points; of a solid frame [12], sizes [3], thickness; of curved bodies the form [9] of what gives the points and its
// axis [3] on its node, and the same of the other one where it is round; from the 25th on frames [12] of both bodies on their nodes.
constexpr int OWN_FRAMES = 25, NUMBERS_OF_A_ROW = 49;
constexpr int NUMBERS_OF_AN_ANCHOR = 7;  // what it is behind by [3], where its point is [3], in the bodies' own frames; its pair
constexpr int LAWS_OF_A_ROW = 8;       // C⊥, μ, deep, 1/release, 1/width, velocity [3] of a belt on its node: + the solid's, − the points'

template <class T> struct Bodies : BodySizes {
  const int* node;         // [links]
  const int *kept, *finder, *first_pair;  // [groups], [groups], [groups + 1]: how many candidates it keeps, what it is, its pairs
  const int* memory;  // [groups] where what anchors remember of it begins among all that is remembered; −1: it has none
  const int *first, *second, *meeting, *group, *danger;  // [rows]: nodes, what touches what, whose it is, which pair of the term's
  const int* law;  // [rows], as of candidates.h
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
    node = whole(links), kept = whole(groups), finder = whole(groups), first_pair = whole(groups + 1), memory = whole(groups);
    first = whole(rows), second = whole(rows), meeting = whole(rows), group = whole(rows), danger = whole(rows), law = whole(rows);
    row = whole(pairs), one = whole(pairs), other = whole(pairs), boxes = whole(pairs), link = whole(2 * pairs);
    collider_node = whole(colliders), collider_link = whole(colliders);
    frame = real(12 * links), extent = real(groups * links), slack = real(groups);
    collider = real(12 * colliders), numbers = real(NUMBERS_OF_A_PAIR * pairs), of_row = real(NUMBERS_OF_A_ROW * rows);
    hulls = {ints, reals};
  }
};

}  // namespace pbfd
