"""Contact of candidate points with one solid of the world: a half-space or an obstacle, still or in prescribed motion.

A candidate is a centre fixed in a link, a radius ρ ≥ 0 and a margin δ ≥ 0; `touching` has the formulas.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Carrier, Obstacle
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.contact.surface import Surface, Tangent
from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact_outlook import contact_outlook
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.grouping import Grouping
from pbfd_torch.terms.inertia import inertia_stiffness
from pbfd_torch.terms.lagged_friction import lagged_law, widened_law
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.terms.normal_force import NormalForce, default_stiffness
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.touching import ContactForce, Touching, arm, cross, extended, mapped, turned
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Motion, Placement
from pbfd_torch.tree.rotations import quaternion_matrix, rotation_log


@dataclass(frozen=True, eq=False)
class PreparedContact:
    dt: Tensor  # [*batch, 1]
    centers: Tensor  # [*batch, npoint, 3] where the solid has carried the centres of the start by the end of the step
    rotations: Tensor  # [*batch, nlink, 3, 3] the links' at the start, carried likewise
    frame: Tensor | None  # [*batch, 1, 3, 4] the solid's at the end of the step; None: the world's
    anchor: Tensor | None  # [*batch, npoint, 3] what the anchors are behind by, in world axes at the end of the step
    surface: Surface  # the solid, or what stands for it in this step
    bounce: Tensor | None = None  # [*batch, npoint] how far the surface is moved out to throw a candidate back
    start: Tensor | None = None  # [*batch, npoint] how deep the candidates were, where the normal force lets go


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """What the contacts of one placement look like, for records and pictures.

    Attributes: `point` `[*, n, 3]` where the force acts [m]; `depth` `[*, n]` > 0 inside the obstacle [m]; `normal` `[*, n, 3]`;
    `force` `[*, n, 3]` on the body [N]; `slip` `[*, n, 3]` over the step [m]."""

    point: Tensor
    depth: Tensor
    normal: Tensor
    force: Tensor
    slip: Tensor


@dataclass(frozen=True, eq=False)
class Contact:
    """Candidates against one solid.

    Attributes:
        link: `[npoint]` index of the link that carries each candidate.
        position: `[*, npoint, 3]` centre in the link's frame [m].
        radius: `[*, npoint]` [m] ≥ 0.
        margin: `[*, npoint]` [m] ≥ 0: skin in which the force sets in already.
        surface: the solid, in its own frame.
        carrier: where that frame is; None: the world's.
        normal_force: Eq. 8.
        friction: the tangential law, or None for a frictionless contact.
        grip: what the law is multiplied by, `[*, npoint]`: the μ of every candidate for a law whose own is 1; None: 1.
        restitution: how much of the speed of an impact comes back; None: nothing.
        thickness: of a convex solid [m]; candidates that may come past its middle in one step meet its tangent plane instead.
        names: the collider that each candidate belongs to.
    """

    link: Tensor
    position: Tensor
    radius: Tensor
    margin: Tensor
    surface: Surface
    carrier: Carrier | None
    normal_force: NormalForce
    friction: FrictionLaw | None
    grip: Tensor | None = None
    restitution: Restitution | None = None
    thickness: float = math.inf
    names: tuple[str, ...] = ()

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
        names: list[str] = []
        for collider in colliders:
            points, radius = collider.shape.candidates()
            turn = quaternion_matrix(torch.tensor(collider.quaternion, dtype=torch.float64)).numpy()
            links += [articulation.link_index(collider.link)] * len(points)
            centers.append(points @ turn.T + np.array(collider.position))
            radii.append(radius)
            margins.append(np.full(len(points), collider.margin))
            names += [collider.name] * len(points)
        if not links:
            raise InputError(f"no collider can touch '{obstacle.name}': give at least one")

        reach = float((np.concatenate(radii) + np.concatenate(margins)).max())

        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(values, dtype=articulation.dtype, device=articulation.device)

        return Contact(
            link=torch.tensor(links, dtype=torch.long, device=articulation.device),
            position=tensor(np.concatenate(centers)),
            radius=tensor(np.concatenate(radii)),
            margin=tensor(np.concatenate(margins)),
            surface=obstacle.surface(articulation.dtype, articulation.device, reach),
            carrier=obstacle.carrier(articulation.dtype, articulation.device),
            normal_force=default_stiffness(articulation) if normal_force is None else normal_force,
            friction=friction,
            restitution=restitution,
            thickness=obstacle.thickness,
            names=tuple(names),
        )

    def __post_init__(self) -> None:
        zero = torch.zeros_like(self.radius)[None]
        count = len(self.link)
        try:
            shape = self.normal_force.force(zero)[0].shape
            if self.friction is not None:
                shape = torch.broadcast_shapes(shape, self.friction.drag(zero, zero, zero, torch.ones_like(zero)).shape)
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

    @cached_property
    def rounded(self) -> bool:
        """Whether any candidate has a radius, so that rolling matters."""
        return bool((self.radius > 0).any())

    @cached_property
    def _grouping(self) -> Grouping:
        return Grouping(self.link)

    def _centers(self, placement: Placement) -> Tensor:
        return self._grouping.mapped(placement.poses, self.position)

    def prepare(self, step: StepContext) -> PreparedContact:
        return self.recall(step, self.memory(()))

    def memory(self, batch: tuple[int, ...]) -> Tensor:
        """What the anchors are behind by in the solid's frame at a fresh start, `[*batch, npoint, 3]`; without anchors nothing,
        `[*batch, 0, 3]`."""
        count = len(self.link) if isinstance(self.friction, AnchoredFriction) else 0
        return self.position.new_zeros((*batch, count, 3))

    def recall(self, step: StepContext, memory: Tensor) -> PreparedContact:
        """`prepare` with what the anchors were behind by at the end of the last step."""
        dt = step.dt[..., None]
        centers, rotations = self._centers(step.previous), step.previous.poses[..., :3, :3]
        frame = None
        if self.carrier is not None:
            before, after = (self.carrier.pose(time) for time in (step.time, step.time + step.dt))
            frame = after[..., None, :3, :]
            if self.carrier.motion.moves:
                turn = after[..., :3, :3] @ before[..., :3, :3].mT
                shift = after[..., :3, 3] - (turn @ before[..., :3, 3:]).squeeze(-1)
                centers = mapped(torch.cat((turn, shift[..., None]), -1)[..., None, :, :], centers)
                rotations = turn[..., None, :, :] @ rotations
            centers = centers + dt[..., None] * (frame[..., :3] @ self.carrier.belt[:, None]).squeeze(-1)
        anchor = None
        if isinstance(self.friction, AnchoredFriction):
            anchor = memory if frame is None else turned(frame[..., :3], memory)
        prepared = PreparedContact(dt, centers, rotations, frame, anchor, self.surface)
        free = functools.partial(self._grouping.mapped, step.target_poses, self.position)
        if math.isfinite(self.thickness):
            moves = torch.linalg.vector_norm(free() - centers, dim=-1)
            tangent = Tangent.before(self.surface, _seen(frame, centers), moves, self.thickness)
            prepared = dataclasses.replace(prepared, surface=tangent)
        if self.restitution is None and math.isinf(self.normal_force.release):
            return prepared
        start, bounce = self._at(prepared, centers, None).depth, None
        if self.restitution is not None:
            coasting = self._grouping.mapped(step.coasting_poses, self.position)
            gaps = [-self._at(prepared, points, None).depth for points in (free(), coasting)]
            bounce = self.restitution.bounce(-start, gaps[0], dt, gaps[1])
        return dataclasses.replace(prepared, bounce=bounce, start=start if math.isfinite(self.normal_force.release) else None)

    def remembered(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """What the anchors are behind by after a step that ended at a placement; shapes as in `memory`."""
        if not isinstance(self.friction, AnchoredFriction):
            return prepared.centers[..., :0, :]
        at = self.touching(prepared, placement)
        kept = self.friction.kept(at.slip, at.depth)
        return kept if prepared.frame is None else turned(prepared.frame[..., :3].mT, kept)

    def take(self, worlds: Worlds) -> Self:
        """The same contact with the values of some worlds."""
        return replaced(
            self,
            position=worlds.pick(self.position, 2),
            radius=worlds.pick(self.radius, 1),
            margin=worlds.pick(self.margin, 1),
            grip=None if self.grip is None else worlds.pick(self.grip, 1),
            surface=self.surface.take(worlds),
            carrier=None if self.carrier is None else self.carrier.take(worlds),
            normal_force=self.normal_force.take(worlds),
            friction=None if self.friction is None else self.friction.take(worlds),
        )

    def _at(self, prepared: PreparedContact, centers: Tensor, turn: Tensor | None) -> Touching:
        frame = prepared.frame
        field = prepared.surface.field(_seen(frame, centers))
        normal, bend = field.direction, None if field.flat else lambda: field.bend
        if frame is not None:
            normal = turned(frame[..., :3], normal)
            bend = None if field.flat else lambda: frame[..., :3] @ field.bend @ frame[..., :3].mT
        depth = self.radius + self.margin - field.distance
        if prepared.bounce is not None:
            depth = depth + prepared.bounce
        moved = centers - prepared.centers
        if prepared.anchor is not None:
            moved = moved + prepared.anchor
        return Touching(centers, normal, depth, moved, self.radius if self.rounded else None, turn, bend, field.steepness)

    def touching(self, prepared: PreparedContact, placement: Placement) -> Touching:
        """Where the candidates are at a placement that ends the prepared step."""
        turn = None
        if self.rounded:
            turn = self._grouping.picked(rotation_log(placement.poses[..., :3, :3] @ prepared.rotations.mT))
        return self._at(prepared, self._centers(placement), turn)

    def force(self, prepared: PreparedContact, placement: Placement) -> ContactForce:
        """The forces on the candidates at a placement that ends the prepared step."""
        law = self.normal_force
        if self.restitution is not None and prepared.bounce is not None:
            law = self.restitution.stiffened(law, prepared.bounce)
        during = law.during(prepared.start, prepared.dt)
        return ContactForce(self.touching(prepared, placement), during, self.friction, prepared.dt, self.grip)

    def load(self, prepared: PreparedContact, placement: Placement) -> LinkLoad:
        contact = self.force(prepared, placement)
        links, grouping = placement.poses.shape[-3], self._grouping
        at = contact.at
        flat = at.bend is None and not self.rounded
        ends = extended(grouping.rows(at.points))

        def stiffness() -> Tensor:
            if not flat:
                return grouping.spread(grouping.sums(contact.stiffness().flatten(-2)).unflatten(-1, (6, 6)), links)
            summed = torch.zeros_like(ends[..., :1, :1])
            for pair in contact.factors():
                summed = summed + grouping.products(*(arm(ends[..., :3], grouping.rows(x)) for x in pair))
            if contact.drag is not None:
                summed = summed + inertia_stiffness(grouping.products(grouping.rows(contact.drag[..., None]) * ends, ends))
            return grouping.spread(summed, links)

        moment = -grouping.products(grouping.rows(contact.force), ends)
        outlook = functools.partial(self._outlook, contact)
        return LinkLoad(grouping.spread(moment, links), stiffness, outlook=outlook)

    def _outlook(self, contact: ContactForce, motion: Motion) -> Callable[[Tensor], Tensor]:
        velocity = self._grouping.mapped(motion.rates, self.position)
        acceleration = self._grouping.mapped(motion.accelerations, self.position)
        if self.rounded:  # as in the slip: the surface moves by −ρ φ × n beside its centre
            out = self.radius[..., None] * contact.at.normal
            velocity = velocity - cross(self._grouping.picked(motion.twists[..., :3]), out)
            acceleration = acceleration - cross(self._grouping.picked(motion.drifts[..., :3]), out)
        return contact_outlook(contact, velocity, acceleration)

    def depth(self, placement: Placement, time: Tensor | None = None) -> Tensor:
        """Penetration depth of every candidate [m] `[*batch, npoint]`, < 0 where apart, from the solid as it stands at `time`
        `[*batch]` [s], or at the start."""
        centers = self._centers(placement)
        frame = None
        if self.carrier is not None:
            frame = self.carrier.pose(centers.new_zeros(()) if time is None else time)[..., None, :3, :]
        none = centers.new_zeros(())
        return self._at(PreparedContact(none, none, none, frame, None, self.surface), centers, None).depth

    def potential(self, placement: Placement, time: Tensor) -> Tensor:
        """Energy stored by the normal force [J] `[*batch]` (Eq. 9)."""
        return self.normal_force.energy(self.depth(placement, time)).sum(-1)

    def energy(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """Stored energy (Eq. 9) and, where the friction is lagged, its energy μ N̂ S(‖u‖) [J] `[*batch]`. Friction that follows
        the normal force is the gradient of no scalar: it has no part in this."""
        return self.force(prepared, placement).energy().sum(-1)

    def lagged(self, prepared: PreparedContact, placement: Placement) -> Self:
        """The same contact with its friction held at the normal forces and depths of `placement`; without friction, or with a law
        that is no `SlipLaw`, the contact itself. What `softened` does later to C⊥ does not reach the held friction.

        The load is then the gradient of `energy`, exactly for points on flat solids. For rounded candidates it is not: friction f
        acts at c − ρn, which moves by δc − ρ δω × n, while the slip takes φ and moves by δc − ρ (Lδω) × n with L = ∂φ/∂ω. The
        gradient has the moment ρ (Lᵀ − 1)(n × f) more than the load, about ½ρ‖φ‖‖f‖ at most, and none where φ is along n × f
        (planar rolling)."""
        contact = self.force(prepared, placement)
        return replaced(self, friction=lagged_law(self.friction, contact.push, contact.at.depth))

    def widened(self, factor: float) -> Self:
        """The same contact with its friction smooth over a `factor` ≥ 1 times wider range of slip speeds, where the law has one."""
        return replaced(self, friction=widened_law(self.friction, factor))

    def seen_from(self, distance: float) -> Self:
        """See `Foreboding`."""
        return replaced(self, normal_force=self.normal_force.seen_from(distance))

    def softened(self, factor: float) -> Contact:
        """The same contact with C⊥ scaled by `factor`; the friction law follows the normal force."""
        return dataclasses.replace(self, normal_force=self.normal_force.scaled(factor))

    def push(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """See `Pushing`."""
        return self.force(prepared, placement).push.sum(-1)

    def points(self, prepared: PreparedContact, placement: Placement) -> ContactPoints:
        """The contacts at a placement that ends the prepared step."""
        contact = self.force(prepared, placement)
        at = contact.at
        return ContactPoints(at.points, at.depth, at.normal, contact.force, at.slip)


def _seen(frame: Tensor | None, points: Tensor) -> Tensor:
    """World points in a frame `[*batch, 1, 3, 4]`, or themselves."""
    return points if frame is None else turned(frame[..., :3].mT, points - frame[..., 3])
