"""Contact candidates as the C++ core sees them: index tables and numbers in the order in which src/candidates.h reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import torch
from torch import Tensor

from pbfd_torch.contact.convex import ConvexSurface
from pbfd_torch.contact.distance_grid import DistanceGrid
from pbfd_torch.contact.height_field import HeightSurface
from pbfd_torch.contact.primitives import BoxSurface, CylinderSurface, SegmentSurface, SphereSurface
from pbfd_torch.contact.surface import Plane
from pbfd_torch.native.carriers import Carriers
from pbfd_torch.native.not_compiled import NotCompiledError, unknown
from pbfd_torch.native.plan_laws import Law, Laws
from pbfd_torch.native.plane import Plane as MotionPlane
from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.articulation import Articulation, homogeneous

# What touches what, as `each_kind` in src/kinds.h has it: candidates are sorted by these.
CONVEX = (SphereSurface, SegmentSurface, BoxSurface, CylinderSurface, ConvexSurface)
UNEVEN = (HeightSurface, DistanceGrid)
POINT, BALL, ELLIPSOID = range(3)
KINDS = (
    *((Plane, support) for support in (POINT, BALL, ELLIPSOID)),
    *((solid, BALL) for solid in CONVEX + UNEVEN),
    *((solid, ELLIPSOID) for solid in UNEVEN),  # on convex ones they touch as convex bodies do (terms/contact_terms.py)
)
SOLIDS = (Plane, *CONVEX, *UNEVEN)
GRIP = 4  # which of the numbers of a candidate μ is
PLANAR = 2  # of them, the first: what the core knows in a plane


def link_frames(a: Articulation, link: Tensor) -> Tensor:
    """Where links `[n]` are on their nodes, `[*, n, 4, 4]`: what is fixed to a link is told to the core through these."""
    return a.link_frame[..., link, :, :]


def on_nodes(a: Articulation, link: Tensor, points: Tensor) -> Tensor:
    """Points of links `[*, n, 3]` as they are on the nodes, `[*, n, 3]` [m]."""
    frame = link_frames(a, link)
    return (frame[..., :3, :3] @ points[..., None]).squeeze(-1) + frame[..., :3, 3]


@dataclass
class Candidates:
    """Of all contact terms.

    Attributes:
        carriers: of the obstacles that move; movers: which of them carries the solid of each candidate, −1: none.
        indices: node, solid, form, place among the anchors (−1: none) and law (`Laws`) of each candidate of each kind.
        places: of each, among the candidates of all terms, those that ride on the world too; `taken`: how many these are.
        rows: the numbers of each candidate of each kind, `[*, …]` each, as all of these that follow.
        planes: `[*, 4]`. grids: where the samples of a solid begin, and how many there are along each axis. solids: frame, sizes
            and thickness. forms: M, axis and `lying` of some, side by side.
        samples: of all grids, `[n]`.
        anchors: how many each contact has: none, or one for each candidate, those of links that ride on the world too.
        laws: of contact between bodies too.
    """

    carriers: Carriers = field(default_factory=Carriers)
    indices: list[list[tuple[int, int, int, int, int]]] = field(default_factory=lambda: [[] for _ in KINDS])
    movers: list[list[int]] = field(default_factory=lambda: [[] for _ in KINDS])
    places: list[list[int]] = field(default_factory=lambda: [[] for _ in KINDS])
    taken: int = 0
    rows: list[list[Sequence[Tensor]]] = field(default_factory=lambda: [[] for _ in KINDS])
    planes: list[Tensor] = field(default_factory=list)
    grids: list[int] = field(default_factory=list)
    solids: list[Sequence[Tensor]] = field(default_factory=list)
    forms: list[Sequence[Tensor]] = field(default_factory=list)
    samples: list[Tensor] = field(default_factory=list)
    anchors: list[int] = field(default_factory=list)
    laws: Laws = field(default_factory=Laws)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of src/candidates.h: candidates, anchors, planes, solids, samples, forms, uncommon laws."""
        samples, laws = sum(map(len, self.samples)), len(self.laws.manners)
        return sum(map(len, self.indices)), sum(self.anchors), len(self.planes), len(self.solids), samples, self._forms, laws

    @property
    def _forms(self) -> int:
        return sum(len(lying) for _, _, lying in self.forms)

    @property
    def order(self) -> tuple[int, ...]:
        """The places of all candidates, sorted."""
        return tuple(chain(*self.places))

    @property
    def carried(self) -> list[int]:
        """What carries the solid beside each, sorted."""
        return list(chain(*self.movers))

    @property
    def grips(self) -> list[Tensor]:
        """μ of each."""
        return [row[GRIP] for rows in self.rows for row in rows]

    @property
    def normals(self) -> list[Tensor]:
        """Of all half-spaces."""
        return [x[..., :3] for x in self.planes]

    @property
    def flat(self) -> bool:
        """Whether they are points and balls beside half-spaces only, without anchors."""
        return not any(self.indices[PLANAR:]) and not any(self.anchors)

    def within(self, plane: MotionPlane) -> Candidates:
        """The same in a plane, where they are `flat`."""
        rows: list[list[Sequence[Tensor]]] = []
        for indices, row in zip(self.indices, self.rows, strict=True):
            rows.append([(plane.on_nodes([node], x[0][None])[0], *x[1:]) for (node, *_), x in zip(indices, row, strict=True)])
        planes = [torch.cat((x[:3] @ plane.basis, x[3:])) for x in self.planes]
        return replace(self, indices=self.indices[:PLANAR], rows=rows, planes=planes)

    def whole(self) -> list[int]:
        """The index tables."""
        return [*map(len, self.indices), *chain(*zip(*chain(*self.indices), strict=True)), *self.grids]

    def real(self) -> Sequence[Tensor]:
        """The numbers."""
        tables = (list(chain(*self.rows)), [[x] for x in self.planes], self.solids, self.forms)
        return [x for table in tables for column in zip(*table, strict=True) for x in column]

    def take(self, a: Articulation, term: Contact, torsion: TorsionalFriction | None) -> None:
        """Adds the candidates of a contact, which may have torsional friction. Raises `NotCompiledError`."""
        name = term.pairs[0][1] if term.pairs else "the ground"
        anchored = isinstance(term.friction, AnchoredFriction)
        nodes = [a.topology.link_node[link] for link in term.link.tolist()]
        moving = torch.tensor([i for i, node in enumerate(nodes) if node > 0], dtype=torch.long)  # others ride on the world
        if len(moving) < len(nodes) and _runs(term):
            raise unknown(f"what does not move against '{name}', which does")

        law = Law.of(a, term, f"'{name}'", len(nodes), torsion)
        numbers = (term.radius, term.margin, *law.numbers)
        anchor = sum(self.anchors)
        self.anchors.append(len(nodes) if anchored else 0)
        before = self.taken
        self.taken += len(nodes)
        if len(moving) == 0:
            return
        mover = self._mover(term)
        solid, first = self._solid(a, term, name, mover >= 0), self._forms
        positions, flat = on_nodes(a, term.link, term.position), isinstance(term.surface, Plane)
        rounded = (term.radius > 0).reshape(-1, len(nodes)).any(0).tolist()  # in some world
        if isinstance(term, CurvedContact):
            if (type(term.surface), ELLIPSOID) not in KINDS:
                raise unknown(f"curved bodies on '{name}', which is a {type(term.surface).__name__}")
            self._add_forms(a, term)
        for i in moving.tolist():
            if isinstance(term, CurvedContact):
                support, form = ELLIPSOID, first + i
            else:
                support, form = (POINT if flat and not rounded[i] else BALL), 0
            kind = KINDS.index((type(term.surface), support))
            self.indices[kind].append((nodes[i] - 1, solid, form, anchor + i if anchored else -1, self.laws.number(law, i)))
            self.movers[kind].append(mover)
            self.places[kind].append(before + i)
            self.rows[kind].append([positions[..., i, :], *(x[..., i, None] for x in numbers)])

    def _mover(self, term: Contact) -> int:
        """The number of what carries the solid; −1: it stands, and so does its surface."""
        return self.carriers.number(term.carrier) if term.carrier is not None and _runs(term) else -1

    def _solid(self, a: Articulation, term: Contact, name: str, moves: bool) -> int:
        """Adds what is touched, in its own frame if that moves; its number."""
        surface = term.surface
        if type(surface) not in SOLIDS:
            raise unknown(f"contact with '{name}', which is a {type(surface).__name__}")
        frame = torch.eye(4, dtype=a.dtype) if moves or term.carrier is None else term.carrier.start
        if isinstance(surface, Plane) and (moves or term.carrier is None):
            self.planes.append(joined(_one(surface.normal, 1, name), _one(surface.offset, 0, name)))
            return len(self.planes) - 1
        grid, sizes = [0, 0, 0, 0], list[Tensor]()
        match surface:
            case SphereSurface():
                sizes = [_one(surface.radius, 0, name)]
            case SegmentSurface():
                start, end = _one(surface.start, 1, name), _one(surface.end, 1, name)
                half = 0.5 * torch.linalg.vector_norm(end - start, dim=-1, keepdim=True)
                sizes = [_one(surface.radius, 0, name), half]
                placed = along(start, end)
                if any(self.anchors[-1:]) and not bool((placed[..., :3, :3] == torch.eye(3, dtype=a.dtype)).all()):
                    raise unknown(f"anchors on '{name}', a capsule that does not lie along z")
                frame = frame @ placed
            case BoxSurface():
                sizes = [_one(surface.half_extents, 1, name)]
            case CylinderSurface():
                sizes = [_one(surface.radius, 0, name), _one(surface.half_length, 0, name)]
            case ConvexSurface():
                sizes, grid = [surface.size.reshape(1)], self._faceted(surface)
            case HeightSurface():
                sizes, grid = [surface.origin, surface.spacing], self._sampled(surface.coefficients)
            case DistanceGrid():
                sizes, grid = [surface.origin, surface.spacing.reshape(1)], self._sampled(surface.coefficients)
        self.grids += grid
        placed = joined(frame[..., :3, :3].flatten(-2), frame[..., :3, 3])
        size = torch.nn.functional.pad(known := joined(*sizes), (0, 6 - known.shape[-1]))
        self.solids.append((placed, size, torch.tensor([term.thickness], dtype=a.dtype)))
        return len(self.solids) - 1

    def _sampled(self, coefficients: Tensor) -> list[int]:
        """Adds the samples of a grid: where they begin, and how many there are along each of three axes."""
        first = sum(map(len, self.samples))
        self.samples.append(coefficients.reshape(-1))
        return [first, *coefficients.shape, 1][:4]

    def _faceted(self, surface: ConvexSurface) -> list[int]:
        """Adds the faces and edges of a hull: where they begin, and how many there are of both."""
        first = sum(map(len, self.samples))
        faces = torch.cat((surface.normals, surface.offsets[:, None]), -1)
        edges = torch.cat((surface.starts, surface.ends), -1)
        self.samples += [faces.reshape(-1), edges.reshape(-1)]
        return [first, len(faces), len(edges), 0]

    def _add_forms(self, a: Articulation, term: CurvedContact) -> None:
        turn = link_frames(a, term.link)[..., :3, :3]
        axis = (turn @ term.axis[..., None]).squeeze(-1)
        self.forms.append(((turn @ term.form @ turn.mT).flatten(-3), axis.flatten(-2), term.lying.to(term.form.dtype)))


def _runs(term: Contact) -> bool:
    """Whether the solid of a contact moves, or its surface does."""
    return term.carrier is not None and (term.carrier.motion.moves or any(term.carrier.motion.belt))


def _differing(name: str) -> NotCompiledError:
    return unknown(f"contact with '{name}' of its own for each candidate")


def _one(value: Tensor, rank: int, name: str) -> Tensor:
    """Numbers `[*, count]` that all candidates share, of a value `[*, n or 1, *event]` whose event has this rank."""
    if value.ndim > rank and value.shape[value.ndim - 1 - rank] != 1:
        raise _differing(name)
    if rank == 0:
        return value.reshape(*value.shape[:-1], 1)
    return value.squeeze(-1 - rank) if value.ndim > rank else value


def joined(*pieces: Tensor, dim: int = -1) -> Tensor:
    """Numbers `[*, n]` side by side along a dimension, counted from the end, some of them of each world."""
    batch = broadcast_shapes(*(x.shape[:dim] for x in pieces))
    return torch.cat([x.expand(*batch, *x.shape[dim:]) for x in pieces], dim)


def along(start: Tensor, end: Tensor) -> Tensor:
    """The frame `[*, 4, 4]` in the middle of a segment whose z axis lies along it."""
    eye, way = torch.eye(3, dtype=start.dtype), end - start
    way = torch.where((way != 0).any(-1, keepdim=True), way, eye[2])
    z = way / torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    y = torch.linalg.cross(z, eye[z.abs().argmin(-1)])
    y = y / torch.linalg.vector_norm(y, dim=-1, keepdim=True)
    return homogeneous(torch.stack((torch.linalg.cross(y, z), y, z), -1), 0.5 * (start + end))
