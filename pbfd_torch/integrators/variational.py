"""The variational scheme: discrete Euler–Lagrange equations of Σ ½ ‖T_{n+1} − T_n‖² / Δt, forces at the end of the step."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.integrators.implicit_euler import ImplicitEuler, Positions
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.terms.load import StepContext
from pbfd_torch.tree.articulation import Articulation

BLENDS = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class Variational(ImplicitEuler):
    """Implicit Euler with inertial forces at the share w of the step's chord: 0 is the variational scheme, 1 the paper's. At w = 0
    it is of second order and conserves momentum, but a joint that turns by more than a radian in a step may have no solution; a
    world whose step is unsolved takes the smallest of a few larger w that solves it.

    `share`: w in [0, 1)."""

    share: float = 0.0

    @property
    def easier(self) -> Sequence[Integrator[Positions]]:
        """Larger shares, the paper's step at last."""
        return (*(Variational(w) for w in BLENDS if w > self.share), ImplicitEuler())

    def context(
        self, articulation: Articulation, state: Positions, dt: Tensor, gravity: Tensor, control: Tensor | None
    ) -> StepContext:
        """See `Integrator`."""
        step = super().context(articulation, state, dt, gravity, control)
        return dataclasses.replace(step, share=torch.full_like(step.target_q[..., 0], self.share))
