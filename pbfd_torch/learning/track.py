"""A record of configurations that another simulator has made, to be looked at beside our own."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.records.recording import Records
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import FALLBACKS, Solution, Status
from pbfd_torch.tree.kinematics import Motion, place


class _Track(Records):
    """States alone: no contacts, and nothing is said of how steps were solved."""

    def add(self, q: Tensor, v: Tensor, time: Tensor) -> None:
        placement = place(self._scene.articulation, q)
        seen = self._seen(placement, v, Motion(placement, v).rates, self._scene.potential_energy(placement, time))
        if not self._entries:
            self._begin(seen)
            return
        none = torch.zeros_like(q[..., 0], dtype=torch.int32)
        solution = Solution(
            q=q,
            status=torch.full_like(none, int(Status.SOLVED)),
            residual_norm=torch.zeros_like(q[..., 0]),
            iterations=none,
            evaluations=none,
            fallbacks=none[..., None].expand(*none.shape, len(FALLBACKS)),
        )
        self._add(solution, seen | {"hazards": none, "suspect": none - 1})


def tracked(scene: Scene, dt: float, q: Tensor, v: Tensor, name: str) -> Rollout:
    """A rollout that holds configurations `[T + 1, worlds, nq]` and velocities `[T + 1, worlds, nv]` of a scene, dt [s] apart."""
    from dataclasses import replace

    track = _Track(replace(scene, name=name), dt, q.new_zeros(q.shape[1:-1]))
    with torch.no_grad():
        for k, (where, velocity) in enumerate(zip(q, v, strict=True)):
            track.add(where, velocity, torch.full_like(where[..., 0], k * dt))
    return track.finish()
