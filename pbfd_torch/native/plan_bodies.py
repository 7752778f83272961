"""Contact between bodies as the C++ core sees it: index tables and numbers in the order in which src/bodies.h reads them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.contact.ball_pairs import BallBoxPairs, BallCylinderPairs, BallPairs
from pbfd_torch.contact.candidates import Finder
from pbfd_torch.contact.closest_pairs import ClosestPairs
from pbfd_torch.contact.curved_pairs import CurvedPairs
from pbfd_torch.contact.hazards import Overflow
from pbfd_torch.contact.polytope import Polytope
from pbfd_torch.contact.polytope_pairs import PolytopePairs
from pbfd_torch.contact.round_pairs import RoundPairs
from pbfd_torch.native.carriers import Carriers
from pbfd_torch.native.not_compiled import unknown
from pbfd_torch.native.plan_contact import along
from pbfd_torch.native.plan_curved import round_pair, round_table, row_of, shape_row
from pbfd_torch.native.plan_hulls import hulls
from pbfd_torch.native.plan_laws import Law, Laws
from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.tree.articulation import Articulation, homogeneous

# What the points of a row meet, and what finds them, as src/bodies.h has them.
CORNER_ON_FACE, BALL_ON_FACE, BALL_ON_PILL, BALL_ON_BLOCK, BALL_ON_DRUM, RIM_ON_FACE, ROUND_ON_ROUND = range(7)
ROUND, BALL, POLYTOPE, CURVED, CLOSEST = range(5)
NUMBERS_OF_A_PAIR, OWN_FRAMES = 14, 25


@dataclass
class Bodies:
    """Of all terms of contact between bodies.

    Attributes:
        frames: of the bodies [4, 4] on their nodes, obstacles after all links; nodes: −1: the world; obstacles that move have some
            of their own after all others. links: how many bodies are links.
        moving: the bodies that move, links first.
        kept, finders, ends: of each term how many candidates it keeps, what finds them, and how many pairs there are up to it.
        rows: of each its nodes, what meets what, its term, the place of its pair and its law (`Laws`); sizes: its numbers, `[49]`;
            laws: `[*, 8]`.
        pairs: of each its first row, its colliders, whether these are boxes, and its links; numbers: `[14]`.
        colliders: node and link of each; places: its frame there, `[12]`; polytopes.
        extents, slack: of each term. memory: where what its anchors remember begins, −1: it has none; remembered: how much in all.
    """

    frames: Tensor
    nodes: list[int]
    links: int
    moving: list[int]
    kept: list[int] = field(default_factory=list)
    finders: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=lambda: [0])
    rows: list[tuple[int, int, int, int, int, int]] = field(default_factory=list)
    sizes: list[Tensor] = field(default_factory=list)
    laws: list[Tensor] = field(default_factory=list)
    pairs: list[tuple[int, int, int, int, int, int]] = field(default_factory=list)
    numbers: list[Tensor] = field(default_factory=list)
    colliders: list[tuple[int, int]] = field(default_factory=list)
    places: list[Tensor] = field(default_factory=list)
    polytopes: list[Polytope] = field(default_factory=list)
    extents: list[Tensor] = field(default_factory=list)
    slack: list[float] = field(default_factory=list)
    memory: list[int] = field(default_factory=list)
    remembered: int = 0

    @classmethod
    def of(cls, a: Articulation, terms: Sequence[BodyContact], carriers: Carriers, laws: Laws, before: int) -> Bodies:
        """Of the terms of a scene, where other contacts remember so many numbers `before` these; adds their laws, and what carries
        their obstacles. Raises `NotCompiledError`."""
        frames, nodes = a.link_frame, [node - 1 for node in a.topology.link_node]
        obstacles = list(terms[0].obstacles) if terms else []
        eye = torch.eye(4, dtype=a.dtype)
        starts = [eye if x.motion.moves else x.start for x in obstacles]
        if terms and any(x.ndim > 2 for x in [frames[..., 0, :, :], *starts]):
            raise unknown("contact between bodies whose frames differ from world to world")
        seats = [a.topology.njoint + carriers.number(x) if x.motion.moves else -1 for x in obstacles]
        moving = [*range(len(nodes)), *(len(nodes) + k for k, seat in enumerate(seats) if seat >= 0)]
        bodies = cls(torch.cat((frames, *(x[None] for x in starts))), [*nodes, *seats], len(nodes), moving)
        for term in terms:
            bodies._take(a, term, laws, before)
        return bodies

    @property
    def size(self) -> tuple[int, ...]:
        """Of src/interface.h: links, groups, rows, pairs, colliders, slots, remembered."""
        if not self.rows:
            return 0, 0, 0, 0, 0, 0, 0
        counts = len(self.kept), len(self.rows), len(self.pairs), len(self.colliders)
        return len(self.moving), *counts, sum(self.kept), self.remembered

    @property
    def whole(self) -> list[int]:
        """The index tables."""
        if not self.rows:
            return []
        tables = [*zip(*self.rows, strict=True), *zip(*(x[:4] for x in self.pairs), strict=True)]
        links = itertools.chain(*(x[4:] for x in self.pairs))
        colliders = zip(*self.colliders, strict=True)
        whole = [*(self.nodes[x] for x in self.moving), *self.kept, *self.finders, *self.ends, *self.memory]
        return [*whole, *itertools.chain(*tables), *links, *itertools.chain(*colliders), *self._hulls[0]]

    @property
    def real(self) -> Tensor:
        """The numbers."""
        like = self.frames
        if not self.rows:
            return like.new_empty(0)
        links = [_flat(self.frames[x]) for x in self.moving]
        tables = (links, self.extents, [like.new_tensor(self.slack)], self.places, self.numbers, self.sizes)
        return torch.cat([*itertools.chain(*tables), self._hulls[1].to(like.dtype)])

    @cached_property
    def _hulls(self) -> tuple[list[int], Tensor]:
        return hulls(self.polytopes)

    def _take(self, a: Articulation, term: BodyContact, laws: Laws, before: int) -> None:
        """Adds a term."""
        if term.overflow is not Overflow.FLAG:
            raise unknown(f"overflow {term.overflow.name} of contact between bodies")
        law = Law.of(a, term, "bodies", len(term.pairs))
        group = len(self.kept)
        for first, second, kind, size, place in self._rows(term.finder):
            self.rows.append((self.nodes[first], self.nodes[second], kind, group, place, laws.number(law, place)))
            frames = (_flat(self.frames[first]), _flat(self.frames[second]))
            self.sizes.append(torch.cat((torch.nn.functional.pad(size, (0, OWN_FRAMES - len(size))), *frames)))
            belt = self._belt(term, second) - self._belt(term, first)
            some = [x[..., place, None] for x in law.numbers]
            batch = broadcast_shapes(*(x.shape[:-1] for x in some))
            self.laws.append(torch.cat([x.expand(*batch, x.shape[-1]) for x in (*some, belt)], -1))
        self.kept.append(term.finder.slots)
        anchored = isinstance(term.friction, AnchoredFriction)
        self.memory.append(before + self.remembered if anchored else -1)
        self.remembered += 7 * term.finder.slots if anchored else 0
        self.ends.append(len(self.pairs))
        self.extents.append(term.extent[self.moving])
        self.slack.append(term.slack)

    def _belt(self, term: BodyContact, body: int) -> Tensor:
        """Velocity of the running surface of a body on its node, `[3]`."""
        if body < self.links:
            return self.frames.new_zeros(3)
        return self.frames[body, :3, :3] @ term.obstacles[body - self.links].belt

    def _rows(self, finder: Finder) -> Iterator[tuple[int, int, int, Tensor, int]]:
        """Bodies, what meets what, sizes and place of the pair of each row; pairs are added on the way."""
        if isinstance(finder, RoundPairs):
            self.finders.append(ROUND)
            yield from self._round(finder)
        elif isinstance(finder, BallPairs):
            self.finders.append(BALL)
            yield from self._balls(finder)
        elif isinstance(finder, ClosestPairs):
            self.finders.append(CLOSEST)
            yield from self._closest(finder)
        elif isinstance(finder, PolytopePairs):
            self.finders.append(CURVED if isinstance(finder, CurvedPairs) else POLYTOPE)
            yield from self._polytopes(finder)
        else:
            raise unknown(type(finder).__name__)

    def _pair(self, row: int, a: int, b: int, numbers: Tensor, colliders: tuple[int, int] = (0, 0), boxes: bool = False) -> None:
        """Adds one of bodies a and b."""
        one, other = (self._number(x) for x in (a, b))
        self.pairs.append((row, *colliders, int(boxes), one, other))
        self.numbers.append(torch.nn.functional.pad(numbers, (0, NUMBERS_OF_A_PAIR - len(numbers))))

    def _number(self, body: int) -> int:
        """Which of those that move a body is, −1: it does not."""
        return self.moving.index(body) if body in self.moving else -1

    def _round(self, finder: RoundPairs) -> Iterator[tuple[int, int, int, Tensor, int]]:
        tables = (finder.pair.tolist(), finder.first.tolist(), finder.second.tolist(), finder.axes, finder.radii)
        for place, a, b, axes, radii in zip(*tables, strict=True):
            ends = torch.cat((self._placed(a, axes[:2]), self._placed(b, axes[2:])))
            half = 0.5 * torch.linalg.vector_norm(ends[3] - ends[2])
            solid = torch.stack((radii[1], half, torch.zeros_like(half), 2 * radii[1]))
            self._pair(len(self.rows), a, b, torch.cat((ends.flatten(), radii)))
            yield a, b, BALL_ON_PILL, torch.cat((radii[:1], _flat(along(ends[2], ends[3])), solid)), place

    def _balls(self, finder: BallPairs) -> Iterator[tuple[int, int, int, Tensor, int]]:
        frames = homogeneous(finder.frame[..., :3], finder.frame[..., 3])
        tables = (finder.pair.tolist(), finder.first.tolist(), finder.second.tolist(), finder.position, finder.radius, frames)
        if isinstance(finder, BallBoxPairs):
            kind, sizes = BALL_ON_BLOCK, finder.half_extents
        else:
            assert isinstance(finder, BallCylinderPairs)
            kind, sizes = BALL_ON_DRUM, torch.nn.functional.pad(finder.size, (0, 1))
        thickness = 2 * sizes[:, : 3 if kind == BALL_ON_BLOCK else 2].amin(-1)
        for place, a, b, center, radius, frame, size, thick in zip(*tables, sizes, thickness, strict=True):
            self._pair(len(self.rows), a, b, torch.cat((self._placed(a, center[None])[0], radius[None])))
            yield a, b, kind, torch.cat((radius[None], _flat(self.frames[b] @ frame), size, thick[None])), place

    def _polytopes(self, finder: PolytopePairs) -> Iterator[tuple[int, int, int, Tensor, int]]:
        """Two rows for each pair: either may give the points."""
        before, bodies = len(self.colliders), finder.body.tolist()
        for body, frame in zip(bodies, finder.frame, strict=True):
            self.colliders.append((self.nodes[body], self._number(body)))
            self.places.append(_flat(self.frames[body] @ frame))
        self.polytopes += finder.polytopes
        table, curved = finder.table, isinstance(finder, CurvedPairs)
        radius = table.radius
        tables = (finder.pair.tolist(), finder.first.tolist(), finder.second.tolist(), finder.boxes.tolist())
        for place, one, other, boxes in zip(*tables, strict=True):
            a, b = bodies[one], bodies[other]
            met, turned = round_table(finder, one, other) or (None, False) if curved else (None, False)
            numbers = radius.new_empty(0) if met is None else round_pair(met, 0, self._frames(a, b, turned), turned)
            self._pair(len(self.rows), a, b, numbers, (before + one, before + other), boxes)
            for points, first, second in ((one, a, b), (other, b, a)):
                if not table.curved[points] and (met is None or turned is (points == one)):
                    kind = BALL_ON_FACE if radius[points] > 0 else CORNER_ON_FACE
                    yield first, second, kind, radius[points, None], place
                    continue
                size = torch.cat((radius[points, None], shape_row(finder, points, self.frames[first])))
                if met is None or turned is (points == one):
                    yield first, second, RIM_ON_FACE, size, place
                else:
                    ours = row_of(met.shapes.forms[0], met.shapes.lines[0], self._frames(first, second))
                    yield first, second, ROUND_ON_ROUND, torch.cat((size, ours[12:])), place

    def _closest(self, finder: ClosestPairs) -> Iterator[tuple[int, int, int, Tensor, int]]:
        shapes = finder.table.shapes
        for k, (place, (a, b)) in enumerate(zip(finder.pair.tolist(), finder.body.tolist(), strict=True)):
            frames = self._frames(a, b)
            self._pair(len(self.rows), a, b, round_pair(finder.table, k, frames, turned=False))
            size = row_of(shapes.forms[k], shapes.lines[k], frames)
            yield a, b, ROUND_ON_ROUND, torch.nn.functional.pad(size, (1, 0)), place

    def _frames(self, a: int, b: int, turned: bool = False) -> Tensor:
        """Where two bodies are on their nodes, `[2, 4, 4]`."""
        return self.frames[[b, a] if turned else [a, b]]

    def _placed(self, body: int, points: Tensor) -> Tensor:
        """Points of a body on its node, `[n, 3]`."""
        frame = self.frames[body]
        return points @ frame[:3, :3].T + frame[:3, 3]


def _flat(frame: Tensor) -> Tensor:
    """A frame `[4, 4]` as src/bodies.h has it: rotation and position, `[12]`."""
    return torch.cat((frame[:3, :3].flatten(), frame[:3, 3]))
