"""Rollouts on several CPU cores: the worlds are split over worker processes, each of which steps its own on a single thread.

No world waits for one of another worker, and the numbers are those of a single process. Processes, because the threads of one
Python process take turns between PyTorch's small operations: split over two threads a rollout was slower than on one.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from types import TracebackType
from typing import Any, Protocol, Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.integrators.integrator import State
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.tensors.worlds import Worlds


class Simulated(Protocol):
    """What has a stepper, and knows how its rollouts are made: a `Simulator`."""

    @property
    def stepper(self) -> Stepper[Any]: ...

    @property
    def roller(self) -> Callable[..., Rollout]: ...


class Workers:
    """`count` ≥ 1 processes that stay ready between rollouts; a context manager. They are started afresh and import the calling
    script, so a script that uses them must guard its own start with `if __name__ == "__main__":`."""

    def __init__(self, count: int) -> None:
        if count < 1:
            raise InputError(f"count is {count}: must be ≥ 1")
        self.count = count
        fresh = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, mp_context=fresh, initializer=torch.set_num_threads, initargs=(1,))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._pool.shutdown(cancel_futures=True)

    def rollout(self, simulator: Simulated, state: State, controls: Tensor | None = None, steps: int | None = None) -> Rollout:
        """As `Simulator.rollout`, for a batch `[worlds]` on the CPU with at least as many worlds as workers; else `InputError`."""
        if state.q.ndim != 2 or state.q.device.type != "cpu":
            raise InputError(f"q has shape {tuple(state.q.shape)} on {state.q.device}: must be [worlds, nq] on the CPU")
        worlds = len(state.q)
        if worlds < self.count:
            raise InputError(f"{worlds} worlds for {self.count} workers: must be at least one each")
        futures = []
        for index in torch.arange(worlds).tensor_split(self.count):
            part = Worlds((worlds,), index)
            held = None if controls is None else controls.expand(-1, worlds, -1)[:, index]
            futures.append(self._pool.submit(simulator.roller, simulator.stepper.take(part), state.take(part), held, steps))
        return _joined([future.result() for future in futures])


def _joined(parts: list[Rollout]) -> Rollout:
    """Worlds side by side."""
    fields: dict[str, Any] = {"time": parts[0].time, "lanes": torch.stack([part.lanes for part in parts]).sum()}
    for field in dataclasses.fields(Rollout):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], Tensor) and field.name not in fields:
            fields[field.name] = torch.cat(values, 1)
    return dataclasses.replace(parts[0], **fields)
