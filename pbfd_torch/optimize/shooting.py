"""Single shooting: what a motion depends on is changed until its cost is low, by exact gradients through all of its steps.

All worlds are one batch, and each is optimised by itself. A motion with an unsolved step never counts as better than one without.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic

import torch
from torch import Tensor
from torch.optim import Optimizer

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.identify.levenberg_marquardt import Stopping, levenberg_marquardt
from pbfd_torch.integrators.integrator import S
from pbfd_torch.optimize.decision import Decision, Plan
from pbfd_torch.simulator import Simulator

OfTrajectory = Callable[[Trajectory[S], Tensor | None], Tensor]
"""A differentiable function of a trajectory and its controls `[T, *batch, nu]`, each world by itself."""

Progress = Callable[[int, float], object]
"""Called after every iteration with its number and the lowest cost of the batch."""


@dataclass(frozen=True, eq=False)
class Shot(Generic[S]):
    """Where shooting ended.

    Attributes:
        x: `[*batch, n]` the best found, and the plan that follows from it.
        trajectory: of that plan; its `doubts` are complete.
        cost: `[*batch]`, infinite where no motion without unsolved steps was found.
        history: `[k + 1, *batch]` the lowest cost so far, at the start and after every iteration.
        skipped: `[*batch]` how many of the motions tried had unsolved steps or no finite cost.
        converged: `[*batch]` bool, by the test of Gauss–Newton; torch's optimisers have none.
    """

    x: Tensor
    plan: Plan[S]
    trajectory: Trajectory[S]
    cost: Tensor
    history: Tensor
    skipped: Tensor
    converged: Tensor

    @property
    def unsolved(self) -> Tensor:
        """How many steps of each world are unsolved `[*batch]`."""
        return (~self.trajectory.solved).sum(0)

    @property
    def doubtful(self) -> Tensor:
        """How many steps of each world have doubtful derivatives `[*batch]`."""
        return (self.trajectory.doubts != 0).sum(0)


@dataclass(frozen=True, eq=False)
class Shooting(Generic[S]):
    """What moves, and what may be chosen."""

    simulator: Simulator[S]
    decision: Decision[S]

    def played(self, x: Tensor) -> tuple[Plan[S], Trajectory[S]]:
        """The motion of x `[*batch, n]`."""
        plan = self.decision.plan(x)
        return plan, self.simulator.trajectory(plan.start, plan.controls, None if plan.controls is not None else plan.steps)

    def descend(
        self,
        cost: OfTrajectory[S],
        x: Tensor,
        optimiser: Callable[[Iterable[Tensor]], Optimizer],
        iterations: int,
        progress: Progress | None = None,
    ) -> Shot[S]:
        """Lowers the cost `[*batch]` from x `[*batch, n]` by one of torch's optimisers, as `lambda x: torch.optim.Adam(x, lr=0.1)`.
        There x is in units of the decision's scale, so one rate suits all, and is put back within its bounds after every iteration.
        The optimiser sees the sum of the costs: one that looks at its value, as L-BFGS does, couples the worlds."""
        if iterations < 1:
            raise InputError(f"iterations is {iterations}: must be ≥ 1")
        bounds = self.decision.bounds
        scaled = (x.detach() / bounds.scale).requires_grad_()
        search = optimiser([scaled])
        best, least = x.detach().clone(), x.new_full(x.shape[:-1], torch.inf)
        skipped = torch.zeros_like(least, dtype=torch.long)
        history: list[Tensor] = []

        def closure() -> float:
            nonlocal best, least, skipped
            search.zero_grad()
            now = bounds.scale * scaled
            plan, motion = self.played(now)
            value = cost(motion, plan.controls)
            value.sum().backward()
            assert scaled.grad is not None
            usable = motion.solved.all(0) & torch.isfinite(value) & torch.isfinite(scaled.grad).all(-1)
            scaled.grad = torch.where(usable[..., None], scaled.grad, 0.0)
            value = torch.where(usable, value.detach(), torch.inf)
            skipped = skipped + (~usable).long()
            best = torch.where((value < least)[..., None], now.detach(), best)
            least = torch.minimum(least, value)
            return float(torch.where(usable, value, 0.0).sum())

        for k in range(iterations):
            search.step(closure)
            with torch.no_grad():
                scaled.copy_((bounds.scale * scaled).clamp(bounds.lower, bounds.upper) / bounds.scale)
            history.append(least)
            if progress is not None:
                progress(k + 1, float(least.min()))
        closure()  # the last step's end has not been looked at
        history.append(least)
        return self._shot(cost, best, torch.stack(history), skipped, torch.zeros_like(least, dtype=torch.bool))

    def gauss_newton(
        self, residual: OfTrajectory[S], x: Tensor, stopping: Stopping | None = None, progress: Progress | None = None
    ) -> Shot[S]:
        """Lowers ½‖residual‖² from x `[*batch, n]`, residual `[*batch, m]`, by Levenberg–Marquardt, a damping per world. Every row
        of the Jacobian is one more copy of the worlds, all in one rollout and one pass back."""
        with torch.no_grad():
            plan, motion = self.played(x)
            m = residual(motion, plan.controls).shape[-1]
        skipped = torch.zeros(x.shape[:-1], dtype=torch.long, device=x.device)

        def linearized(now: Tensor) -> tuple[Tensor, Tensor]:
            nonlocal skipped
            copies = now.detach().expand(m, *now.shape).clone().requires_grad_()
            plan, motion = self.played(copies)
            value = residual(motion, plan.controls)
            rows = value.diagonal(dim1=0, dim2=-1)
            (jacobian,) = torch.autograd.grad(rows.sum(), copies)
            usable = motion.solved.all(0).all(0) & torch.isfinite(rows).all(-1)
            skipped = skipped + (~usable).long()
            return torch.where(usable[..., None], rows.detach(), torch.nan), jacobian.movedim(0, -2)

        fit = levenberg_marquardt(linearized, x, self.decision.bounds, stopping, progress)
        return self._shot(
            lambda motion, controls: 0.5 * residual(motion, controls).square().sum(-1), fit.x, fit.history, skipped, fit.converged
        )

    def _shot(self, cost: OfTrajectory[S], x: Tensor, history: Tensor, skipped: Tensor, converged: Tensor) -> Shot[S]:
        """The result at x; derivatives are asked for once more, which completes what is known of doubts."""
        moving = x.detach().requires_grad_()
        plan, motion = self.played(moving)
        value = cost(motion, plan.controls)
        value.sum().backward()
        value = torch.where(motion.solved.all(0) & torch.isfinite(value), value.detach(), torch.inf)
        with torch.no_grad():
            quiet = self.decision.plan(x)
        return Shot(x, quiet, motion, value, history, skipped, converged)
