"""All contacts of a scene: which pairs touch, and which kind of contact serves each of them.

A half-space, a height field or a mesh meets the candidate points of a collider, a sphere meets any obstacle exactly, round bodies
meet each other exactly, and everything else convex meets by `manifold`. Only the kinds that a scene needs become terms.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.ball_pairs import BallBoxPairs, BallCylinderPairs, BallPairs
from pbfd_torch.contact.candidates import Finder
from pbfd_torch.contact.closest import RoundShape
from pbfd_torch.contact.closest_pairs import ClosestPairs
from pbfd_torch.contact.curved_pairs import RIMS, CurvedPairs
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.hazards import Overflow
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.pairing import friction_between, touch
from pbfd_torch.contact.polytope import polytope_of
from pbfd_torch.contact.polytope_pairs import POINTS, PolytopePairs
from pbfd_torch.contact.round_pairs import Round, RoundPairs
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Curved, Cylinder, Point, Shape, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import indices
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.curved_body_contact import CurvedBodyContact
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.firmness import Meeting, Side, deepest, firmness, side_of
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.normal_force import NormalForce, default_stiffness
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.tree.articulation import Articulation, homogeneous
from pbfd_torch.tree.rotations import quaternion_matrix

SLOTS = 128


@dataclass(frozen=True, eq=False)
class ContactRules:
    """How contacts of a scene behave.

    Attributes:
        normal_force: Eq. 8; None: every pair is as firm as it needs to be (`firmness`).
        friction: the law for μ = 1; every pair has its own μ (`friction_between`); None: there is no friction anywhere.
        restitution: None: impacts are inelastic.
        excluded: pairs of names of links and obstacles that do not touch.
        between_links: whether links touch each other at all.
        slots: how many candidates of each kind a world keeps, ≥ 1; None: 128, or fewer where no more can be.
        overflow: what to do where more is near.
        actuators: what presses colliders together besides the weight.
    """

    normal_force: NormalForce | None = None
    friction: FrictionLaw | None = field(default_factory=lambda: CoulombFriction(1.0))
    restitution: Restitution | None = None
    excluded: Collection[tuple[str, str]] = ()
    between_links: bool = True
    slots: int | None = None
    overflow: Overflow = Overflow.FLAG
    actuators: Actuators | None = None

    def __post_init__(self) -> None:
        if self.slots is not None and self.slots < 1:
            raise InputError(f"slots is {self.slots}: must be ≥ 1, or None for as many as there can be, at most {SLOTS}")


def contact_terms(
    articulation: Articulation,
    colliders: Sequence[Collider],
    obstacles: Sequence[HalfSpace | Obstacle] = (),
    rules: ContactRules | None = None,
) -> list[Term]:
    """The contact terms of a scene, with MuJoCo's rules: links that are fixed to one another count as one; such a one touches
    neither itself nor the one that its joints join it to, unless that is fixed to the world; and nothing that is fixed to the world
    touches an obstacle. Raises `InputError` for unknown names."""
    builder = _Builder(articulation, colliders, obstacles, rules or ContactRules())
    return [*builder.with_obstacles(), *builder.between_bodies()]


@dataclass(frozen=True, eq=False)
class _Part:
    """One side of a pair: a shape, its body, and where it is in it."""

    body: int
    shape: Shape
    frame: Tensor  # [4, 4]

    @property
    def axis(self) -> Round | None:
        """As a round body, if it is one."""
        if not isinstance(self.shape, Sphere | Capsule):
            return None
        half = self.shape.half_length if isinstance(self.shape, Capsule) else 0.0
        ends = [tuple((self.frame[:3, 3] + z * self.frame[:3, 2]).tolist()) for z in (-half, half)]
        return Round(self.body, ends[0], ends[1], self.shape.radius)

    @property
    def rolling(self) -> RoundShape | None:
        """As a round body without flat caps, if it is one."""
        rim = polytope_of(self.shape).round
        return None if rim is None or isinstance(self.shape, Cylinder) else RoundShape(rim, False, self.frame)


class _Builder:
    """Sorts the pairs of a scene by what serves them."""

    def __init__(
        self,
        articulation: Articulation,
        colliders: Sequence[Collider],
        obstacles: Sequence[HalfSpace | Obstacle],
        rules: ContactRules,
    ) -> None:
        for collider in colliders:
            articulation.link_index(collider.link)
        names = [*articulation.link_names, *(x.name for x in obstacles)]
        for name in (name for pair in rules.excluded for name in pair):
            if name not in names:
                raise InputError(f"excluded pairs name '{name}': must be a link or an obstacle, of {', '.join(names)}")
        self.articulation, self.colliders, self.obstacles, self.rules = articulation, colliders, obstacles, rules
        self.normal_force = default_stiffness(articulation) if rules.normal_force is None else rules.normal_force
        self.excluded = {frozenset(pair) for pair in rules.excluded}
        nodes = articulation.topology.link_node
        self.node = [nodes[articulation.link_index(c.link)] for c in colliders]

    def with_obstacles(self) -> list[Term]:
        """Contacts of candidate points with one obstacle each."""
        terms: list[Term] = []
        for obstacle in self.obstacles:
            near = [k for k, c in enumerate(self.colliders) if self._touches(k, obstacle) and _by_points(c, obstacle)]
            for kind, curved in ((CurvedContact, True), (Contact, False)):
                if ks := [k for k in near if isinstance(self.colliders[k].shape, Curved) is curved]:
                    touching = [self.colliders[k] for k in ks]
                    contact = kind.between(
                        self.articulation, touching, obstacle, self.normal_force, self.rules.friction, self.rules.restitution
                    )
                    mu = [friction_between(c, obstacle) for c in touching for _ in range(_candidates(c))]
                    pairs = [(k, obstacle) for k in ks for _ in range(_candidates(self.colliders[k]))]
                    firm, deep = self._firm(pairs)
                    terms.append(dataclasses.replace(contact, grip=self._tensor(mu), firm=firm, deep=deep))
        return terms

    def _firm(self, pairs: Sequence[tuple[int, int | HalfSpace | Obstacle]]) -> tuple[Tensor | None, Tensor]:
        """`firm` and `deep` of pairs of a collider and another one, or an obstacle."""
        meetings = [self._meeting(k, other) for k, other in pairs]
        if self.rules.normal_force is not None:
            return None, deepest([x.half for x in meetings], self.articulation, self.normal_force)
        firm = firmness(meetings, self.articulation, self.normal_force)
        return firm, self._tensor([x.deepest for x in meetings])

    def _meeting(self, k: int, other: int | HalfSpace | Obstacle) -> Meeting:
        one = self._sides[k]
        strongest = max((x.force for x in self._sides if x.held), default=0.0)
        if isinstance(other, int):
            both = self._sides[other]
            between = max(one.force, both.force)
            return Meeting(min(one.half, both.half), one.ball or both.ball, max(between, strongest), between)
        return Meeting(min(one.half, 0.5 * other.thickness), one.ball, strongest, one.force)

    @cached_property
    def _sides(self) -> Sequence[Side]:
        a, actuators = self.articulation, self.rules.actuators
        efforts = [0.0] * a.nv if actuators is None else actuators.efforts(a)
        return [side_of(a, efforts, a.link_index(c.link), c.shape, float(_extent(self._part(c)))) for c in self.colliders]

    def _touches(self, k: int, obstacle: HalfSpace | Obstacle) -> bool:
        """Whether a collider may meet an obstacle."""
        collider = self.colliders[k]
        return bool(self.node[k]) and touch(collider, obstacle) and not self._apart(collider.link, obstacle.name)

    def _apart(self, one: str, other: str) -> bool:
        return frozenset((one, other)) in self.excluded

    def _tensor(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=self.articulation.dtype, device=self.articulation.device)

    def between_bodies(self) -> list[Term]:
        """Contacts between links, and of links with obstacles that are convex, one term for each kind of finder."""
        solids = [x for x in self.obstacles if isinstance(x, Obstacle) and isinstance(x.shape, Shape)]
        parts = [self._part(c) for c in self.colliders]
        links = self.articulation.nlink
        shapes = [x.shape for x in solids if isinstance(x.shape, Shape)]
        parts += [_Part(links + k, shape, torch.eye(4, dtype=torch.float64)) for k, shape in enumerate(shapes)]
        pairs = [*self._link_pairs(), *self._obstacle_pairs(solids)]
        mu = self._tensor([friction_between(self._touchable(a, solids), self._touchable(b, solids)) for a, b in pairs])
        count = len(self.colliders)
        firm = self._firm([(a, b if b < count else solids[b - count]) for a, b in pairs]) if pairs else (None, None)
        names = tuple((self.colliders[a].name, self._touchable(b, solids).name) for a, b in pairs)
        extent = torch.zeros(links + len(solids), dtype=torch.float64)
        for part in parts:
            extent[part.body] = torch.maximum(extent[part.body], _extent(part))
        carriers = tuple(x.carrier(self.articulation.dtype, self.articulation.device) for x in solids)
        return [
            (CurvedBodyContact if isinstance(finder, ClosestPairs | CurvedPairs) else BodyContact)(
                finder=finder,
                obstacles=carriers,
                extent=extent.to(mu),
                grip=mu,
                pairs=names,
                firm=firm[0],
                deep=firm[1],
                overflow=self.rules.overflow,
                normal_force=self.normal_force,
                friction=self.rules.friction,
                restitution=self.rules.restitution,
            )
            for finder in self._finders(parts, pairs)
        ]

    def _part(self, collider: Collider) -> _Part:
        turn = quaternion_matrix(torch.tensor(collider.quaternion, dtype=torch.float64))
        frame = homogeneous(turn, torch.tensor(collider.position, dtype=torch.float64))
        return _Part(self.articulation.link_index(collider.link), collider.shape, frame)

    def _touchable(self, k: int, solids: Sequence[Obstacle]) -> Collider | Obstacle:
        return self.colliders[k] if k < len(self.colliders) else solids[k - len(self.colliders)]

    def _link_pairs(self) -> list[tuple[int, int]]:
        """Colliders of links that may meet."""
        if not self.rules.between_links:
            return []
        found = []
        for a, b in itertools.combinations(range(len(self.colliders)), 2):
            one, other = self.colliders[a], self.colliders[b]
            joined = self._joined(self.node[a], self.node[b])
            if not joined and touch(one, other) and not self._apart(one.link, other.link) and _solid(one, other):
                found.append((a, b))
        return found

    def _joined(self, node: int, beside: int) -> bool:
        """Whether the links on two nodes are fixed to one another, or joined by the joints of one link."""
        if node == beside:
            return True
        return bool(node and beside) and (self._carrier[node] == beside or self._carrier[beside] == node)

    @cached_property
    def _carrier(self) -> dict[int, int]:
        """The node of the link that each link's joints join it to: those between belong to joints of the same link."""
        t = self.articulation.topology
        parent, carrying = (0, *t.joint_parent), {0, *t.link_node}

        def below(node: int) -> int:
            return node if node in carrying else below(parent[node])

        return {node: below(parent[node]) for node in carrying}

    def _obstacle_pairs(self, solids: Sequence[Obstacle]) -> list[tuple[int, int]]:
        """Colliders and convex obstacles that `with_obstacles` leaves out."""
        return [
            (a, len(self.colliders) + k)
            for k, solid in enumerate(solids)
            for a, collider in enumerate(self.colliders)
            if self._touches(a, solid) and not _by_points(collider, solid)
        ]

    def _slots(self, most: int) -> int:
        return min(most, SLOTS) if self.rules.slots is None else self.rules.slots

    def _finders(self, parts: Sequence[_Part], pairs: Sequence[tuple[int, int]]) -> list[Finder]:
        like = torch.zeros((), dtype=self.articulation.dtype, device=self.articulation.device)
        rounds: list[tuple[int, Round, Round]] = []
        balls: dict[type[Shape], list[tuple[int, _Part, _Part]]] = {Box: [], Cylinder: []}
        closest: list[tuple[int, tuple[int, RoundShape], tuple[int, RoundShape]]] = []
        others: list[tuple[int, int, int]] = []
        for k, (a, b) in enumerate(pairs):
            one, other = parts[a], parts[b]
            axes = one.axis, other.axis
            if axes[0] is not None and axes[1] is not None:
                rounds.append((k, axes[0], axes[1]))
            elif isinstance(one.shape, Sphere) and type(other.shape) in balls:
                balls[type(other.shape)].append((k, one, other))
            elif isinstance(other.shape, Sphere) and type(one.shape) in balls:
                balls[type(one.shape)].append((k, other, one))
            elif (first := one.rolling) is not None and (second := other.rolling) is not None:
                closest.append((k, (one.body, first), (other.body, second)))
            else:
                others.append((k, a, b))
        finders: list[Finder] = []
        if rounds:
            finders.append(RoundPairs.of(rounds, self._slots(3 * len(rounds)), like))
        finders += [_balls(some, self._slots(len(some)), like) for some in balls.values() if some]
        if closest:
            finders.append(ClosestPairs.of(closest, self._slots(len(closest)), like))
        if others:
            used = sorted({x for _, a, b in others for x in (a, b)})
            place = {x: k for k, x in enumerate(used)}
            # all in one term: what a term costs besides its candidates counts for more than what a round one costs
            curved = any(isinstance(parts[x].shape, Curved) for x in used)
            kind, points = (CurvedPairs, POINTS + RIMS) if curved else (PolytopePairs, POINTS)
            finders.append(
                kind.of(
                    [(k, place[a], place[b]) for k, a, b in others],
                    [parts[x].body for x in used],
                    torch.stack([parts[x].frame for x in used]).to(like),
                    [polytope_of(parts[x].shape) for x in used],
                    [isinstance(parts[x].shape, Box) for x in used],
                    self._slots(points * len(others)),
                )
            )
        return finders


def _by_points(collider: Collider, obstacle: HalfSpace | Obstacle) -> bool:
    """Whether candidate points of the collider say all there is to say about its contact with the obstacle."""
    return isinstance(obstacle, HalfSpace) or not isinstance(obstacle.shape, Shape) or isinstance(collider.shape, Sphere | Point)


def _candidates(collider: Collider) -> int:
    """How many a collider has against one obstacle."""
    shape = collider.shape
    return len(shape.supports().lying) if isinstance(shape, Curved) else len(shape.candidates()[1])


def _solid(one: Collider, other: Collider) -> bool:
    """Single points do not meet each other."""
    return not (isinstance(one.shape, Point) or isinstance(other.shape, Point))


def _extent(part: _Part) -> Tensor:
    """Distance from the body's origin to the farthest point of the shape."""
    points, radii = part.shape.candidates()
    places = torch.from_numpy(points) @ part.frame[:3, :3].T + part.frame[:3, 3]
    return (torch.linalg.vector_norm(places, dim=-1) + torch.from_numpy(np.asarray(radii))).max()


def _balls(balls: Sequence[tuple[int, _Part, _Part]], slots: int, like: Tensor) -> BallPairs:
    """Of spheres beside solids that are all boxes or all cylinders."""
    solids = [solid.shape for _, _, solid in balls]
    common = (
        indices([k for k, _, _ in balls], like.device),
        indices([ball.body for _, ball, _ in balls], like.device),
        indices([solid.body for _, _, solid in balls], like.device),
        torch.stack([ball.frame[:3, 3] for _, ball, _ in balls]).to(like),
        like.new_tensor([ball.shape.radius for _, ball, _ in balls if isinstance(ball.shape, Sphere)]),
        torch.stack([solid.frame[:3] for _, _, solid in balls]).to(like),
    )
    if isinstance(solids[0], Box):
        half = [x.half_extents for x in solids if isinstance(x, Box)]
        return BallBoxPairs(*common, half_extents=like.new_tensor(half), slots=slots)
    size = [(x.radius, x.half_length) for x in solids if isinstance(x, Cylinder)]
    return BallCylinderPairs(*common, size=like.new_tensor(size), slots=slots)
