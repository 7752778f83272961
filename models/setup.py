"""A named scene ready to run: what, from where, for how long, and which numbers to report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene

Metric = float | list[float]


def nothing(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
    """The report of a scene without numbers of its own; not a lambda, so that setups can be pickled."""
    return {}


@dataclass(frozen=True, eq=False)
class Setup:
    """Attributes:
    scene: what is simulated.
    q, v: start `[worlds, nq]`, `[worlds, nv]`.
    duration: [s] that the scene is meant to run.
    dt: step [s] that suits it.
    report: (setup, rollout) → named numbers, a list having one entry per world; see `metrics`.
    notes: what a reader of the result should know.
    control: `[nu]` held throughout, or None for zero.
    """

    scene: Scene
    q: Tensor
    v: Tensor
    duration: float
    dt: float
    report: Callable[[Setup, Rollout], Mapping[str, Metric]] = nothing
    notes: Sequence[str] = ()
    control: Tensor | None = None

    def metrics(self, rollout: Rollout) -> dict[str, Metric]:
        """The scene's own numbers for a rollout from this setup."""
        return dict(self.report(self, rollout))

    def controls(self, steps: int) -> Tensor:
        """The control of every step and world, `[steps, worlds, nu]`."""
        held = self.q.new_zeros(self.scene.nu) if self.control is None else self.control
        return held.expand(steps, self.worlds, self.scene.nu)

    @property
    def worlds(self) -> int:
        return len(self.q)


def repeated(row: Tensor, worlds: int) -> Tensor:
    """`[n] → [worlds, n]`, a copy."""
    return row.expand(worlds, -1).clone()


def tilted(angle: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Quaternion of a rotation by `angle` [rad] about +y: a body along +x dips its far end for angles > 0."""
    half = torch.tensor(0.5 * angle, dtype=dtype, device=device)
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, torch.sin(half), zero))
