"""Dynamic programming along a motion: the best small change of its controls, within limits, and the feedback about it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.optimize.box_qp import box_minimum
from pbfd_torch.optimize.costs import Expansion

LEAST, MOST, FACTOR = 1e-3, 1e9, 2.0  # of the regularisation, and by what its rate of change grows


@dataclass(frozen=True, eq=False)
class Policy:
    """u = clamp(u_k + α step_k + feedback_k δx) with δx the way from the motion's state in its `Chart`.

    Attributes:
        step: `[T, *batch, nu]`; feedback: `[T, *batch, nu, nx]`, zero for controls that a limit holds.
        slope, curvature: `[*batch]` of the foreseen cost along α.
    """

    step: Tensor
    feedback: Tensor
    slope: Tensor
    curvature: Tensor

    def foreseen(self, lengths: Tensor) -> Tensor:
        """Decrease of the cost `[len(lengths), *batch]` at α in lengths `[n]`."""
        a = lengths.reshape(-1, *(1,) * self.slope.ndim)
        return -a * (self.slope + a * self.curvature)


@dataclass(frozen=True, eq=False)
class Regularisation:
    """What is added to the diagonal of the controls' Hessian, as a multiple of it, `[*batch]`, and how fast that changes: as in
    Tassa, Erez & Todorov (2012), but free of units."""

    size: Tensor
    rate: Tensor

    @staticmethod
    def none(like: Tensor) -> Regularisation:
        """None yet, for worlds `[*batch]`."""
        return Regularisation(torch.zeros_like(like), torch.ones_like(like))

    def after(self, fine: Tensor, poor: Tensor) -> Regularisation:
        """The next one: smaller in worlds `[*batch]` whose step was fine, larger where it was poor."""
        rate = torch.where(fine, (self.rate / FACTOR).clamp_max(1 / FACTOR), self.rate)
        rate = torch.where(poor, (self.rate * FACTOR).clamp_min(FACTOR), rate)
        size = torch.where(fine, self.size * rate, torch.where(poor, (self.size * rate).clamp_min(LEAST), self.size))
        return Regularisation(torch.where(size < LEAST, torch.zeros_like(size), size), rate)

    @property
    def active(self) -> Tensor:
        """`[*batch]`: steps are shorter than the expansion asks for."""
        return self.size > 0

    @property
    def exhausted(self) -> Tensor:
        """`[*batch]`: no step however short lowers the cost."""
        return self.size > MOST


def backward_pass(
    A: Tensor, B: Tensor, running: Expansion, final: Expansion, left: tuple[Tensor, Tensor], regularisation: Tensor
) -> Policy:
    """Of the linear system A `[T, *batch, nx, nx]`, B `[T, *batch, nx, nu]` with costs of its steps, expanded by (x, u), and of its
    end. left: how far the controls are from their lower and upper limits `[T, *batch, nu]`; regularisation: `[*batch]`."""
    nx, nu = B.shape[-2:]
    gradient, hessian = final.gradient, final.hessian
    slope = curvature = torch.zeros_like(regularisation)
    steps, feedbacks = [], []
    for k in reversed(range(len(A))):
        AB = torch.cat((A[k], B[k]), -1)
        Q = running.hessian[k] + AB.mT @ hessian @ AB
        g = running.gradient[k] + (gradient[..., None, :] @ AB).squeeze(-2)
        Qxx, Qux, Quu = Q[..., :nx, :nx], Q[..., nx:, :nx], Q[..., nx:, nx:]
        gx, gu = g.split((nx, nu), -1)
        firm = torch.diag_embed(regularisation[..., None] * Quu.diagonal(dim1=-2, dim2=-1))
        found = box_minimum(Quu + firm, gu, left[0][k], left[1][k])
        step, feedback = found.x, -found.solve(Qux)
        steps.append(step)
        feedbacks.append(feedback)
        bent = (Quu @ step[..., None]).squeeze(-1)
        slope = slope + (step * gu).sum(-1)
        curvature = curvature + 0.5 * (step * bent).sum(-1)
        gradient = gx + ((bent + gu)[..., None, :] @ feedback + step[..., None, :] @ Qux).squeeze(-2)
        crossed = feedback.mT @ Qux
        hessian = Qxx + feedback.mT @ Quu @ feedback + crossed + crossed.mT
        hessian = 0.5 * (hessian + hessian.mT)
    return Policy(torch.stack(steps[::-1]), torch.stack(feedbacks[::-1]), slope, curvature)
