"""Contact of candidate points with a half-space: depth, slip, forces, and their exact stiffness.

A candidate is a centre c fixed in a link, a radius ρ ≥ 0 and a margin δ ≥ 0. Its depth is d = ρ + δ − (n·c − h), its force
acts at c − ρn, and its slip over the step is u = (I − nnᵀ)[(c − c_n) − ρ φ × n] with φ = log(R R_nᵀ): zero for pure rolling
(METHOD §4).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.articulation import Articulation
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.errors import InputError
from pbfd_torch.kinematics import Motion, Placement
from pbfd_torch.rotations import log_jacobian_left, quaternion_matrix, rotation_log, skew
from pbfd_torch.terms.lagged_friction import LaggedFriction, SlipLaw
from pbfd_torch.terms.load import LinkLoad, StepContext
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.worlds import Worlds, replaced


class FrictionLaw(Protocol):
    """Tangential force of a contact law."""

    def force(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Force, d force/d depth, d force/d slip from N, dN/dd, d `[*, n]`, u `[*, n, 3]` and dt (broadcastable to `[*, n]`)."""
        ...

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """g ≥ 0 `[*, n]`, where the force is −g u, from N, d and ‖u‖ `[*, n]`."""
        ...

    def take(self, worlds: Worlds) -> Self:
        """The same law with the parameters of some worlds."""
        ...


@dataclass(frozen=True, eq=False)
class PreparedContact:
    dt: Tensor  # [*batch, 1]
    centers: Tensor  # [*batch, npoint, 3] at the start of the step
    rotations: Tensor  # [*batch, nlink, 3, 3] at the start of the step
    on_link: Tensor  # [nlink, npoint] 1 where the candidate is the link's


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """What the contacts of one placement look like, for records and pictures.

    Attributes: `point` `[*, n, 3]` where the force acts [m]; `depth` `[*, n]` > 0 inside the obstacle [m]; `normal` `[*, 3]`;
    `force` `[*, n, 3]` on the body [N]; `slip` `[*, n, 3]` over the step [m]."""

    point: Tensor
    depth: Tensor
    normal: Tensor
    force: Tensor
    slip: Tensor


@dataclass(frozen=True, eq=False)
class Contact:
    """Candidate points against one half-space.

    Attributes:
        link: `[npoint]` index of the link that carries each candidate.
        position: `[*, npoint, 3]` centre in the link's frame [m].
        radius: `[npoint]` [m] ≥ 0.
        margin: `[npoint]` [m] ≥ 0: skin in which the force sets in already.
        normal: `[*, 3]` unit normal out of the obstacle; offset: `[*]` its height along the normal [m].
        normal_force: Eq. 8.
        friction: the tangential law, or None for a frictionless contact.
        names: the collider that each candidate belongs to.
    """

    link: Tensor
    position: Tensor
    radius: Tensor
    margin: Tensor
    normal: Tensor
    offset: Tensor
    normal_force: NormalForce
    friction: FrictionLaw | None
    names: tuple[str, ...] = ()

    @staticmethod
    def between(
        articulation: Articulation,
        colliders: Sequence[Collider],
        obstacle: HalfSpace,
        normal_force: NormalForce,
        friction: FrictionLaw | None,
    ) -> Contact:
        """All candidates of the colliders against the obstacle. Raises `InputError` for an unknown link or no candidate at all."""
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

        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(values, dtype=articulation.dtype, device=articulation.device)

        return Contact(
            link=torch.tensor(links, dtype=torch.long, device=articulation.device),
            position=tensor(np.concatenate(centers)),
            radius=tensor(np.concatenate(radii)),
            margin=tensor(np.concatenate(margins)),
            normal=tensor(obstacle.normal),
            offset=tensor(obstacle.offset),
            normal_force=normal_force,
            friction=friction,
            names=tuple(names),
        )

    def __post_init__(self) -> None:
        zero = torch.zeros_like(self.radius)[None]
        count = len(self.radius)
        try:
            shape = self.normal_force.force(zero)[0].shape
            if self.friction is not None:
                force, _, _ = self.friction.force(zero, zero, zero, zero[..., None].expand(-1, -1, 3), torch.ones_like(zero))
                shape = torch.broadcast_shapes(shape, force.shape[:-1])
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

    def _centers(self, placement: Placement) -> Tensor:
        return _mapped(placement.poses[..., self.link, :3, :], self.position)

    def prepare(self, step: StepContext) -> PreparedContact:
        poses = step.previous.poses
        links = torch.arange(poses.shape[-3], device=self.link.device)
        on_link = (links[:, None] == self.link).to(self.radius.dtype)
        return PreparedContact(step.dt[..., None], self._centers(step.previous), poses[..., :3, :3], on_link)

    def take(self, worlds: Worlds) -> Self:
        """The same contact with the values of some worlds."""
        return replaced(
            self,
            position=worlds.pick(self.position, 2),
            normal=worlds.pick(self.normal, 1),
            offset=worlds.pick(self.offset, 0),
            normal_force=self.normal_force.take(worlds),
            friction=None if self.friction is None else self.friction.take(worlds),
        )

    def _depth(self, centers: Tensor) -> Tensor:
        return self.radius + self.margin + self.offset[..., None] - (centers @ self.normal[..., None]).squeeze(-1)

    def _turn(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """Rotation of each link over the step as a vector, `[*batch, nlink, 3]`."""
        return rotation_log(placement.poses[..., :3, :3] @ prepared.rotations.mT)

    def depth(self, placement: Placement) -> Tensor:
        """Penetration depth of every candidate [m] `[*batch, npoint]`, < 0 where apart."""
        return self._depth(self._centers(placement))

    def _slip(self, prepared: PreparedContact, placement: Placement, centers: Tensor) -> Tensor:
        normal = self.normal[..., None, :]
        moved = centers - prepared.centers
        if self.rounded:
            turn = self._turn(prepared, placement)[..., self.link, :]
            moved = moved - self.radius[..., None] * torch.linalg.cross(turn, normal.expand_as(turn))
        return moved - (moved * normal).sum(-1, keepdim=True) * normal

    def load(self, prepared: PreparedContact, placement: Placement) -> LinkLoad:
        centers = self._centers(placement)
        normal = self.normal[..., None, :].expand_as(centers)
        depth = self._depth(centers)
        push, push_slope = self.normal_force.force(depth)
        force = push[..., None] * normal
        by_depth = push_slope[..., None] * normal
        by_slip = None
        if self.friction is not None:
            slip = self._slip(prepared, placement, centers)
            drag, drag_by_depth, by_slip = self.friction.force(push, push_slope, depth, slip, prepared.dt)
            force = force + drag
            by_depth = by_depth + drag_by_depth
        points = centers - self.radius[..., None] * normal if self.rounded else centers
        on_link = prepared.on_link.expand(*force.shape[:-2], *prepared.on_link.shape)

        def summed(blocks: Tensor) -> Tensor:
            return (on_link @ blocks.flatten(-2)).unflatten(-1, blocks.shape[-2:])

        def stiffness() -> Tensor:
            # minus the derivative of the force by the link's twist, in its ω and v columns, each [*batch, npoint, 3, 3]
            turned, shifted = _outer(by_depth, torch.linalg.cross(centers, normal)), _outer(by_depth, normal)
            if by_slip is not None:
                tangential = by_slip - _outer((by_slip @ normal[..., None]).squeeze(-1), normal)
                arm = skew(centers)
                if self.rounded:
                    turning = skew(self.normal)[..., None, :, :] @ log_jacobian_left(self._turn(prepared, placement))
                    arm = arm - self.radius[..., None, None] * turning[..., self.link, :, :]
                turned, shifted = turned + tangential @ arm, shifted - tangential
            lever = skew(points)
            twisted = lever @ turned
            if self.rounded:  # the point of application moves with the centre, not with the surface
                pull = self.radius[..., None, None] * _outer(normal, force)
                trace = pull.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
                twisted = twisted - pull + trace * torch.eye(3, dtype=pull.dtype, device=pull.device)
            upper = torch.cat((summed(twisted), summed(lever @ shifted)), -1)
            return torch.cat((upper, torch.cat((summed(turned), summed(shifted)), -1)), -2)

        return LinkLoad(-torch.cat((summed(_outer(force, points)), (on_link @ force)[..., None]), -1), stiffness)

    def outlook(self, prepared: PreparedContact, motion: Motion) -> Callable[[Tensor], Tensor]:
        """Each point of application moves on a parabola, so its depth d and the square of its slip u are polynomials in a; the work
        is N ḋ + g u·u̇, where friction is −g u."""
        at = motion.placement
        centers, normal = self._centers(at), self.normal[..., None, :]
        velocity = _mapped(motion.velocities[..., self.link, :, :], centers)
        acceleration = _mapped(motion.changes[..., self.link, :, :], centers)
        if self.rounded:  # as in the slip: the surface moves by −ρ φ × n beside its centre
            arm = self.radius[..., None] * normal.expand_as(centers)
            velocity = velocity - torch.linalg.cross(motion.twists[..., self.link, :3], arm)
            acceleration = acceleration - torch.linalg.cross(motion.drifts[..., self.link, :3], arm)
        depth, sinks, sinks_faster = self._depth(centers), -(velocity * normal).sum(-1), -(acceleration * normal).sum(-1)
        law, dt = self.friction, prepared.dt
        if law is not None:
            slip = self._slip(prepared, at, centers)
            first, second = velocity + sinks[..., None] * normal, acceleration + sinks_faster[..., None] * normal
            size, along, square = (slip * slip).sum(-1), (slip * first).sum(-1), (first * first + slip * second).sum(-1)
            cube, fourth = (first * second).sum(-1), (second * second).sum(-1)

        def work(length: Tensor) -> Tensor:
            a = length[..., None]
            deep = depth + a * (sinks + 0.5 * a * sinks_faster)
            push, _ = self.normal_force.force(deep)
            power = push * (sinks + a * sinks_faster)
            if law is not None:
                far = size + a * (2 * along + a * (square + a * (cube + 0.25 * a * fourth)))
                onward = along + a * (square + a * (1.5 * cube + 0.5 * a * fourth))
                power = power + law.drag(push, deep, far.clamp_min(0).sqrt(), dt) * onward
            return power.sum(-1)

        return work

    def potential(self, placement: Placement) -> Tensor:
        """Energy stored by the normal force [J] `[*batch]` (Eq. 9)."""
        return self.normal_force.energy(self.depth(placement)).sum(-1)

    def energy(self, prepared: PreparedContact, placement: Placement) -> Tensor:
        """Stored energy (Eq. 9) and, where the friction is lagged, its energy μ N̂ S(‖u‖) [J] `[*batch]`. Friction that follows
        the normal force is the gradient of no scalar: it has no part in this."""
        centers = self._centers(placement)
        energy = self.normal_force.energy(self._depth(centers))
        if isinstance(self.friction, LaggedFriction):
            energy = energy + self.friction.energy(self._slip(prepared, placement, centers), prepared.dt)
        return energy.sum(-1)

    def lagged(self, prepared: PreparedContact, placement: Placement) -> Self:
        """The same contact with its friction held at the normal forces and depths of `placement`; without friction, or with a law
        that is no `SlipLaw`, the contact itself. What `softened` does later to C⊥ does not reach the held friction.

        The load is then the gradient of `energy`, exactly for points. For rounded candidates it is not: friction f acts at c − ρn,
        which moves by δc − ρ δω × n, while the slip takes φ and moves by δc − ρ (Lδω) × n, L = ∂φ/∂ω = 1 − ½[φ]× + …. The gradient
        has the moment ρ (Lᵀ − 1)(n × f) more than the load, about ½ρ‖φ‖‖f‖ at most, and none where φ is along n × f (planar
        rolling)."""
        law = self.friction.law if isinstance(self.friction, LaggedFriction) else self.friction
        if not isinstance(law, SlipLaw):
            return self
        depth = self.depth(placement)
        normal, _ = self.normal_force.force(depth)
        return replaced(self, friction=LaggedFriction(law, normal, depth))

    def widened(self, factor: float) -> Self:
        """The same contact with its friction smooth over a `factor` ≥ 1 times wider range of slip speeds, where the law has one."""
        if not isinstance(self.friction, SlipLaw | LaggedFriction):
            return self
        return replaced(self, friction=self.friction.widened(factor))

    def softened(self, factor: float) -> Contact:
        """The same contact with C⊥ scaled by `factor`; the friction law follows the normal force."""
        return dataclasses.replace(self, normal_force=self.normal_force.scaled(factor))

    def points(self, prepared: PreparedContact, placement: Placement) -> ContactPoints:
        """The contacts at a placement that ends the prepared step."""
        centers = self._centers(placement)
        depth = self._depth(centers)
        push, push_slope = self.normal_force.force(depth)
        force = push[..., None] * self.normal[..., None, :]
        slip = self._slip(prepared, placement, centers)
        if self.friction is not None:
            force = force + self.friction.force(push, push_slope, depth, slip, prepared.dt)[0]
        point = centers - self.radius[..., None] * self.normal[..., None, :]
        return ContactPoints(point, depth, self.normal, force, slip)


def _mapped(matrices: Tensor, points: Tensor) -> Tensor:
    """M (p, 1), `[*, 3, 4], [*, 3] → [*, 3]`."""
    return (matrices[..., :3] @ points[..., None]).squeeze(-1) + matrices[..., 3]


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """a bᵀ, `[*, 3], [*, 3] → [*, 3, 3]`."""
    return a[..., :, None] * b[..., None, :]
