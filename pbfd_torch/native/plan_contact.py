"""Contact candidates as the C++ core sees them: index tables and numbers in the order in which src/candidates.h reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain

import torch
from torch import Tensor

from pbfd_torch.contact.surface import Plane, Surface
from pbfd_torch.native.not_compiled import unknown
from pbfd_torch.native.plane import Plane as MotionPlane
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation

# What touches what, as `each_kind` in src/kinds.h has it: candidates are sorted by these.
POINT, BALL = range(2)
KINDS = ((Plane, POINT), (Plane, BALL))


def link_frames(a: Articulation, link: Tensor) -> Tensor:
    """Where links `[n]` are on their nodes, `[n, 4, 4]`: what is fixed to a link is told to the core through these."""
    return a.link_frame[link]


@dataclass
class Candidates:
    """Of all contact terms. nodes, solids: of each candidate of each kind; rows: numbers of each contact, `[n, …]` each."""

    nodes: list[list[int]] = field(default_factory=lambda: [[] for _ in KINDS])
    solids: list[list[int]] = field(default_factory=lambda: [[] for _ in KINDS])
    rows: list[list[Sequence[Tensor]]] = field(default_factory=lambda: [[] for _ in KINDS])
    planes: list[Tensor] = field(default_factory=list)  # [4]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of src/candidates.h: candidates, planes."""
        return sum(map(len, self.nodes)), len(self.planes)

    @property
    def normals(self) -> list[Tensor]:
        """Of all half-spaces."""
        return [x[:3] for x in self.planes]

    def within(self, plane: MotionPlane) -> Candidates:
        """The same in a plane."""
        rows: list[list[Sequence[Tensor]]] = []
        for nodes, row in zip(self.nodes, self.rows, strict=True):
            left = iter(nodes)
            rows.append([(plane.on_nodes([next(left) for _ in x[0]], x[0]), *x[1:]) for x in row])
        planes = [torch.cat((x[:3] @ plane.basis, x[3:])) for x in self.planes]
        return Candidates(self.nodes, self.solids, rows, planes)

    def whole(self) -> list[int]:
        """The index tables."""
        return [*map(len, self.nodes), *chain(*self.nodes), *chain(*self.solids)]

    def real(self) -> Sequence[Tensor]:
        """The numbers."""
        rows = [row for kind in self.rows for row in kind]
        return [*(torch.cat([x.reshape(-1) for x in column]) for column in zip(*rows, strict=True)), *self.planes]

    def take(self, a: Articulation, term: Contact) -> None:
        """Adds the candidates of a contact. Raises `NotCompiledError`."""
        name = term.pairs[0][1] if term.pairs else "the ground"
        law, friction = term.normal_force, term.friction
        if type(law) is not NormalForce or law.exponent != 2.0:
            raise unknown(f"normal force on '{name}' with another exponent than 2")
        if type(friction) is not CoulombFriction and friction is not None:
            raise unknown(type(friction).__name__)
        if term.restitution is not None:
            raise unknown("restitution")
        if term.position.ndim != 2 or term.radius.ndim != 1 or term.margin.ndim != 1:
            raise unknown(f"contact with '{name}' of its own for each world")
        nodes = [a.topology.link_node[link] for link in term.link.tolist()]
        moving = [i for i, node in enumerate(nodes) if node > 0]  # what rides on the world does not move
        solid = self._solid(term.surface, term, name)

        def each(value: float | Tensor | None, other: float) -> Tensor:
            number = torch.as_tensor(other if value is None else value, dtype=a.dtype)
            if number.ndim > 1:
                raise unknown(f"contact with '{name}' of its own for each world")
            return number.expand(len(nodes))

        frame = link_frames(a, term.link)
        numbers = (
            (frame[:, :3, :3] @ term.position[..., None]).squeeze(-1) + frame[:, :3, 3],
            term.radius,
            term.margin,
            each(law.stiffness, 0.0) * each(term.firm, 1.0),
            each(None if friction is None else friction.mu, 0.0) * each(term.grip, 1.0),
            each(term.deep, torch.finfo(a.dtype).max),
            each(law.release, 0.0),
            each(None if friction is None else friction.slip_speed, 1.0),
        )
        for kind, (surface, support) in enumerate(KINDS):
            some = [i for i in moving if surface is type(term.surface) and support == (BALL if term.radius[i] > 0 else POINT)]
            self.nodes[kind] += [nodes[i] - 1 for i in some]
            self.solids[kind] += [solid] * len(some)
            if some:
                self.rows[kind].append([x[torch.tensor(some)] for x in numbers])

    def _solid(self, surface: Surface, term: Contact, name: str) -> int:
        """The number of what is touched."""
        if type(surface) is not Plane or term.carrier is not None:
            raise unknown(f"contact with '{name}', which is no half-space at rest")
        if surface.normal.ndim > 2 or surface.offset.ndim > 1 or len(surface.normal.reshape(-1, 3)) > 1:
            raise unknown(f"contact with '{name}' of its own for each world")
        self.planes.append(torch.cat((surface.normal.reshape(3), surface.offset.reshape(1))))
        return len(self.planes) - 1
