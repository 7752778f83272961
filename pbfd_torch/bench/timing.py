"""Wall time of a call, and how a cost grows with size."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")

Clock = Callable[[], float]  # [s]
Progress = Callable[[int], object]  # told how many more units of work are done


def timed(
    prepare: Callable[[], Callable[[], T]], repeats: int, enough_s: float = 0.03, clock: Clock = time.perf_counter
) -> tuple[T, float]:
    """The first result and the shortest time [s], by default on the wall, of up to `repeats` calls, no more once they have taken
    `enough_s` together: what else the machine does only ever adds time. prepare: makes each call, untimed."""
    results: list[T] = []
    times: list[float] = []
    while not times or (len(times) < repeats and sum(times) < enough_s):
        call = prepare()
        start = clock()
        result = call()
        times.append(clock() - start)
        results.append(result)
        del results[1:]
    return results[0], min(times)


def worst(values: Sequence[float]) -> float:
    """The largest value; NaN where any is not finite, which `max` may pass over."""
    return max(values) if all(map(math.isfinite, values)) else math.nan


def fit_sizes(sizes: Sequence[int]) -> list[int]:
    """The larger half of the sizes, at least two: where the cost per operation no longer hides the growth."""
    ascending = sorted(sizes)
    return ascending[-max(2, math.ceil(len(ascending) / 2)) :]


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """p of cost ∝ size^p, by least squares in log–log."""
    return statistics.linear_regression([math.log(x) for x in sizes], [math.log(x) for x in costs]).slope
