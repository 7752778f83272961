"""Contact between bodies: links with links, and links with convex obstacles. Candidates are detected once at the start of a step.

The wrench w = (p × f, f) of a candidate acts on its body, and −w on the body that carries the solid, at the same point p: momentum
is kept. The force depends on how the two stand to each other, so it answers the relative twist W = V₁ − V₂ by A (`touching`), and
turns with both of them. With what a constant force on a material point has (METHOD §3) left out, as everywhere:

    K₁₁ = A,  K₁₂ = −A − D,  K₂₁ = M − A,  K₂₂ = A + D − M,   D V = (p × (ω × f), ω × f),  M V = ((v + ω × p) × f, 0).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.contact.candidates import Finder, Slots
from pbfd_torch.contact.hazards import Hazard, Overflow, marked
from pbfd_torch.contact.obstacle import Carrier
from pbfd_torch.contact.surface import Placed
from pbfd_torch.errors import ContactOverflowError
from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.tensors.vectors import applied, extended, in_frames, mapped, outer
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative, require_positive
from pbfd_torch.terms.contact_laws import ContactLaws, ContactPoints, Prepared
from pbfd_torch.terms.contact_outlook import contact_outlook
from pbfd_torch.terms.grouping import belonging, summed
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.terms.touching import ContactForce, Touching
from pbfd_torch.tree.kinematics import Motion, Placement
from pbfd_torch.tree.rotations import rotation_log, skew

_FAR = 1e6  # [m] how far an empty slot is from everything


@dataclass(frozen=True, eq=False)
class PreparedBodyContact(Prepared):
    slots: Slots
    bodies: Tensor  # [*batch, nbody, 4, 4] at the start
    reach: Tensor  # [*batch, nbody] how far they may move without a candidate being missed
    obstacles: Tensor  # [*batch, nobstacle, 4, 4] at the end
    start: Tensor  # [*batch, n, 3] where the points were in the frames of the solids
    turned: Tensor  # [*batch, n, 3, 3] how their bodies stood in the frames of the solids
    anchor: Tensor | None  # [*batch, n, 3] what the anchors are behind by in the frames of the solids

    def standing(self, placement: Placement) -> Tensor:
        """Where the bodies are at a placement that ends the step, `[*batch, nbody, 4, 4]`."""
        links = placement.poses
        return torch.cat((links, self.obstacles.expand(*links.shape[:-3], *self.obstacles.shape[-3:])), -3)


@dataclass(frozen=True, eq=False)
class BodyContact(ContactLaws[PreparedBodyContact]):
    """Candidates between bodies, found anew in every step, which act by `ContactLaws`; the friction is that for μ = 1.

    Attributes:
        finder: what finds them.
        obstacles: the bodies that are no links, numbered after these.
        extent: `[nbody]` distance from a body's origin to its farthest collider point [m].
        grip: `[npair]` the μ of every pair of colliders.
        slack: [m] how much further than its free motion and half as far again a body may go without a candidate being missed, and
            how far bodies may overlap at the start of a step without a `Hazard`.
        overflow: what to do where more is near than there are slots.
    """

    finder: Finder
    obstacles: tuple[Carrier, ...]
    extent: Tensor
    grip: Tensor
    slack: float = 0.01
    overflow: Overflow = Overflow.FLAG

    def __post_init__(self) -> None:
        require_non_negative("μ of body contacts", self.grip)
        require_positive("slack", self.slack, "m")

    def take(self, worlds: Worlds) -> Self:
        """The same contact of some worlds."""
        return replaced(super().take(worlds), obstacles=tuple(x.take(worlds) for x in self.obstacles))

    def _standing(self, like: Tensor, time: Tensor) -> Tensor:
        """Where the obstacles are, `[*batch, nobstacle, 4, 4]`, for as many worlds as link poses have."""
        batch = like.shape[:-3]
        poses = [x.pose(time).expand(*batch, 4, 4) for x in self.obstacles]
        return torch.stack(poses, -3) if poses else like[..., :0, :, :]

    def memory(self, batch: tuple[int, ...]) -> Tensor:
        """What the anchors know of each slot: what they are behind by, where its point is, and its pair (−1: none),
        `[*batch, n, 7]`; without anchors nothing."""
        return self.extent.new_full((*batch, self.finder.slots if self._anchors else 0, 7), -1.0)

    def recall(self, step: StepContext, memory: Tensor) -> PreparedBodyContact:
        """See `ContactLaws`."""
        links, target = step.previous.poses, step.target_poses
        obstacles = self._standing(links, step.time + step.dt)
        bodies = torch.cat((links, self._standing(links, step.time)), -3)
        ahead = torch.cat((target.expand_as(links), obstacles), -3)
        with torch.no_grad():  # which candidates there are does not change smoothly; where they are does
            reach = 1.5 * self._travel(bodies, ahead) + self.slack
        slots = self._found(bodies, ahead, reach)
        first, second = of_slots(bodies, slots.first), of_slots(bodies, slots.second)
        turned = second[..., :3].mT @ first[..., :3]
        start = in_frames(second, mapped(first, slots.position)) + step.dt[..., None, None] * self._running(slots, turned)
        dt = step.dt[..., None]
        depth, bounce = self._beginning(
            dt,
            lambda: self._gaps(slots, bodies),
            lambda: self._gaps(slots, ahead),
            lambda: self._gaps(slots, torch.cat((step.coasting_poses, obstacles), -3)),
        )
        firm = None if self.firm is None else _of_pairs(self.firm, slots.pair)
        return PreparedBodyContact(
            slots=slots,
            bodies=bodies,
            reach=reach,
            obstacles=obstacles,
            start=start,
            turned=turned,
            anchor=_inherited(memory, slots) if self._anchors else None,
            dt=dt,
            grip=self._gripping(self.grip[slots.pair], firm),
            firm=firm,
            deep=None if self.deep is None else _of_pairs(self.deep, slots.pair),
            depth=depth,
            bounce=bounce,
        )

    def _running(self, slots: Slots, turned: Tensor) -> Tensor:
        """Velocity of belts at the slots as their solids see it, `[*batch, n, 3]`: the solids' less the points'."""
        if not any(any(x.motion.belt) for x in self.obstacles):
            return torch.zeros_like(slots.position)
        still = self.extent.new_zeros((len(self.extent) - len(self.obstacles), 3))
        belt = torch.cat((still, torch.stack([x.belt for x in self.obstacles])))
        return belt[slots.second] - applied(turned, belt[slots.first])

    def _found(self, bodies: Tensor, ahead: Tensor, reach: Tensor) -> Slots:
        finder = self.finder
        slots = finder.find(bodies, ahead, reach)
        if self.overflow is Overflow.FLAG:
            return slots
        while bool(slots.dropped.any()):
            if self.overflow is Overflow.RAISE:
                raise ContactOverflowError(
                    f"more contacts are near than the {finder.slots} slots hold in {int(slots.dropped.sum())} worlds: "
                    "give more slots, or choose Overflow.FLAG or Overflow.GROW"
                )
            finder = finder.grown()
            slots = finder.find(bodies, ahead, reach)
        return slots

    def _gaps(self, slots: Slots, bodies: Tensor) -> Tensor:
        """How far the points are from the solids [m] `[*batch, n]`."""
        first, second = of_slots(bodies, slots.first), of_slots(bodies, slots.second)
        return Placed(slots.surface, second).field(mapped(first, slots.position)).distance - slots.radius

    def _travel(self, before: Tensor, after: Tensor) -> Tensor:
        """How far the farthest collider point of each body moves at most [m], `[*batch, nbody]`."""
        shift = torch.linalg.vector_norm((after - before)[..., :3, 3], dim=-1)
        turn = torch.linalg.matrix_norm((after - before)[..., :3, :3]) / 2**0.5  # the chord of a unit arm
        return shift + self.extent * turn

    def depths(self, prepared: PreparedBodyContact, placement: Placement) -> Tensor:
        """See `ContactLaws`."""
        return torch.where(prepared.slots.filled, -self._gaps(prepared.slots, prepared.standing(placement)), -_FAR)

    def carried(self, prepared: PreparedBodyContact, links: Tensor) -> Tensor:
        """See `ContactLaws`."""
        still = links.new_zeros((*links.shape[:-1], len(self.obstacles)))
        bodies = torch.cat((links, still), -1)
        return _of_pairs(bodies, prepared.slots.first) | _of_pairs(bodies, prepared.slots.second)

    def numbers(self, prepared: PreparedBodyContact) -> Tensor:
        """See `ContactLaws`."""
        return prepared.slots.pair

    def hazards(self, prepared: PreparedBodyContact, placement: Placement, turned: Tensor) -> Tensor:
        """See `Hazardous`."""
        far = (self._travel(prepared.bodies, prepared.standing(placement)) > prepared.reach).any(-1)
        slots = prepared.slots
        overlapped = (slots.filled & (self._gaps(slots, prepared.bodies) < -self.slack)).any(-1)
        found = {Hazard.CANDIDATES_DROPPED: slots.dropped, Hazard.MOVED_TOO_FAR: far, Hazard.OVERLAPPED: overlapped}
        return super().hazards(prepared, placement, turned) | marked(found)

    def remembered(self, prepared: PreparedBodyContact, placement: Placement) -> Tensor:
        """What the anchors know after a step that ended at a placement; see `memory`."""
        slots = prepared.slots
        if not self._anchors:
            return prepared.start.new_zeros((*prepared.start.shape[:-2], 0, 7))
        at, frame = self.touching(prepared, placement), of_slots(prepared.standing(placement), slots.second)
        kept = applied(frame[..., :3].mT, self._anchors.kept(at.slip, at.depth))
        pair = torch.where(slots.filled & (at.depth > 0), slots.pair, -1).to(kept.dtype)
        return torch.cat((kept, slots.position, pair[..., None]), -1)[..., : self.finder.slots, :]

    def touching(self, prepared: PreparedBodyContact, placement: Placement) -> Touching:
        """See `ContactLaws`."""
        slots, bodies = prepared.slots, prepared.standing(placement)
        first, frame = of_slots(bodies, slots.first), of_slots(bodies, slots.second)
        centers = mapped(first, slots.position)
        field = Placed(slots.surface, frame).field(centers)
        start = prepared.start if prepared.anchor is None else prepared.start - prepared.anchor
        depth = prepared.raised(slots.radius - field.distance)
        return Touching(
            centers=centers,
            normal=field.direction,
            depth=torch.where(slots.filled, depth, -_FAR),
            moved=centers - mapped(frame, start),
            radius=slots.radius,
            turn=rotation_log(first[..., :3] @ (frame[..., :3] @ prepared.turned).mT),
            bend=None if field.flat else lambda: field.bend,
            steepness=field.steepness,
        )

    def points(self, prepared: PreparedBodyContact, placement: Placement) -> ContactPoints:
        """See `ContactLaws`. Empty slots hold zeros, far from everything."""
        found, filled = super().points(prepared, placement), prepared.slots.filled[..., None]
        vectors = ("point", "normal", "force", "slip")
        return replaced(found, **{name: torch.where(filled, getattr(found, name), 0.0) for name in vectors})

    def load(self, prepared: PreparedBodyContact, placement: Placement) -> LinkLoad:
        slots, contact = prepared.slots, self.force(prepared, placement)
        links = placement.poses.shape[-3]
        on_first, on_second = (belonging(x, links, contact.force) for x in (slots.first, slots.second))

        @functools.cache
        def blocks() -> tuple[Tensor, Tensor, Tensor]:
            return contact.stiffness(), *_turning(contact)

        def stiffness() -> Tensor:
            answer, turned, moved = blocks()
            return summed(on_first, answer) + summed(on_second, answer + turned - moved)

        def coupling() -> Tensor:
            answer, turned, moved = blocks()
            there = (on_first[..., :, None, :] * on_second[..., None, :, :]).flatten(-3, -2)
            back = (on_second[..., :, None, :] * on_first[..., None, :, :]).flatten(-3, -2)
            return (summed(back, moved - answer) - summed(there, answer + turned)).unflatten(-3, (links, links))

        moment = summed(on_second - on_first, outer(contact.force, extended(contact.at.points)))
        outlook = functools.partial(_outlook, slots, len(self.obstacles), contact)
        return LinkLoad(moment, stiffness, coupling, outlook)


def _of_pairs(values: Tensor, pair: Tensor) -> Tensor:
    """`[*, npair], [*batch, n] → [*batch, n]`."""
    return values.expand(*pair.shape[:-1], values.shape[-1]).take_along_dim(pair, -1)


def of_slots(bodies: Tensor, index: Tensor) -> Tensor:
    """`[*batch, nbody, r, 4], [*batch, n] → [*batch, n, 3, 4]`; either may be that of one world for all."""
    batch = broadcast_shapes(bodies.shape[:-3], index.shape[:-1])
    place = index[..., None, None].expand(*batch, index.shape[-1], 3, 4)
    return bodies[..., :3, :].expand(*batch, *bodies.shape[-3:-2], 3, 4).take_along_dim(place, -3)


def _outlook(slots: Slots, obstacles: int, contact: ContactForce, motion: Motion) -> Callable[[Tensor], Tensor]:
    """See `contact_outlook`; the motion is that of the first body as the second one sees it."""
    at = contact.at
    still = motion.rates.new_zeros((*motion.rates.shape[:-3], obstacles, 3, 4))

    def seen(of_links: Tensor, body: Tensor) -> Tensor:
        return of_slots(torch.cat((of_links, still), -3), body)

    first, second = ([seen(x, body) for x in (motion.velocities, motion.changes)] for body in (slots.first, slots.second))
    velocity = mapped(first[0] - second[0], at.centers)
    carried = 2 * applied(second[0][..., :3], velocity)  # Coriolis: seen from a turning body
    acceleration = mapped(first[1] - second[1], at.centers) - carried
    out = at.centers - at.points
    spin = first[0][..., :3] - second[0][..., :3]
    return contact_outlook(contact, velocity - applied(spin, out), acceleration)


def _turning(contact: ContactForce) -> tuple[Tensor, Tensor]:
    """D and M of the module's head, `[*, n, 6, 6]`."""
    force, arm = skew(contact.force), skew(contact.at.points)
    zero = torch.zeros_like(force)
    turned = torch.cat((torch.cat((-arm @ force, zero), -1), torch.cat((-force, zero), -1)), -2)
    moved = torch.cat((torch.cat((force @ arm, -force), -1), torch.cat((zero, zero), -1)), -2)
    return turned, moved


def _inherited(memory: Tensor, slots: Slots) -> Tensor:
    """What the anchor of each slot is behind by: that of the nearest slot of the same pair in the step before, `[*batch, n, 3]`."""
    gone = (memory[..., None, :, 6] != slots.pair[..., None].to(memory.dtype)) | ~slots.filled[..., None]
    distance = (slots.position[..., :, None, :] - memory[..., None, :, 3:6]).square().sum(-1)
    least, index = torch.where(gone, torch.inf, distance).min(-1)
    kept = memory[..., :3].take_along_dim(index[..., None].expand(*index.shape, 3), -2)
    return torch.where(torch.isfinite(least)[..., None], kept, torch.zeros_like(kept))
