"""The picture of `pbfd bench slope`: the scene, time and error against Δt, time against contacts and friction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pbfd_torch.bench.figure_6 import SCENE, STARTS, TITLES, Row
from pbfd_torch.files import write_figure
from pbfd_torch.models import chains

STYLES: Mapping[str, dict[str, Any]] = {
    "implicit-euler": {"color": "#440154", "marker": "o"},
    "implicit-euler-torch": {"color": "#440154", "marker": "o", "markerfacecolor": "white", "alpha": 0.5},
    "energy-momentum": {"color": "#35b779", "marker": "o"},
    "conventional": {"color": "#d62728", "marker": "s"},
    "mujoco-implicitfast": {"color": "0.4", "marker": "^"},
    "mujoco-implicitfast-soft": {"color": "0.65", "marker": "v"},
    "mujoco-rk4": {"color": "#31688e", "marker": "D"},
}
TIME = "wall time of the trajectory [s]"
FLOOR = 1e-9  # [m]: smaller errors are drawn here


def draw(report: Mapping[str, Any], path: Path) -> None:
    """Six panels. Raises `OSError` where the file cannot be written."""
    figure, grid = plt.subplots(2, 3, figsize=(16, 9), dpi=85, layout="constrained")
    _scene(grid[0, 0], report["picture"])
    hard = list(report["best_dt"])[-1]
    for axes, start in ((grid[0, 1], SCENE), (grid[0, 2], hard)):
        rows = [row for row in report["time_steps"] if row["start"] == start]
        _panel(axes, rows, report, "dt", f"(b) {STARTS[start].title}", "Δt [s]")
        _crosses(axes, rows)
    rows = [row for row in report["time_steps"] if row["start"] == SCENE]
    for simulator, own in _by_simulator(rows).items():
        stable = [row for row in own if row["stable"]]
        errors = [max(FLOOR, abs(row["margin_m"])) for row in stable]
        grid[1, 0].plot([row["dt"] for row in stable], errors, markersize=4, **STYLES[simulator])
    grid[1, 0].set(
        xscale="log", yscale="log", title=f"error beside it: {STARTS[SCENE].title}", xlabel="Δt [s]", ylabel="|Coulomb margin| [m]"
    )
    own_step = [row for row in report["contacts"] if row["dt"] == report["own_dt"][row["simulator"]]]
    _panel(grid[1, 1], own_step, report, "in_touch", "(c) each at its largest stable Δt", "mean number of contacts in touch")
    for law, dashes in (("Coulomb", "-"), ("PBFD", ":")):
        rows = [row for row in report["friction"] if row["law"] == law]
        _curves(grid[1, 2], rows, report["duration_s"], "mu", "1", dashes)
    grid[1, 2].axvline(math.tan(chains.SLOPE), color="0.6", linewidth=1)
    title = "(d) sticks right of the line; dotted: PBFD's law"
    grid[1, 2].set(yscale="log", title=title, xlabel="μ, or that of C∥ at 1 m/s", ylabel=TIME)
    for axes in grid.flat[1:]:
        axes.grid(alpha=0.3)
    named = [Line2D([], [], label=TITLES[key], markersize=5, **STYLES[key]) for key in _by_simulator(report["time_steps"])]
    named.append(Line2D([], [], color="0.3", linestyle="--", label=f"per world of {report['worlds']}"))
    named.append(Line2D([], [], color="0.3", marker="x", linestyle="", label="unstable or NaN"))
    figure.legend(handles=named, loc="outside lower center", ncols=8, frameon=False)
    figure.suptitle(f"Fig. 6: a chain of ten links slides off a slope, {report['duration_s']:g} s", fontsize=13)
    write_figure(path, figure)
    plt.close(figure)


def _by_simulator(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row["simulator"], []).append(row)
    return found


def _panel(axes: Axes, rows: Sequence[Row], report: Mapping[str, Any], along: str, title: str, label: str) -> None:
    """Stable runs: one world, and dashed the batch."""
    for worlds, dashes in (("1", "-"), (str(report["worlds"]), "--")):
        _curves(axes, rows, report["duration_s"], along, worlds, dashes)
    axes.set(xscale="log", yscale="log", title=title, xlabel=label, ylabel=TIME)


def _curves(axes: Axes, rows: Sequence[Row], duration: float, along: str, worlds: str, dashes: str) -> None:
    for simulator, own in _by_simulator(rows).items():
        shown = [row for row in own if row["stable"] and worlds in row["ms_per_s"]]
        axes.plot(
            [row[along] for row in shown],
            [1e-3 * duration * row["ms_per_s"][worlds] for row in shown],
            linestyle=dashes,
            markersize=4,
            **STYLES[simulator],
        )


def _crosses(axes: Axes, rows: Sequence[Row]) -> None:
    """Unstable runs, at the top, one line for each simulator."""
    for k, (simulator, own) in enumerate(_by_simulator(rows).items()):
        failed = [row["dt"] for row in own if not row["stable"]]
        height = [0.985 - 0.025 * k] * len(failed)
        axes.plot(failed, height, linestyle="", marker="x", color=STYLES[simulator]["color"], transform=axes.get_xaxis_transform())


def _scene(axes: Axes, pictures: Sequence[Row]) -> None:
    """The chain at several times, and the ground."""
    colors = plt.get_cmap("viridis")
    for k, picture in enumerate(pictures):
        color = colors(k / max(1, len(pictures) - 1))
        axes.plot(picture["x_m"], picture["z_m"], color=color, linewidth=2.5, marker="o", markersize=2.5)
        axes.annotate(
            f"{picture['time_s']:g} s", (picture["x_m"][-1], picture["z_m"][-1]), xytext=(4, 4), textcoords="offset points"
        )
    low, high = axes.get_xlim()
    axes.plot([low, high], [-math.tan(chains.SLOPE) * x for x in (low, high)], color="0.4", linewidth=1)
    axes.set(title=f"(a) {STARTS[SCENE].title}; μ = {chains.SLOPE_FRICTION:g}", xlabel="[m]", ylabel="[m]", aspect="equal")
