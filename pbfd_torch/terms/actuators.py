"""Actuators at hinge and slide joints: torque, position (PD) and velocity servos, solved implicitly, with limits."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.constants import indices
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.checks import require_non_negative
from pbfd_torch.terms.load import JointLoad, StepContext, diagonal_load
from pbfd_torch.tree.articulation import Articulation, JointKind
from pbfd_torch.tree.kinematics import Placement


@dataclass(frozen=True)
class Actuator:
    """One actuator on a hinge or slide joint; x = gear · (joint coordinate).

    Force before the gear: clamp(gain·u + bias − stiffness·x − damping·ẋ, force_range), u = clamp(control, control_range); the
    joint feels gear times that. A motor has gain 1; a position servo gain = stiffness = kp; a velocity servo gain = damping =
    kv."""

    name: str
    joint: str
    gear: float = 1.0
    gain: float = 1.0
    bias: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    control_range: tuple[float, float] = (-math.inf, math.inf)
    force_range: tuple[float, float] = (-math.inf, math.inf)

    @staticmethod
    def motor(name: str, joint: str, gear: float = 1.0, effort: float = math.inf) -> Actuator:
        """Control is the force [N or N m] before the gear, within ±effort."""
        return Actuator(name, joint, gear, force_range=(-effort, effort))

    @staticmethod
    def position(name: str, joint: str, kp: float, kv: float = 0.0, effort: float = math.inf) -> Actuator:
        """Control is the wanted coordinate [rad or m]: kp (u − q) − kv q̇ within ±effort."""
        return Actuator(name, joint, gain=kp, stiffness=kp, damping=kv, force_range=(-effort, effort))

    @staticmethod
    def velocity(name: str, joint: str, kv: float, effort: float = math.inf) -> Actuator:
        """Control is the wanted velocity [rad/s or m/s]: kv (u − q̇) within ±effort."""
        return Actuator(name, joint, gain=kv, damping=kv, force_range=(-effort, effort))


@dataclass(frozen=True, eq=False)
class PreparedActuators:
    drive: Tensor  # gain·u + bias
    inverse_dt: Tensor
    previous: Tensor  # x_n
    spread: Tensor  # [nu, nv] 1 where the actuator drives the degree of freedom (several may drive one)


@dataclass(frozen=True, eq=False)
class Actuators:
    """All actuators of a robot as tensors `[*, nu]`; the control vector has their order. Build with `from_list`."""

    names: tuple[str, ...]
    coordinate: Tensor  # index into q
    dof: Tensor  # index into v
    gear: Tensor
    gain: Tensor
    bias: Tensor
    stiffness: Tensor
    damping: Tensor
    control_range: Tensor  # [nu, 2]
    force_range: Tensor  # [nu, 2]
    share: Tensor | None = None  # see `taken_at`

    @staticmethod
    def from_list(articulation: Articulation, actuators: Sequence[Actuator]) -> Actuators:
        """Raises `InputError` for an unknown joint, a joint that is no hinge or slide, or a negative stiffness or damping."""
        t = articulation.topology
        for a in actuators:
            j = articulation.joint_index(a.joint)
            if t.joint_sizes[j] != (JointKind.HINGE.nq, JointKind.HINGE.nv):
                raise InputError(f"actuator '{a.name}': joint '{a.joint}' must be a hinge or a slide")
            for what in ("stiffness", "damping"):
                require_non_negative(f"actuator '{a.name}': {what}", getattr(a, what))
            for what in ("control_range", "force_range"):
                low, high = getattr(a, what)
                if not low <= high:
                    raise InputError(f"actuator '{a.name}': {what} is ({low}, {high}): must rise")
        joints = [articulation.joint_index(a.joint) for a in actuators]

        def tensor(values: Sequence[object]) -> Tensor:
            return torch.tensor(values, dtype=articulation.dtype, device=articulation.device)

        def index(starts: Sequence[int]) -> Tensor:
            return indices([starts[j] for j in joints], articulation.device)

        return Actuators(
            names=tuple(a.name for a in actuators),
            coordinate=index(t.q_start),
            dof=index(t.v_start),
            gear=tensor([a.gear for a in actuators]),
            gain=tensor([a.gain for a in actuators]),
            bias=tensor([a.bias for a in actuators]),
            stiffness=tensor([a.stiffness for a in actuators]),
            damping=tensor([a.damping for a in actuators]),
            control_range=tensor([a.control_range for a in actuators]).view(-1, 2),
            force_range=tensor([a.force_range for a in actuators]).view(-1, 2),
        )

    @property
    def nu(self) -> int:
        """Length of the control vector."""
        return len(self.names)

    def to(self, dtype: torch.dtype, device: torch.device | str) -> Actuators:
        """The same actuators in another dtype or on another device."""
        moved: dict[str, Any] = {
            f.name: (v.to(device, dtype) if v.is_floating_point() else v.to(device))
            for f in dataclasses.fields(self)
            if isinstance(v := getattr(self, f.name), Tensor)
        }
        return dataclasses.replace(self, **moved)

    def take(self, worlds: Worlds) -> Self:
        """The same actuators with the values of some worlds."""
        return replaced(
            self,
            gear=worlds.pick(self.gear, 1),
            gain=worlds.pick(self.gain, 1),
            bias=worlds.pick(self.bias, 1),
            stiffness=worlds.pick(self.stiffness, 1),
            damping=worlds.pick(self.damping, 1),
            control_range=worlds.pick(self.control_range, 2),
            force_range=worlds.pick(self.force_range, 2),
            share=worlds.pick(self.share, 1),
        )

    def largest(self, articulation: Articulation) -> Tensor:
        """The largest force [N] or torque [N m] that each actuator puts on its joint `[*, nu]`, its damping left out: what its
        force range allows, and its control range and its joint's limits; infinite where nothing bounds it."""

        def size(bounds: Tensor) -> Tensor:
            return bounds.abs().amax(-1)

        def most(factor: Tensor, bound: Tensor) -> Tensor:
            return torch.where(factor == 0, 0.0, factor.abs() * bound)  # 0 times infinity is nothing here

        limits = torch.stack((articulation.lower, articulation.upper), -1)[..., self.dof, :]
        asked = most(self.gain, size(self.control_range)) + self.bias.abs() + most(self.stiffness * self.gear, size(limits))
        return self.gear.abs() * torch.minimum(asked, size(self.force_range))

    def efforts(self, articulation: Articulation) -> list[float]:
        """The largest force [N] or torque [N m] of all actuators at each degree of freedom, in any world."""
        each = self.largest(articulation).detach().reshape(-1, self.nu).amax(0)
        spread = _spread(self.dof, articulation, torch.float64)
        return torch.where(spread > 0, each[:, None].to(spread), 0.0).sum(0).tolist()

    def pressing(self, prepared: PreparedActuators) -> Tensor:
        """The size of the force [N] or torque [N m] at each degree of freedom where the step begins, its damping left out,
        `[*batch, nv]`."""
        force = _clamped(prepared.drive - self.stiffness * prepared.previous, self.force_range)
        return ((self.gear * force)[..., None, :] @ prepared.spread).squeeze(-2).abs()

    def slope(self, articulation: Articulation, dt: Tensor) -> Tensor:
        """∂r/∂q of all joints within the force ranges `[*, nv]`."""
        of_each = self.gear * self.gear * (self.stiffness + self.damping / dt[..., None])
        return (of_each[..., None, :] @ _spread(self.dof, articulation, of_each.dtype)).squeeze(-2)

    def taken_at(self, share: Tensor) -> Self:
        """θ of the actuators, θ `[*, nv]`, whose stiffness answers the coordinates q_n + θ (q − q_n)."""
        return replaced(self, share=share[..., self.dof])

    @property
    def _yield(self) -> Tensor:
        """How the force falls over the step with its coordinate but for the damping."""
        return self.stiffness if self.share is None else self.share * self.stiffness

    def prepare(self, step: StepContext) -> PreparedActuators:
        drive = self._drive(step.control)
        spread = _spread(self.dof, step.previous.articulation, self.gear.dtype)
        return PreparedActuators(drive, 1 / step.dt[..., None], self.gear * step.previous.q[..., self.coordinate], spread)

    def _drive(self, control: Tensor | None) -> Tensor:
        """gain·u + bias."""
        if control is None:
            control = self.gain.new_zeros(self.nu)
        elif control.shape[-1] != self.nu:
            raise InputError(f"control has shape {tuple(control.shape)}: must end in ({self.nu},)")
        return self.gain * _clamped(control, self.control_range) + self.bias

    def flow(self, placement: Placement, v: Tensor, control: Tensor | None) -> JointLoad:
        """See `Flowing`."""
        x, speed = self.gear * placement.q[..., self.coordinate], self.gear * v[..., self.dof]
        force = self._drive(control) - self.stiffness * x - self.damping * speed
        low, high = self.force_range.unbind(-1)
        slope = torch.where((force > low) & (force < high), self.stiffness * self.gear * self.gear, torch.zeros_like(force))
        spread = _spread(self.dof, placement.articulation, self.gear.dtype)
        force = self.gear * _clamped(force, self.force_range)
        return diagonal_load(-(force[..., None, :] @ spread).squeeze(-2), (slope[..., None, :] @ spread).squeeze(-2))

    def load(self, prepared: PreparedActuators, placement: Placement) -> JointLoad:
        moved = self.gear * placement.q[..., self.coordinate] - prepared.previous
        fall = self._yield + self.damping * prepared.inverse_dt
        force = prepared.drive - self.stiffness * prepared.previous - fall * moved
        low, high = self.force_range.unbind(-1)
        inside = (force > low) & (force < high)
        force = _clamped(force, self.force_range)
        slope = torch.where(inside, fall, torch.zeros_like(force)) * self.gear * self.gear
        spread = prepared.spread.expand(*placement.q.shape[:-1], *prepared.spread.shape)
        if self.share is not None:
            force, slope = self.share * force, self.share * slope
        residual = (-(self.gear * force)[..., None, :] @ spread).squeeze(-2)
        return JointLoad(residual, lambda: torch.diag_embed((slope[..., None, :] @ spread).squeeze(-2)))

    def energy(self, prepared: PreparedActuators, placement: Placement) -> Tensor:
        """Minus the work of all actuators from x_n on, −Σ ∫ f dx [J] `[*batch]`. The force before its limits, F(x), falls in a
        straight line of slope −g, g = stiffness + damping/Δt, and f = clamp(F): the integral over Δx = x − x_n is, with values at
        x_n marked by a zero, ½ (f − f₀)(F − f + F₀ − f₀)/g − ½ (f + f₀) Δx. Without limits only the second part is left."""
        moved = self.gear * placement.q[..., self.coordinate] - prepared.previous
        slope = self._yield + self.damping * prepared.inverse_dt
        first = prepared.drive - self.stiffness * prepared.previous
        last = first - slope * moved
        limited_first, limited_last = _clamped(first, self.force_range), _clamped(last, self.force_range)
        safe = torch.where(slope > 0, slope, torch.ones_like(slope))  # where g = 0, f = f₀
        beyond = (limited_last - limited_first) * (last - limited_last + first - limited_first) / safe
        work = 0.5 * (beyond - (limited_last + limited_first) * moved)
        return (work if self.share is None else self.share * work).sum(-1)


def _clamped(value: Tensor, bounds: Tensor) -> Tensor:
    """The value within bounds `[nu, 2]`."""
    low, high = bounds.unbind(-1)
    return torch.maximum(torch.minimum(value, high), low)


def _spread(dof: Tensor, articulation: Articulation, dtype: torch.dtype) -> Tensor:
    """`[nu, nv]` 1 where the actuator drives the degree of freedom."""
    return (dof[:, None] == torch.arange(articulation.nv, device=dof.device)).to(dtype)
