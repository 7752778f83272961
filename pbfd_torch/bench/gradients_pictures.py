"""The picture of `pbfd bench gradients`: error against time, what was measured, and apart from it what others report."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pbfd_torch.bench.gradients import DERIVATIVE
from pbfd_torch.bench.gradients_table import Row, key
from pbfd_torch.bench.precision import OURS, PEER
from pbfd_torch.files import write_figure

FLOOR = 1e-5  # smaller errors are drawn here
COLORS: Mapping[tuple[str, str], str] = {
    (OURS, "Simulator"): "#000000",
    (OURS, "EventSimulator"): "#e8a400",
    (OURS, "AdaptiveSimulator"): "#c000c0",
    (PEER, "Euler"): "#d62728",
    (PEER, "implicitfast"): "0.5",
    (PEER, "discrete"): "#17becf",
    (PEER, "RK4"): "#1f77b4",
}
LINES = (("-", "o"), ("--", "s"), (":", "^"))  # of derivatives; of one way to take differences, and another
PALETTE = ("#000000", "#d62728", "#1f77b4", "#2ca02c")  # of what others report
Curves = dict[tuple[str, str, str], list[Row]]


def draw(report: Mapping[str, Any], path: Path) -> None:
    """A panel for each problem, and one for what others report of it with a time. Raises `OSError` where the file cannot be
    written."""
    panels: list[tuple[str, Callable[[Axes], Mapping[str, Line2D]]]] = []
    for problem in report["problems"].values():
        panels.append((f"{problem['title']}\nmeasured", partial(_measured, problem=problem)))
        if any(math.isfinite(found["together_s"]) for found in problem["reported"]):
            panels.append((f"{problem['title']}\nas published, another contact model", partial(_reported, problem=problem)))
    figure, grid = plt.subplots(
        1, len(panels), figsize=(max(11.0, 6 * len(panels)), 6.6), dpi=80, layout="constrained", squeeze=False
    )
    handles: dict[str, Line2D] = {}
    for axes, (title, panel) in zip(grid[0], panels, strict=True):
        handles |= panel(axes)
        axes.set(xscale="log", yscale="log", ylabel="relative error", title=title)
        axes.margins(0.12)
        axes.grid(alpha=0.3)
    figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=4 if len(panels) > 2 else 3, frameon=False)
    figure.suptitle("Gradients: error against time, one thread; lower left is better; numbers: Δt [ms], or tolerances", fontsize=13)
    write_figure(path, figure)
    plt.close(figure)


def _measured(axes: Axes, problem: Mapping[str, Any]) -> dict[str, Line2D]:
    """One line for each curve, and what the legend has of them, by name."""
    curves: Curves = {}
    for row in problem["rows"]:
        curves.setdefault(key(row), []).append(row)
    methods = list(dict.fromkeys(method for _, _, method in curves if method != DERIVATIVE))
    handles = {}
    for (simulator, scheme, method), rows in curves.items():
        line, marker = LINES[0 if method == DERIVATIVE else 1 + methods.index(method) % 2]
        style: dict[str, Any] = {"color": COLORS[simulator, scheme], "linestyle": line, "marker": marker, "markersize": 4.5}
        shown = [row for row in rows if math.isfinite(row["error"])]
        x, y = [row["together_s"] for row in shown], [max(FLOOR, row["error"]) for row in shown]
        axes.plot(x, y, linewidth=1.3, **style)
        # of two ways to take differences the second has the same Δt
        for k in {0, len(shown) - 1} if shown and line != LINES[2][0] else ():
            _note(axes, f"{1e3 * shown[k]['dt']:.2g}", x[k], y[k], style["color"])
        name = f"{simulator} {scheme}, {method}"
        handles[name] = Line2D([], [], label=name, **style)
    for found in problem["references"].values():
        if found["relative"] > 0:
            axes.axhline(found["relative"], color="0.6", linewidth=0.8, linestyle=":")
            handles["reference"] = Line2D([], [], color="0.6", linestyle=":", label="± of a reference of its own")
    axes.set_xlabel("CPU time of motion and gradient together [s]")
    return handles


def _reported(axes: Axes, problem: Mapping[str, Any]) -> dict[str, Line2D]:
    """One line for each family; the legend is within."""
    families: dict[str, list[tuple[str, float, float]]] = {}
    for found in problem["reported"]:
        family, _, rest = found["name"].partition(", ")
        families.setdefault(family, []).append((rest, found["together_s"], max(FLOOR, found["error"])))
    for (family, points), color in zip(families.items(), PALETTE, strict=True):
        axes.plot([x for _, x, _ in points], [y for _, _, y in points], color=color, marker="o", markersize=4.5, label=family)
        for text, x, y in points:
            _note(axes, text, x, y, color)
    axes.legend(fontsize=9)
    axes.set_xlabel("time of motion and gradient together, on its authors' machine [s]")
    return {}


def _note(axes: Axes, text: str, x: float, y: float, color: str) -> None:
    axes.annotate(text, (x, y), (4, 4), textcoords="offset points", color=color, fontsize=8)
