"""Contact of candidate points with one solid of the world: a half-space or an obstacle, still or in prescribed motion.

A candidate is a centre fixed in a link, a radius ρ ≥ 0 and a margin δ ≥ 0; `touching` has the formulas.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Carrier, Obstacle
from pbfd_torch.contact.polytope import half_thickness
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.contact.surface import Field, Surface, Tangent
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import indices
from pbfd_torch.tensors.facts import fact
from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.tensors.vectors import applied, cross, extended, mapped, outer, rotated
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.contact_laws import ContactLaws, Prepared
from pbfd_torch.terms.contact_outlook import contact_outlook
from pbfd_torch.terms.firmness import deepest
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.grouping import belonging, summed
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.terms.normal_force import NormalForce, default_stiffness
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.touching import ContactForce, Touching
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Motion, Placement
from pbfd_torch.tree.rotations import quaternion_matrix, rotation_log


@dataclass(frozen=True, eq=False)
class PreparedContact(Prepared):
    centers: Tensor  # [*batch, npoint, 3] where the solid has carried the centres of the start by the end of the step
    rotations: Tensor  # [*batch, nlink, 3, 3] the links' at the start, carried likewise
    frame: Tensor | None  # [*batch, 1, 3, 4] the solid's at the end of the step; None: the world's
    anchor: Tensor | None  # [*batch, npoint, 3] what the anchors are behind by, in world axes at the end of the step
    surface: Surface  # the solid, or what stands for it in this step


@dataclass(frozen=True, eq=False)
class Contact(ContactLaws[PreparedContact]):
    """Candidates against one solid, which act by `ContactLaws`.

    Attributes:
        link: `[npoint]` index of the link that carries each candidate.
        position: `[*, npoint, 3]` centre in the link's frame [m].
        radius: `[*, npoint]` [m] ≥ 0.
        margin: `[*, npoint]` [m] ≥ 0: skin in which the force sets in already.
        surface: the solid, in its own frame.
        carrier: where that frame is; None: the world's.
        grip: what the friction law is multiplied by, `[*, npoint]`: the μ of every candidate for a law whose own is 1; None: 1.
        thickness: of a convex solid [m]; candidates that may come past its middle in one step meet its tangent plane instead.
    """

    link: Tensor
    position: Tensor
    radius: Tensor
    margin: Tensor
    surface: Surface
    carrier: Carrier | None
    grip: Tensor | None = None
    thickness: float = math.inf

    @staticmethod
    def between(
        articulation: Articulation,
        colliders: Sequence[Collider],
        obstacle: HalfSpace | Obstacle,
        normal_force: NormalForce | None = None,
        friction: FrictionLaw | None = None,
        restitution: Restitution | None = None,
    ) -> Contact:
        """All candidates of the colliders against the obstacle. Without a normal force C⊥ is that of `default_stiffness`. Raises
        `InputError` for an unknown link or no candidate at all."""
        links: list[int] = []
        centers, radii, margins = [], [], []
        pairs: list[tuple[str, str]] = []
        halves: list[float] = []
        for collider in colliders:
            points, radius = collider.shape.candidates()
            turn = quaternion_matrix(torch.tensor(collider.quaternion, dtype=torch.float64)).numpy()
            links += [articulation.link_index(collider.link)] * len(points)
            centers.append(points @ turn.T + np.array(collider.position))
            radii.append(radius)
            margins.append(np.full(len(points), collider.margin))
            pairs += [(collider.name, obstacle.name)] * len(points)
            halves += [min(half_thickness(collider.shape), 0.5 * obstacle.thickness)] * len(points)
        if not links:
            raise InputError(f"no collider can touch '{obstacle.name}': give at least one")

        law = default_stiffness(articulation) if normal_force is None else normal_force
        reach = float((np.concatenate(radii) + np.concatenate(margins)).max())

        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(values, dtype=articulation.dtype, device=articulation.device)

        return Contact(
            link=indices(links, articulation.device),
            position=tensor(np.concatenate(centers)),
            radius=tensor(np.concatenate(radii)),
            margin=tensor(np.concatenate(margins)),
            surface=obstacle.surface(articulation.dtype, articulation.device, reach),
            carrier=obstacle.carrier(articulation.dtype, articulation.device),
            normal_force=law,
            friction=friction,
            restitution=restitution,
            deep=deepest(halves, articulation, law),
            pairs=tuple(pairs),
            thickness=obstacle.thickness,
        )

    def __post_init__(self) -> None:
        zero = torch.zeros_like(self.radius)[None]
        count = len(self.link)
        try:
            shape = self.normal_force.force(zero)[0].shape
            if self.friction is not None:
                shape = broadcast_shapes(shape, self.friction.drag(zero, zero, zero, torch.ones_like(zero)).shape)
        except RuntimeError as error:
            raise InputError(
                f"a parameter of the normal force or the friction does not fit the {count} candidates: must be one number or end "
                f"in ({count},), or (1,) where each world has its own: {error}"
            ) from error
        if shape[-1] != count:
            raise InputError(
                f"a parameter of the normal force or the friction has {shape[-1]} entries for {count} candidates: must be one "
                f"number or end in ({count},), or (1,) where each world has its own"
            )
        _ = self.rounded  # found here, so that no step has to wait for it

    @fact("radius")
    def rounded(self) -> bool:
        """Whether any candidate has a radius, so that rolling matters."""
        return bool((self.radius > 0).any())

    def _centers(self, poses: Tensor) -> Tensor:
        return mapped(self._of_links(poses[..., :3, :]), self.position)

    def _of_links(self, matrices: Tensor) -> Tensor:
        """To each candidate what its link has, `[*, nlink, r, c] → [*, npoint, r, c]`."""
        return matrices[..., self.link, :, :]

    def memory(self, batch: tuple[int, ...]) -> Tensor:
        """What the anchors are behind by in the solid's frame at a fresh start, `[*batch, npoint, 3]`; without anchors nothing,
        `[*batch, 0, 3]`."""
        return self.position.new_zeros((*batch, len(self.link) if self._anchors else 0, 3))

    def recall(self, step: StepContext, memory: Tensor) -> PreparedContact:
        """See `ContactLaws`."""
        dt = step.dt[..., None]
        centers, rotations = self._centers(step.previous.poses), step.previous.poses[..., :3, :3]
        frame = None
        if self.carrier is not None:
            before, after = (self.carrier.pose(time) for time in (step.time, step.time + step.dt))
            frame = after[..., None, :3, :]
            if self.carrier.motion.moves:
                turn = after[..., :3, :3] @ before[..., :3, :3].mT
                shift = after[..., :3, 3] - applied(turn, before[..., :3, 3])
                centers = mapped(torch.cat((turn, shift[..., None]), -1)[..., None, :, :], centers)
                rotations = turn[..., None, :, :] @ rotations
            centers = centers + dt[..., None] * (frame[..., :3] @ self.carrier.belt[:, None]).squeeze(-1)
        anchor = None
        if self._anchors:
            anchor = memory if frame is None else rotated(frame[..., :3], memory)
        surface = self.surface
        free = functools.cache(lambda: self._centers(step.target_poses))
        if math.isfinite(self.thickness):
            moves = torch.linalg.vector_norm(free() - centers, dim=-1)
            surface = Tangent.before(surface, seen(frame, centers), moves, moves, self.thickness)

        def gap(points: Tensor, rotations: Tensor) -> Tensor:
            return -self._depth(surface.field(seen(frame, points)), frame, rotations)

        depth, bounce = self._beginning(
            dt,
            lambda: gap(centers, rotations),
            lambda: gap(free(), step.target_poses[..., :3, :3]),
            lambda: gap(self._centers(step.coasting_poses), step.coasting_poses[..., :3, :3]),
        )
        return PreparedContact(
            centers,
            rotations,
            frame,
            anchor,
            surface,
            dt=dt,
            grip=self._gripping(self.grip, self.firm),
            firm=self.firm,
            deep=self.deep,
            depth=depth,
            bounce=bounce,
        )

    def depths(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """See `ContactLaws`."""
        field = prepared.surface.field(seen(prepared.frame, self._centers(placement.poses)))
        return self._depth(field, prepared.frame, placement.poses[..., :3, :3])

    def carried(self, prepared: PreparedContact, links: Tensor) -> Tensor:
        """See `ContactLaws`."""
        return links[..., self.link]

    def numbers(self, prepared: PreparedContact) -> Tensor:
        """See `ContactLaws`."""
        return torch.arange(len(self.link), device=self.link.device)

    def remembered(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """What the anchors are behind by after a step that ended at a placement; shapes as in `memory`."""
        if not self._anchors:
            return prepared.centers.new_zeros((*prepared.centers.shape[:-2], 0, 3))  # a view would keep all of them
        at = self.touching(prepared, placement)
        kept = self._anchors.kept(at.slip, at.depth)
        return kept if prepared.frame is None else rotated(prepared.frame[..., :3].mT, kept)

    def take(self, worlds: Worlds) -> Self:
        """The same contact with the values of some worlds."""
        return replaced(
            super().take(worlds),
            position=worlds.pick(self.position, 2),
            radius=worlds.pick(self.radius, 1),
            margin=worlds.pick(self.margin, 1),
            grip=worlds.pick(self.grip, 1),
            surface=self.surface.take(worlds),
            carrier=None if self.carrier is None else self.carrier.take(worlds),
        )

    def _depth(self, field: Field, frame: Tensor | None, rotations: Tensor) -> Tensor:
        """Of centres in the field of the solid in its frame, on links with these rotations, `[*batch, npoint]` [m]."""
        return self.radius + self.margin - field.distance

    def touching(self, prepared: PreparedContact, placement: Placement) -> Touching:
        """See `ContactLaws`."""
        centers, frame = self._centers(placement.poses), prepared.frame
        field = prepared.surface.field(seen(frame, centers))
        normal, bend = field.direction, None if field.flat else lambda: field.bend
        if frame is not None:
            normal = rotated(frame[..., :3], normal)
            bend = None if field.flat else lambda: frame[..., :3] @ field.bend @ frame[..., :3].mT
        depth, moved = prepared.raised(self._depth(field, frame, placement.poses[..., :3, :3])), centers - prepared.centers
        if prepared.anchor is not None:
            moved = moved + prepared.anchor
        radius = turn = None
        if self.rounded:
            radius = self.radius
            turn = rotation_log(placement.poses[..., :3, :3] @ prepared.rotations.mT)[..., self.link, :]
        return Touching(centers, normal, depth, moved, radius, turn, bend, field.steepness)

    def load(self, prepared: PreparedContact, placement: Placement) -> LinkLoad:
        contact = self.force(prepared, placement)
        on = belonging(self.link, placement.poses.shape[-3], contact.force)
        moment = -summed(on, outer(contact.force, extended(contact.at.points)))
        outlook = functools.partial(self._outlook, contact)
        return LinkLoad(moment, lambda: summed(on, contact.stiffness()), outlook=outlook)

    def _outlook(self, contact: ContactForce, motion: Motion) -> Callable[[Tensor], Tensor]:
        velocity = mapped(self._of_links(motion.rates), self.position)
        acceleration = mapped(self._of_links(motion.accelerations), self.position)
        if self.rounded:  # as in the slip: the surface moves by φ × s beside its centre
            out = contact.at.centers - contact.at.points
            spin = motion.twists[..., self.link, :3]
            velocity = velocity - cross(spin, out)
            acceleration = acceleration - cross(motion.drifts[..., self.link, :3], out)
            if (bulge := contact.at.bulge(spin)) is not None:
                acceleration = acceleration - bulge[..., None] * contact.at.normal
        return contact_outlook(contact, velocity, acceleration)

    def _frame(self, time: Tensor) -> Tensor | None:
        """The solid's `[*batch, 1, 3, 4]` at a time `[*batch]` [s]; None: the world's."""
        return None if self.carrier is None else self.carrier.pose(time)[..., None, :3, :]

    def depth(self, placement: Placement, time: Tensor | None = None) -> Tensor:
        """Penetration depth of every candidate [m] `[*batch, npoint]`, < 0 where apart, from the solid as it stands at `time`
        `[*batch]` [s], or at the start."""
        centers, frame = self._centers(placement.poses), self._frame(placement.q.new_zeros(()) if time is None else time)
        return self._depth(self.surface.field(seen(frame, centers)), frame, placement.poses[..., :3, :3])

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Energy stored by the normal force [J] `[*batch]` (Eq. 9)."""
        return self._firmed.energy(self.depth(placement, time)).sum(-1)

    @property
    def _firmed(self) -> NormalForce:
        law = self.normal_force
        return law if self.firm is None else replaced(law, stiffness=law.stiffness * self.firm)


def seen(frame: Tensor | None, points: Tensor) -> Tensor:
    """World points in a frame `[*batch, 1, 3, 4]`, or themselves."""
    return points if frame is None else rotated(frame[..., :3].mT, points - frame[..., 3])
