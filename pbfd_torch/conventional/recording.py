"""Builds the record of a Newton–Euler rollout, step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.dynamics import center_of_mass, kinetic_energy, momentum, potential_energy, rotor_energy
from pbfd_torch.kinematics import Motion, place
from pbfd_torch.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.load import Conservative


@dataclass(frozen=True, eq=False)
class Touched:
    """One contact term in one step: what it prepared, and the mean force `[*batch, npoint, 3]` [N] on each candidate."""

    contact: Contact
    prepared: Any
    force: Tensor


class Recorder:
    """Collects one entry per step; `finish` stacks them."""

    def __init__(self, scene: Scene, dt: float, q: Tensor, v: Tensor, time: Tensor) -> None:
        self._scene, self._dt = scene, dt
        self._entries: dict[str, list[Tensor]] = {}
        self.steps = 0
        self._lanes = 0
        self._springs = [x for x in scene.terms if isinstance(x, Conservative) and not isinstance(x, Contact | JointLimits)]
        self._add(self._state(q, v, time))

    def _add(self, entries: dict[str, Tensor]) -> None:
        for name, value in entries.items():
            self._entries.setdefault(name, []).append(value)

    def _state(self, q: Tensor, v: Tensor, time: Tensor) -> dict[str, Tensor]:
        scene = self._scene
        placement = place(scene.articulation, q)
        rates = Motion(placement, v).rates
        linear, angular = momentum(placement, rates)
        stored = potential_energy(placement, scene.gravity)
        for term in self._springs:
            stored = stored + term.potential(placement, time)
        return {
            "q": q,
            "v": v,
            "link_poses": placement.poses[..., :3, :],
            "center_of_mass": center_of_mass(placement),
            "kinetic_energy": kinetic_energy(scene.articulation, rates) + rotor_energy(scene.articulation, v, scene.terms),
            "potential_energy": stored,
            "linear_momentum": linear,
            "angular_momentum": angular,
        }

    def record(self, q: Tensor, v: Tensor, time: Tensor, solution: Solution, touched: list[Touched]) -> None:
        """One step: the state after it, how it was solved, and its contacts where they are then."""
        placement = place(self._scene.articulation, q)
        at = [x.contact.touching(x.prepared, placement) for x in touched]
        none = q.new_zeros((*q.shape[:-1], 0, 3))
        entries = self._state(q, v, time) | {
            "status": solution.status,
            "iterations": solution.iterations,
            "evaluations": solution.evaluations,
            "residual_norm": solution.residual_norm,
            "fallbacks": solution.fallbacks,
            "hazards": torch.zeros_like(solution.status),
            "substeps": torch.ones_like(solution.status),
            "contact_point": torch.cat([none, *(x.points for x in at)], -2),
            "contact_depth": torch.cat([none[..., 0], *(x.depth for x in at)], -1),
            "contact_force": torch.cat([none, *(x.force for x in touched)], -2),
        }
        self._add(entries)  # all at once, at the end: an interruption before this leaves the record as it was
        self.steps += 1
        self._lanes += solution.lanes

    def finish(self) -> Rollout:
        """The record so far."""
        stacked = {name: torch.stack(values) for name, values in self._entries.items()}
        like = stacked["q"]
        return Rollout(
            scene_name=self._scene.name,
            dt=self._dt,
            link_names=self._scene.articulation.link_names,
            joint_names=self._scene.articulation.joint_names,
            lanes=torch.tensor(self._lanes),
            time=self._dt * torch.arange(self.steps + 1, dtype=like.dtype, device=like.device),
            **stacked,
        )
