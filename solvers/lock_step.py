"""The lock-step schedule: all worlds of a batch iterate until the last one is done.

Finished worlds are masked; when at most half of the lanes still run, the others are compacted away. That changes no world's
numbers: each one sees only itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pbfd_torch.solvers.objective import FALLBACKS, Objective, Solution
from pbfd_torch.solvers.per_world import mapped

if TYPE_CHECKING:
    from pbfd_torch.solvers.descent import Descent

FEWEST_LANES = 8  # below this a round costs the same however few worlds it serves


def lock_step(solver: Descent, objective: Objective, guess: Tensor, retreat: Tensor | None) -> Solution:
    """Runs the solver's rounds until no world runs any more. Between rounds the host asks how many still do, and within them
    whether any is to go on: the last round ends with its evaluation."""
    batch = guess.shape[:-1]
    progress = solver.begin(objective, guess, retreat)
    done = None  # the whole batch, flat, where `progress` holds only the worlds of `lanes`
    lanes = torch.arange(batch.numel(), device=guess.device)
    spent = 0
    while True:
        running = int(progress.running.sum())
        if running == 0:
            break
        if running <= len(lanes) // 2 and len(lanes) > FEWEST_LANES:
            if done is None:
                done = progress = mapped(lambda x: x.reshape(batch.numel(), *x.shape[len(batch) :]), progress)
            done = _scattered(done, progress, lanes)
            inside = progress.running.nonzero().squeeze(-1)
            objective, progress = objective.take(inside), mapped(lambda x: x[inside], progress)  # noqa: B023
            lanes = lanes[inside]
        sighting = solver.sight(objective, progress)
        spent += len(lanes)
        progress = sighting.progress
        if bool(progress.running.any()):
            progress = solver.proceed(objective, sighting)
    if done is not None:
        progress = _scattered(done, progress, lanes)
    return solution(progress, guess, spent)


def solution(progress: Any, guess: Tensor, lanes: int) -> Solution:
    """What a finished progress says, in the guess's batch shape."""
    batch = guess.shape[:-1]
    count = progress.evaluations.reshape(batch)
    return Solution(
        q=progress.q.reshape(guess.shape),
        status=progress.status.reshape(batch),
        residual_norm=progress.error.reshape(batch),
        iterations=progress.iterations.reshape(batch),
        evaluations=count,
        fallbacks=count.new_zeros((*batch, len(FALLBACKS))),
        lanes=lanes,
    )


def _scattered(whole: Any, part: Any, index: Tensor) -> Any:
    return mapped(lambda w, p: w.index_copy(0, index, p), whole, part)
