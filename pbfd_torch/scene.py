"""The scene: an articulation, everything that acts on it, and where it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import kinetic_energy, mass_matrix, potential_energy, rotor_energy
from pbfd_torch.checked import Array, as_tensor, broadcast_batches, require_bounded, require_shape
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.errors import InputError, ModelError
from pbfd_torch.looks.appearance import Visual
from pbfd_torch.tensors.worlds import Census, Worlds, replaced
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.load import Conservative, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.bounds import FARTHEST, FASTEST, SHORTEST_QUATERNION
from pbfd_torch.tree.kinematics import Motion, Placement, place


@dataclass(frozen=True, eq=False)
class Scene:
    """An articulation, everything that acts on it, and where it is. What is not in `terms` costs nothing.

    Attributes:
        articulation: the bodies.
        terms: physical effects; `Inertia()` must be among them.
        gravity: `[3]` or `[*batch, 3]` [m/s²].
        colliders, obstacles: geometry, for pictures and records; the contact terms hold what they need of it.
        name: for records.
        visuals: gives what links look like, where that is not what touches; called when a record ends.
    """

    articulation: Articulation
    terms: Sequence[Term]
    gravity: Tensor
    colliders: Sequence[Collider] = ()
    obstacles: Sequence[HalfSpace | Obstacle] = ()
    name: str = "scene"
    visuals: Callable[[], Sequence[Visual]] = tuple

    def __post_init__(self) -> None:
        a = self.articulation
        if not any(isinstance(term, Inertia) for term in self.terms):
            raise InputError("terms hold no Inertia(): nothing would resist the forces")
        if self.gravity.shape[-1:] != (3,) or not bool(torch.isfinite(self.gravity).all()):
            raise InputError(f"gravity is {self.gravity.tolist()}: must be finite with last dimension 3")
        if self.gravity.dtype != a.dtype or self.gravity.device != a.device:
            raise InputError(f"gravity is {self.gravity.dtype} on {self.gravity.device}: must be {a.dtype} on {a.device}")
        inertia = mass_matrix(a, a.rest, self.terms).detach().diagonal(dim1=-2, dim2=-1).reshape(-1, a.nv).amin(0)
        for i, joint in enumerate(a.topology.dof_joints):
            if not float(inertia[i]) > 0:
                raise ModelError(
                    "nothing that it moves has any inertia about its axis, and it has no armature",
                    element=f"joint '{a.joint_names[joint]}'",
                )

    def potential_energy(self, placement: Placement, time: Tensor) -> Tensor:
        """Stored energy [J] `[*batch]` at a time [s]: gravity, springs, limits and the contacts' normal forces."""
        total = potential_energy(placement, self.gravity)
        for term in self.terms:
            if isinstance(term, Conservative):
                total = total + term.potential(placement, time)
        return total

    def energy(self, q: Tensor, v: Tensor) -> Tensor:
        """Kinetic plus stored energy [J] `[*batch]` at time 0, at q `[*batch, nq]` and velocity v `[*batch, nv]`."""
        placement = place(self.articulation, q)
        rates = Motion(placement, v).rates
        return (
            kinetic_energy(self.articulation, rates)
            + rotor_energy(self.articulation, v, self.terms)
            + self.potential_energy(placement, torch.zeros_like(q[..., 0]))
        )

    @property
    def nu(self) -> int:
        """Length of the control vector."""
        return sum(term.nu for term in self.terms if isinstance(term, Actuators))

    def placed(self, q: Array | None, v: Array | None) -> tuple[Tensor, Tensor]:
        """Configuration `[*batch, nq]` and velocity `[*batch, nv]` of all worlds, quaternions at unit norm, from those given for
        one or for all; None: the rest configuration, and rest. Raises `InputError` for wrong shapes, dtypes or devices, for NaN and
        infinity, for coordinates beyond `FARTHEST` and velocities beyond `FASTEST` (`tree.bounds`), and for quaternions of no
        length."""
        a = self.articulation
        q = a.rest if q is None else self._checked(q, a.nq, "q", FARTHEST, "m or rad")
        v = q.new_zeros((*q.shape[:-1], a.nv)) if v is None else self._checked(v, a.nv, "v", FASTEST, "m/s or rad/s")
        length = torch.linalg.vector_norm(q.detach()[..., a.topology.turning_q], dim=-1)
        if not bool((length >= SHORTEST_QUATERNION).all()):
            raise InputError(
                f"q holds a quaternion of length {float(length.min()):g}: must be ≥ {SHORTEST_QUATERNION:g}, and is scaled to 1"
            )
        batch = broadcast_batches(
            {
                "q": q.shape[:-1],
                "v": v.shape[:-1],
                "gravity": self.gravity.shape[:-1],
                "masses": a.pseudo_inertia.shape[:-3],
                "frames": place(a, a.rest).poses.shape[:-3],
            }
        )
        for term in self.terms:
            census = Census()
            term.take(census)
            for shape in census.shapes:
                broadcast_batches({"q and v": batch, f"the {type(term).__name__}": shape})
        return a.topology.normalized(q.expand(*batch, a.nq)), v.expand(*batch, a.nv)

    def _checked(self, value: Array, length: int, name: str, most: float, unit: str) -> Tensor:
        tensor = as_tensor(name, value, self.articulation.dtype, self.articulation.device)
        require_shape(name, tensor, (length,))
        require_bounded(name, tensor, most, unit)
        return tensor

    def controlled(self, control: Array | None, batch: Sequence[int]) -> Tensor | None:
        """The control of a step `[*batch, nu]`, given for one world or for all. Its numbers are not looked at: a world with NaN or
        infinity stands still. Raises `InputError` for wrong shapes, dtypes or devices."""
        if control is None:
            return None
        a = self.articulation
        tensor = as_tensor("control", control, a.dtype, a.device)
        require_shape("control", tensor, (self.nu,))
        if broadcast_batches({"control": tensor.shape[:-1], "the state": batch}) != tuple(batch):
            raise InputError(
                f"control has shape {tuple(tensor.shape)}: must be {(*batch, self.nu)}, or {(self.nu,)} for all worlds"
            )
        return tensor

    def step_count(self, controls: Tensor | None, steps: int | None) -> int:
        """Of a rollout with these controls, or without any; raises `InputError` where the two do not agree."""
        if controls is None:
            if steps is None or steps < 1:
                raise InputError(f"steps is {steps}: must be ≥ 1 where there are no controls")
            return steps
        if controls.ndim < 2 or controls.shape[-1] != self.nu or len(controls) == 0:
            raise InputError(f"controls have shape {tuple(controls.shape)}: must be [steps ≥ 1, *batch, {self.nu}]")
        if steps is not None and steps != len(controls):
            raise InputError(f"steps is {steps} but there are {len(controls)} controls: give one of the two")
        return len(controls)

    def take(self, worlds: Worlds) -> Scene:
        """The same scene with the parameters of some worlds."""
        terms = tuple(term.take(worlds) for term in self.terms)
        return replaced(self, articulation=self.articulation.take(worlds), terms=terms, gravity=worlds.pick(self.gravity, 1))
