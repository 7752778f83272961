"""The geometry and the forces of contact candidates at one placement, and how the forces answer a motion.

A candidate is a centre c on a body, a radius ρ ≥ 0 and a margin δ ≥ 0, beside a solid with signed distance φ, whose gradient there
has the direction n. Its depth is d = ρ + δ − φ(c), and its force acts at p = c − ρn. Over the step it slips by u = (1 − nnᵀ)m,
m = c − c₀ − ρ ϕ × n + a (METHOD §4): c₀ is where the solid has carried the centre of the start, ϕ the rotation since then relative
to the solid, and a what an anchor remembers. Everything is in world axes; what moves below is the body, relative to the solid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import cross, dot, outer, rows, trace_minus
from pbfd_torch.terms.friction_law import FrictionLaw, Lifting, Storing, slip_size
from pbfd_torch.terms.release import NormalLaw
from pbfd_torch.tree.rotations import log_jacobian_left, skew


@dataclass(frozen=True, eq=False)
class Touching:
    """Candidates beside their solids.

    Attributes:
        centers: c `[*, n, 3]`. normal: n `[*, n, 3]`. depth: d `[*, n]`.
        moved: c − c₀ + a `[*, n, 3]`.
        radius: ρ `[*, n]`, or None where all are points.
        turn: ϕ `[*, n, 3]`, or None with the radius.
        bend: gives ∂n/∂c `[*, n, 3, 3]` in world axes, or None where the solids are flat.
        steepness: ‖∇φ‖ `[*, n]`, or None where it is 1.
    """

    centers: Tensor
    normal: Tensor
    depth: Tensor
    moved: Tensor
    radius: Tensor | None
    turn: Tensor | None
    bend: Callable[[], Tensor] | None
    steepness: Tensor | None = None

    @cached_property
    def shift(self) -> Tensor:
        """∂c/∂W by the twist W = (ω, v) of the body about the world origin, `[*, n, 3, 6]`."""
        return shifting(self.centers)

    @cached_property
    def tilt(self) -> Tensor | None:
        """∂n/∂W `[*, n, 3, 6]`, None where the solids are flat."""
        return None if self.bend is None else self.bend() @ self.shift

    @cached_property
    def sinks(self) -> Tensor:
        """−∂d/∂W `[*, n, 6]`."""
        return self.sinking(self.shift)

    def sinking(self, velocity: Tensor) -> Tensor:
        """How fast the depth falls for centres that move like this, `[*, n, 3, k]` → `[*, n, k]`."""
        speed = rows(self.normal, velocity)
        return speed if self.steepness is None else self.steepness[..., None] * speed

    @cached_property
    def travel(self) -> Tensor:
        """m `[*, n, 3]`."""
        if self.radius is None or self.turn is None:
            return self.moved
        return self.moved - self.radius[..., None] * cross(self.turn, self.normal)

    @cached_property
    def slip(self) -> Tensor:
        """u `[*, n, 3]` [m]."""
        return self.travel - dot(self.travel, self.normal)[..., None] * self.normal

    @cached_property
    def size(self) -> Tensor:
        """‖u‖ `[*, n]` [m]."""
        return slip_size(self.slip)

    @property
    def points(self) -> Tensor:
        """p `[*, n, 3]`."""
        return self.centers if self.radius is None else self.centers - self.radius[..., None] * self.normal

    @property
    def travel_slope(self) -> Tensor:
        """∂m/∂W `[*, n, 3, 6]`."""
        move = self.shift
        if self.radius is None or self.turn is None:
            return move
        roll = self.radius[..., None, None] * (skew(self.normal) @ log_jacobian_left(self.turn))
        move = torch.cat((move[..., :3] + roll, move[..., 3:]), -1)
        return move if self.tilt is None else move - self.radius[..., None, None] * (skew(self.turn) @ self.tilt)

    @cached_property
    def slip_slope(self) -> Tensor:
        """∂u/∂W `[*, n, 3, 6]`."""
        move = self.travel_slope
        if self.tilt is None:
            return move - outer(self.normal, rows(self.normal, move))
        along = dot(self.normal, self.travel)[..., None, None]
        return move - outer(self.normal, rows(self.normal, move) + rows(self.travel, self.tilt)) - along * self.tilt

    def bulge(self, spin: Tensor) -> Tensor | None:
        """How much more the depth's growth is accelerated than that of a point which the body carries along without turning it,
        `[*, n]` [m/s²], where the body spins at `[*, n, 3]` [rad/s]; None: not at all, as the surface of a ball."""
        return None

    def wandering(self, force: Tensor) -> Tensor | None:
        """How the torque of a force `[*, n, 3]` answers W because it does not act on one material point, `[*, n, 3, 6]`; None: it
        does."""
        if self.radius is None:
            return None
        arm = self.radius[..., None, None]
        pull = outer(self.normal, force)
        moved = torch.cat((arm * trace_minus(pull), torch.zeros_like(pull)), -1)
        return moved if self.tilt is None else moved - arm * (skew(force) @ self.tilt)


@dataclass(frozen=True, eq=False)
class ContactForce:
    """The force f = N n − G u of every candidate: N the normal force with what friction adds to it, G the drag. `grip`: what the
    law is multiplied by, `[*, n]`: the μ of every candidate for a law whose own is 1."""

    at: Touching
    normal_force: NormalLaw
    friction: FrictionLaw | None
    dt: Tensor
    grip: Tensor | None = None

    @property
    def _lifting(self) -> Lifting | None:
        law: object = self.friction
        return law if isinstance(law, Lifting) else None

    @cached_property
    def push(self) -> Tensor:
        """The normal force of depth alone, `[*, n]` [N]."""
        return self.normal_force.push(self.at.depth)

    @cached_property
    def _push_slope(self) -> Tensor:
        return self.normal_force.slope(self.at.depth)

    def _gripped(self, value: Tensor) -> Tensor:
        return value if self.grip is None else self.grip * value

    @cached_property
    def normal(self) -> Tensor:
        """N `[*, n]` [N]."""
        if self._lifting is None:
            return self.push
        return self.push + self._gripped(self._lifting.lift(self.at.depth, self.at.size))

    @cached_property
    def drag(self) -> Tensor | None:
        """G `[*, n]` [N/m], None without friction."""
        if self.friction is None:
            return None
        return self._gripped(self.friction.drag(self.push, self.at.depth, self.at.size, self.dt))

    @cached_property
    def force(self) -> Tensor:
        """f `[*, n, 3]` on the body [N]."""
        if self.drag is None:
            return self.normal[..., None] * self.at.normal
        return self.normal[..., None] * self.at.normal - self.drag[..., None] * self.at.slip

    def energy(self) -> Tensor:
        """Stored energy (Eq. 9) and the friction's, where it is a gradient, `[*, n]` [J]."""
        energy = self.normal_force.energy(self.at.depth)
        law: object = self.friction
        if not isinstance(law, Storing):
            return energy
        return energy + self._gripped(law.energy(self.at.depth, self.at.slip, self.dt))

    @cached_property
    def _normal_slopes(self) -> tuple[Tensor, Tensor | None]:
        """dN/dd and (∂N/∂y)/y, y = ‖u‖: each `[*, n]`, None where N does not depend on the slip."""
        if self._lifting is None:
            return self._push_slope, None
        by_depth, by_size = (self._gripped(x) for x in self._lifting.lift_slopes(self.at.depth, self.at.size))
        return self._push_slope + by_depth, by_size

    @cached_property
    def _drag_slopes(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """G, dG/dd, (∂G/∂y)/y: each `[*, n]`; None without friction."""
        if self.friction is None or self.drag is None:
            return None
        slopes = self.friction.drag_slopes(self.push, self._push_slope, self.at.depth, self.at.size, self.dt)
        by_depth, by_size = (self._gripped(x) for x in slopes)
        return self.drag, by_depth, by_size

    def answer(self) -> Tensor:
        """−∂f/∂W `[*, n, 3, 6]`."""
        at = self.at
        by_depth, by_size = self._normal_slopes
        sinks = at.sinks
        answer = outer(at.normal, by_depth[..., None] * sinks)
        if at.tilt is not None:
            answer = answer - self.normal[..., None, None] * at.tilt
        if self._drag_slopes is None:
            return answer
        drag, drag_by_depth, drag_by_size = self._drag_slopes
        slips = at.slip_slope
        grows = rows(at.slip, slips)  # y ∂y/∂W
        if by_size is not None:
            answer = answer - outer(at.normal, by_size[..., None] * grows)
        resists = drag_by_size[..., None] * grows - drag_by_depth[..., None] * sinks
        return answer + drag[..., None, None] * slips + outer(at.slip, resists)

    def stiffness(self) -> Tensor:
        """How the wrench of every candidate about the world origin answers W, `[*, n, 6, 6]`, the part left out that a constant
        force on a material point at p has (`Balance.jacobian` adds it)."""
        at, answer = self.at, self.answer()
        torque, wandering = skew(at.points) @ answer, at.wandering(self.force)
        return torch.cat((torque if wandering is None else torque + wandering, answer), -2)


def shifting(points: Tensor) -> Tensor:
    """X = [−[p]× | 1], which takes a twist (ω, v) about the world origin to the velocity of a point, `[*, 3] → [*, 3, 6]`."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape, 3)
    return torch.cat((-skew(points), eye), -1)
