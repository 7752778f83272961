"""Plots beside the scene, each of a quantity that is chosen there, with a line at the current time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

import numpy as np
import viser
from viser import uplot

from pbfd_torch.viewer.film import Film
from pbfd_torch.viewer.series import Curve, Curves, quantities

COLORS = ("#1f6aa5", "#e8861e", "#2f9e58", "#8b5cd6", "#b5467c", "#6b7280", "#0e9aa7")
_NOW = "#d6192b"
_PAUSE = 0.1  # [s] between two moves of the line at least: a plot is sent whole every time


class Plot:
    """One plot. The ghost's curves, where there is one, are drawn dashed."""

    def __init__(self, gui: viser.GuiApi, film: Film, ghost: Film | None, first: str) -> None:
        self._gui = gui
        self._choices = quantities(film)
        self._others: Mapping[str, Callable[[int], Curves]] = {} if ghost is None else quantities(ghost)
        self._ghost_worlds = 0 if ghost is None else ghost.worlds
        self._choice = gui.add_dropdown("Plot", tuple(self._choices), initial_value=first)
        self._handle: viser.GuiUplotHandle | None = None
        self._world, self._now, self._moved = 0, 0.0, 0.0
        self._draw()

        @self._choice.on_update
        def _(_: object) -> None:
            self._draw()

    def turn_to(self, world: int) -> None:
        """Plots another world."""
        if world != self._world:
            self._world = world
            self._draw()

    def move(self, now: float, patient: bool) -> None:
        """Moves the line to a time [s]; patient: not if it has just been moved."""
        self._now = now
        if self._handle is not None and not (patient and time.perf_counter() - self._moved < _PAUSE):
            self._moved = time.perf_counter()
            self._handle.data = self._data()

    def _draw(self) -> None:
        name = self._choice.value
        self._curves = self._choices[name](self._world)
        self._lines = dict(self._curves.lines)
        if name in self._others and self._world < self._ghost_worlds:
            other = self._others[name](self._world)
            for label, values in other.lines.items():
                if label in self._lines:
                    beside = np.interp(self._curves.time, other.time, values, right=math.nan)
                    self._lines[f"{label}, ghost"] = beside
        finite = np.concatenate([y[np.isfinite(y)] for y in self._lines.values()])
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
        margin = 0.05 * (high - low) or max(0.05 * abs(high), 1e-12)
        self._low, self._high = low - margin, high + margin
        series = [uplot.Series(label="s")]
        for label in self._lines:
            mine = list(self._curves.lines).index(label.removesuffix(", ghost"))
            dash = (4, 4) if label.endswith(", ghost") else ()
            series.append(uplot.Series(label=label, stroke=COLORS[mine % len(COLORS)], width=1.5, dash=dash, spanGaps=True))
        series.append(uplot.Series(label="now", stroke=_NOW, width=1.5))
        whole = float(self._curves.time[0]), float(self._curves.time[-1])
        scales = {
            "x": uplot.Scale(time=False, auto=False, min=whole[0], max=max(whole[1], whole[0] + 1e-9)),
            "y": uplot.Scale(auto=False, min=self._low, max=self._high),
        }
        if self._handle is not None:
            self._handle.remove()
        self._handle = self._gui.add_uplot(
            self._data(), tuple(series), scales=scales, aspect=1.9, order=self._choice.order + 0.5,
            legend=uplot.Legend(show=True),
        )  # fmt: skip

    def _data(self) -> tuple[Curve, ...]:
        """All curves over the same times, with the two ends of the line put in at the current one."""
        at = np.searchsorted(self._curves.time, self._now)
        gap = (math.nan, math.nan)
        time_and_line = np.insert(self._curves.time, at, (self._now, self._now))
        line = np.insert(np.full(len(self._curves.time), math.nan), at, (self._low, self._high))
        return (time_and_line, *(np.insert(y, at, gap) for y in self._lines.values()), line)
