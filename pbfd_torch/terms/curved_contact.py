"""Contact of ellipsoids, and of the rims of cylinders, with one solid of the world: the point that touches moves over the body.

Which candidates of a rim count: `lying`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.polytope import half_thickness
from pbfd_torch.contact.shapes import Collider, Curved
from pbfd_torch.contact.surface import Field
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import indices
from pbfd_torch.tensors.facts import fact
from pbfd_torch.tensors.vectors import applied, rotated
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.contact import Contact, PreparedContact, seen
from pbfd_torch.terms.firmness import deepest
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.load import StepContext
from pbfd_torch.terms.lying import share_of
from pbfd_torch.terms.normal_force import NormalForce, default_stiffness
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.supported import Supported, reaching
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement
from pbfd_torch.tree.rotations import quaternion_matrix


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedCurved(PreparedContact):
    share: Tensor  # [*batch, npoint] of the normal force that each candidate gives


@dataclass(frozen=True, eq=False, kw_only=True)
class CurvedContact(Contact):
    """Ellipsoids against one solid; their `radius` is zero.

    Attributes:
        form: `[*, npoint, 3, 3]` M in the link's frame [m²], see `supported`.
        axis: `[*, npoint, 3]` in the link's frame: of the rim that a candidate belongs to.
        lying: `[npoint]` see `lying`.
    """

    form: Tensor
    axis: Tensor
    lying: Tensor

    @staticmethod
    def between(
        articulation: Articulation,
        colliders: Sequence[Collider],
        obstacle: HalfSpace | Obstacle,
        normal_force: NormalForce | None = None,
        friction: FrictionLaw | None = None,
        restitution: Restitution | None = None,
    ) -> CurvedContact:
        """As `Contact.between`, of curved colliders; `InputError` for others."""
        supports = []
        for collider in colliders:
            if not isinstance(collider.shape, Curved):
                raise InputError(f"collider '{collider.name}' is a {type(collider.shape).__name__}: must be a curved shape")
            supports.append(collider.shape.supports())
        if not supports:
            raise InputError(f"no collider can touch '{obstacle.name}': give at least one")
        each = [len(x.lying) for x in supports]
        links = [articulation.link_index(c.link) for c, n in zip(colliders, each, strict=True) for _ in range(n)]
        turns = [quaternion_matrix(torch.tensor(c.quaternion, dtype=torch.float64)).numpy() for c in colliders]

        def tensor(arrays: Sequence[Any]) -> Tensor:
            return torch.as_tensor(np.concatenate(arrays), dtype=articulation.dtype, device=articulation.device)

        margin = tensor([np.full(n, c.margin) for c, n in zip(colliders, each, strict=True)])
        places = zip(supports, turns, colliders, strict=True)
        reach = max(float(np.sqrt(x.forms.max())) + c.margin for x, c in zip(supports, colliders, strict=True))
        law = default_stiffness(articulation) if normal_force is None else normal_force
        thin = 0.5 * obstacle.thickness
        halves = [min(half_thickness(c.shape), thin) for c, n in zip(colliders, each, strict=True) for _ in range(n)]
        return CurvedContact(
            link=indices(links, articulation.device),
            position=tensor([x.centers @ turn.T + np.array(c.position) for x, turn, c in places]),
            radius=torch.zeros_like(margin),
            margin=margin,
            surface=obstacle.surface(articulation.dtype, articulation.device, reach),
            carrier=obstacle.carrier(articulation.dtype, articulation.device),
            normal_force=law,
            friction=friction,
            restitution=restitution,
            thickness=obstacle.thickness,
            deep=deepest(halves, articulation, law),
            pairs=tuple((c.name, obstacle.name) for c, n in zip(colliders, each, strict=True) for _ in range(n)),
            form=tensor([turn @ x.forms @ turn.T for x, turn in zip(supports, turns, strict=True)]),
            axis=tensor([x.axes @ turn.T for x, turn in zip(supports, turns, strict=True)]),
            lying=torch.as_tensor(np.concatenate([x.lying for x in supports]), device=articulation.device),
        )

    def take(self, worlds: Worlds) -> Self:
        """See `Contact`."""
        return replaced(super().take(worlds), form=worlds.pick(self.form, 3), axis=worlds.pick(self.axis, 2))

    @fact("radius")
    def rounded(self) -> bool:
        """Rolling matters."""
        return True

    def _forms(self, rotations: Tensor) -> Tensor:
        """M in the world on links with these rotations, `[*batch, npoint, 3, 3]`."""
        turn = rotations[..., self.link, :, :]
        return turn @ self.form @ turn.mT

    def _depth(self, field: Field, frame: Tensor | None, rotations: Tensor) -> Tensor:
        return reaching(self._forms(rotations), _out(field, frame)) + self.margin - field.distance

    def _share(self, field: Field, frame: Tensor | None, rotations: Tensor) -> Tensor:
        return share_of(self.lying, applied(rotations[..., self.link, :, :], self.axis), _out(field, frame))

    def recall(self, step: StepContext, memory: Tensor) -> PreparedCurved:
        """See `ContactLaws`."""
        prepared = super().recall(step, memory)
        field = prepared.surface.field(seen(prepared.frame, prepared.centers))
        fields = {x.name: getattr(prepared, x.name) for x in dataclasses.fields(prepared)}
        return PreparedCurved(**fields, share=self._share(field, prepared.frame, prepared.rotations))

    def pressing(self, prepared: PreparedContact) -> NormalForce:
        """See `ContactLaws`."""
        assert isinstance(prepared, PreparedCurved)
        law = super().pressing(prepared)
        return replaced(law, stiffness=law.stiffness * prepared.share)

    def touching(self, prepared: PreparedContact, placement: Placement) -> Supported:
        """See `ContactLaws`."""
        return Supported.of(super().touching(prepared, placement), self._forms(placement.poses[..., :3, :3]))

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """See `Contact`."""
        centers, frame, rotations = self._centers(placement.poses), self._frame(time), placement.poses[..., :3, :3]
        field = self.surface.field(seen(frame, centers))
        law = self._firmed
        law = replaced(law, stiffness=law.stiffness * self._share(field, frame, rotations))
        return law.energy(self._depth(field, frame, rotations)).sum(-1)


def _out(field: Field, frame: Tensor | None) -> Tensor:
    """Normals in the world."""
    return field.direction if frame is None else rotated(frame[..., :3], field.direction)
