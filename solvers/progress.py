"""Where every world of a batch stands between two rounds of a `Descent`, and in the middle of one."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pbfd_torch.solvers.directions import Model
from pbfd_torch.solvers.objective import Evaluation
from pbfd_torch.solvers.searches import Memory

AT_GUESS, AT_RETREAT, SEARCHING = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Progress:
    """Where every world stands, all `[*batch, …]`: at q, about to evaluate `trial`, which lies at a·direction from it.

    stage: `AT_GUESS`, `AT_RETREAT` or `SEARCHING`; error: ‖r/…‖ at q; status: `Status`, of worlds that do not run any more."""

    q: Tensor
    trial: Tensor
    retreat: Tensor
    stage: Tensor
    direction: Tensor
    model: Model | None
    memory: Memory
    error: Tensor
    status: Tensor
    running: Tensor
    iterations: Tensor
    evaluations: Tensor


@dataclass(frozen=True, eq=False)
class Sighting:
    """What the worlds have found at their trials, before they decide how to go on.

    progress: with those ended that have arrived or are lost. error: ‖r/…‖ at the trials. retreating: who leaves its guess for the
    retreat; usable: whose trial may be gone on from."""

    progress: Progress
    evaluation: Evaluation
    error: Tensor
    retreating: Tensor
    usable: Tensor
