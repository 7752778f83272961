"""The lock-step schedule: all worlds of a batch iterate until the last one is done.

Finished worlds are masked; when at most half of the lanes still run, the others are compacted away. That changes no world's
numbers: each one sees only itself.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from pbfd_torch.solvers.objective import FALLBACKS, Objective, Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.solvers.progress import Progress, Sighting

FEWEST_LANES = 8  # below this a round costs the same however few worlds it serves


class Rounds(Protocol):
    """What is to be repeated: a `Descent`."""

    def begin(self, objective: Objective, guess: Tensor, retreat: Tensor | None = None) -> Progress:
        """All worlds at their guess, all of them running."""
        ...

    def sight(self, objective: Objective, progress: Progress) -> Sighting:
        """The first half of a round. Worlds that do not run keep all that they have."""
        ...

    def proceed(self, objective: Objective, sighting: Sighting) -> Progress:
        """The second half."""
        ...


def lock_step(solver: Rounds, objective: Objective, guess: Tensor, retreat: Tensor | None) -> Solution:
    """Runs the solver's rounds until no world runs any more. In the middle of each the host asks how many still do: the last round
    ends with its evaluation."""
    batch = guess.shape[:-1]
    progress = solver.begin(objective, guess, retreat)
    done = None  # the whole batch, flat, where `progress` holds only the worlds of `lanes`
    lanes = torch.arange(batch.numel(), device=guess.device)
    running, count = progress.running, batch.numel()  # who ran when the host last asked, and how many
    spent = 0
    while count > 0:
        if count <= len(lanes) // 2 and len(lanes) > FEWEST_LANES:
            if done is None:
                done = progress = mapped(lambda x: x.reshape(batch.numel(), *x.shape[len(batch) :]), progress)
            done = _scattered(done, progress, lanes)
            inside = _positions(running.reshape(-1), count)
            objective, progress = objective.take(inside), mapped(lambda x: x[inside], progress)  # noqa: B023
            lanes = lanes[inside]
        sighting = solver.sight(objective, progress)
        spent += len(lanes)
        progress = sighting.progress
        running, count = progress.running, int(progress.running.sum())
        if count > 0:
            progress = solver.proceed(objective, sighting)
            # Who gives up in it is known at once in the host's own memory. Asking a device again would make the host wait: there
            # such worlds are carried through one more round, which leaves them as they are.
            if progress.running.device.type == "cpu":
                running, count = progress.running, int(progress.running.sum())
    if done is not None:
        progress = _scattered(done, progress, lanes)
    return solution(progress, guess, spent)


def solution(progress: Progress, guess: Tensor, lanes: int) -> Solution:
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


def _positions(where: Tensor, count: int) -> Tensor:
    """Positions `[count]` of the true among `where` `[n]`, in their order. `nonzero` would wait to learn how many they are."""
    return where.to(torch.uint8).sort(descending=True, stable=True).indices[:count]


def _scattered(whole: Any, part: Any, index: Tensor) -> Any:
    return mapped(lambda w, p: w.index_copy(0, index, p), whole, part)
