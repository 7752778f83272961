"""The learning curve: one row per batch as CSV, and its picture."""

from __future__ import annotations

import csv
import io
import math
import reprlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.files import write_figure, write_whole
from pbfd_torch.learning.numbers import require_integer

_COUNTS = ("frames", "episodes")


@dataclass(frozen=True)
class Row:
    """What a batch has shown.

    Attributes:
        frames: environment steps so far.
        seconds: of training so far.
        episodes: that ended in this batch.
        mean_return, lowest_return, highest_return, mean_length: of these; NaN where there are none.
        reward: mean per step.
        unsolved: share of steps without a solution.
        loss: of the last update.
    """

    frames: int
    seconds: float
    episodes: int
    mean_return: float
    lowest_return: float
    highest_return: float
    mean_length: float
    reward: float
    unsolved: float
    loss: float


def of_episodes(returns: Tensor, lengths: Tensor) -> dict[str, Any]:
    """A row's entries on the episodes `[n]` that ended."""
    if not len(returns):
        return {"episodes": 0} | dict.fromkeys(("mean_return", "lowest_return", "highest_return", "mean_length"), math.nan)
    return {
        "episodes": len(returns),
        "mean_return": float(returns.mean()),
        "lowest_return": float(returns.min()),
        "highest_return": float(returns.max()),
        "mean_length": float(lengths.mean()),
    }


def save(rows: Sequence[Row], path: Path) -> None:
    """The whole curve, or the old file stays."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(Row.__dataclass_fields__))
    writer.writeheader()
    writer.writerows(
        {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in asdict(r).items()} for r in rows
    )
    write_whole(path, text.getvalue())


def load(path: Path) -> list[Row]:
    """What `save` wrote."""
    with path.open(newline="") as file:
        return [_row(row) for row in csv.DictReader(file)]


def rows_of(saved: object) -> list[Row]:
    """The rows that `asdict` has made plain. Raises `InputError` naming the row and the entry that are none."""
    if not isinstance(saved, list):
        raise InputError(f"rows is {reprlib.repr(saved)}: must be a list")
    for k, row in enumerate(saved):
        if not isinstance(row, dict) or set(row) != set(Row.__dataclass_fields__):
            raise InputError(f"rows[{k}] is {reprlib.repr(row)}: must have the entries {', '.join(Row.__dataclass_fields__)}")
        for name, value in row.items():
            if name in _COUNTS:
                require_integer(f"rows[{k}].{name}", value, 0, 2**63 - 1)
            elif not isinstance(value, float):  # NaN where there is nothing to average
                raise InputError(f"rows[{k}].{name} is {reprlib.repr(value)}: must be a number")
    return [Row(**row) for row in saved]


def _row(row: Mapping[str, str]) -> Row:
    numbers: dict[str, Any] = {k: int(v) if k in _COUNTS else float(v) for k, v in row.items()}
    return Row(**numbers)


def trailing(rows: Sequence[Row], episodes: int = 64) -> list[float]:
    """Mean return of the last episodes up to each row, at least so many or all there have been; NaN before the first. A batch alone
    may end a handful of episodes only, short ones more often than long ones."""
    kept: deque[Row] = deque()
    count, total = 0, 0.0
    means: list[float] = []
    for row in rows:
        if row.episodes:
            kept.append(row)
            count, total = count + row.episodes, total + row.episodes * row.mean_return
        while kept and count - kept[0].episodes >= episodes:
            old = kept.popleft()
            count, total = count - old.episodes, total - old.episodes * old.mean_return
        means.append(total / count if count else math.nan)
    return means


def draw(curves: Mapping[str, Sequence[Row]], path: Path, title: str) -> None:
    """Mean return over environment steps and over time, `trailing`, each curve with the range of its batches' episodes."""
    figure = Figure(figsize=(11, 4.2), dpi=130, layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for k, (name, rows) in enumerate(curves.items()):
        ended = [row for row in rows if row.episodes]
        if not ended:
            continue
        values = np.array(trailing(ended))
        low, high = (np.array([getattr(row, what) for row in ended]) for what in ("lowest_return", "highest_return"))
        for axis, x in zip(axes, ([r.frames for r in ended], [r.seconds / 60 for r in ended]), strict=True):
            axis.plot(x, values, color=f"C{k}", label=name)
            axis.fill_between(x, low, high, color=f"C{k}", alpha=0.15, linewidth=0)
    axes[0].set(xlabel="environment steps", ylabel="return of the last 64 episodes", title=title)
    axes[1].set(xlabel="minutes of training")
    for axis in axes:
        axis.grid(alpha=0.3)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="upper left")
    write_figure(path, figure)
