"""The picture of `pbfd bench speed`: control steps a second over worlds, and the error beside the time of a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pbfd_torch.bench.speed_table import Row, finite
from pbfd_torch.files import write_figure

FLOOR = 1e-12  # [m]: smaller errors are drawn here
STYLES: Mapping[tuple[str, str], dict[str, Any]] = {
    ("native", "float64"): {"color": "#000000", "marker": "o"},
    ("native", "float32"): {"color": "#d62728", "marker": "o"},
    ("torch", "float64"): {"color": "#e8a400", "marker": "s"},
    ("torch", "float32"): {"color": "#8c564b", "marker": "s"},
    ("mujoco-implicitfast", "float64"): {"color": "0.4", "marker": "^"},
    ("mujoco-discrete", "float64"): {"color": "#17becf", "marker": "v"},
    ("mujoco-rk4", "float64"): {"color": "#1f77b4", "marker": "D"},
}


def draw(report: Mapping[str, Any], path: Path) -> None:
    """A column for each scene. Raises `OSError` where the file cannot be written."""
    names = list(report["scenes"])
    figure, grid = plt.subplots(2, len(names), figsize=(max(9.0, 4 * len(names)), 8), dpi=90, layout="constrained", squeeze=False)
    for (above, below), name in zip(grid.T, names, strict=True):
        rows = [row for row in report["rows"] if row["scene"] == name and finite(row["control_steps_per_s"])]
        _rates(above, rows)
        above.set_title(f"{name}, {report['scenes'][name]['dt_s']:g} s")
        _errors(below, rows)
        for reference in report["scenes"][name]["references"].values():
            below.axhline(max(FLOOR, reference["uncertainty_m"]), color="0.6", linewidth=0.8, linestyle=":")
    handles = [Line2D([], [], label=" ".join(key), markersize=5, **style) for key, style in STYLES.items()]
    handles.append(Line2D([], [], color="0.3", linestyle="--", alpha=0.5, label="all threads"))
    handles.append(Line2D([], [], color="0.6", linestyle=":", label="± of a reference of its own"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(5, 2 + len(names)), frameon=False)
    figure.suptitle("Control steps a second over worlds, and error beside the time of a step, one thread", fontsize=13)
    write_figure(path, figure)
    plt.close(figure)


def _rates(axes: Axes, rows: Sequence[Row]) -> None:
    for (engine, dtype), style in STYLES.items():
        mine = [row for row in rows if (row["engine"], row["dtype"]) == (engine, dtype)]
        for several, line in ((False, {}), (True, {"linestyle": "--", "alpha": 0.5})):
            shown = [row for row in mine if (row["threads"] > 1) == several]
            x, y = [row["worlds"] for row in shown], [row["control_steps_per_s"] for row in shown]
            axes.plot(x, y, **{"markersize": 4, "linewidth": 1.3, **style, **line})
    axes.set(xscale="log", yscale="log", xlabel="worlds", ylabel="control steps/s")
    axes.grid(alpha=0.3)


def _errors(axes: Axes, rows: Sequence[Row]) -> None:
    """In the largest batch."""
    most = max((row["worlds"] for row in rows), default=1)
    for row in rows:
        if row["worlds"] == most and row["threads"] == 1 and finite(row["error_m"]):
            style = STYLES[row["engine"], row["dtype"]]
            axes.plot([row["us_per_step"]], [max(FLOOR, row["error_m"])], linestyle="", markersize=7, **style)
    axes.set(xscale="log", yscale="log", xlabel=f"µs a control step, {most} worlds", ylabel="error [m]")
    axes.margins(0.15)
    axes.grid(alpha=0.3)
