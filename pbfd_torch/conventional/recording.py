"""Builds the record of a Newton–Euler rollout, step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import potential_energy
from pbfd_torch.records.recording import Records
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.load import Conservative
from pbfd_torch.tree.kinematics import Motion, Placement, place


@dataclass(frozen=True, eq=False)
class Touched:
    """One contact term in one step: what it prepared, and the mean force `[*batch, npoint, 3]` [N] on each candidate."""

    contact: Contact
    prepared: Any
    force: Tensor


class Recorder(Records):
    """The record of a `NewtonEuler`."""

    def __init__(self, scene: Scene, dt: float, q: Tensor, v: Tensor, time: Tensor) -> None:
        super().__init__(scene, dt, time)
        self._springs = [x for x in scene.terms if isinstance(x, Conservative) and not isinstance(x, Contact | JointLimits)]
        self._begin(self._state(place(scene.articulation, q), v, time))

    def _state(self, placement: Placement, v: Tensor, time: Tensor) -> dict[str, Tensor]:
        stored = potential_energy(placement, self._scene.gravity)
        for term in self._springs:
            stored = stored + term.potential(placement, time)
        return self._seen(placement, v, Motion(placement, v).rates, stored)

    def record(self, q: Tensor, v: Tensor, time: Tensor, solution: Solution, touched: list[Touched]) -> None:
        """One step: the state after it, how it was solved, and its contacts where they are then."""
        placement = place(self._scene.articulation, q)
        at = [x.contact.touching(x.prepared, placement) for x in touched]
        none = q.new_zeros((*q.shape[:-1], 0, 3))
        entries = self._state(placement, v, time) | {
            "hazards": torch.zeros_like(solution.status),
            "suspect": torch.full_like(solution.status, -1),
            "contact_point": torch.cat([none, *(x.points for x in at)], -2),
            "contact_depth": torch.cat([none[..., 0], *(x.depth for x in at)], -1),
            "contact_normal": torch.cat([none, *(x.normal for x in at)], -2),
            "contact_force": torch.cat([none, *(x.force for x in touched)], -2),
            "contact_slip": torch.cat([none, *(x.slip for x in at)], -2),
        }
        self._add(solution, entries)
