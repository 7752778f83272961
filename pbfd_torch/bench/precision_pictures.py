"""The two pictures of `pbfd bench precision`: error against time spent, and error against time step."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pbfd_torch.bench.precision import ADAPTIVE, PEER
from pbfd_torch.bench.precision_levels import Row, batch_of
from pbfd_torch.files import write_figure

FLOOR = 1e-12  # smaller errors are drawn here
COLORS = ("#000000", "#e8a400", "#2ca02c", "#d62728", "#8c564b", "#17becf")  # ours
ADAPTIVE_STYLES: Mapping[str, Mapping[str, Any]] = {
    ADAPTIVE["energy-momentum"]: {"color": "#c000c0", "marker": "*"},
    ADAPTIVE["runge-kutta"]: {"color": "#ff69b4", "marker": "*"},
}
PEER_STYLES: Mapping[str, dict[str, Any]] = {
    "Euler": {"color": "0.65", "marker": "s"},
    "implicitfast": {"color": "0.4", "marker": "^"},
    "discrete": {"color": "#17becf", "marker": "v"},
    "RK4": {"color": "#1f77b4", "marker": "D"},
}


def draw_work(report: Mapping[str, Any], path: Path) -> None:
    """Error against wall time per simulated second and world. Raises `OSError` where the file cannot be written."""

    def panel(axes: Axes, scene: Mapping[str, Any]) -> None:
        batch = batch_of(scene)
        for name, (rows, style) in _curves(scene, report["integrators"]).items():
            if name[0] == PEER:
                _curve(axes, rows, lambda row: row["ms_per_s"]["1"], style)
                continue
            _curve(axes, rows, lambda row: row["ms_per_s"][batch], style)
            _curve(axes, rows, lambda row: row["ms_per_s"]["1"], style | {"alpha": 0.35, "linestyle": "--"})
        axes.set_xlabel("wall ms per simulated s and world")

    batch = Line2D([], [], color="0.3", label=f"ours: {report['worlds']} worlds")
    alone = Line2D([], [], color="0.3", linestyle="--", alpha=0.5, label="ours: 1 world")
    _figure(report, panel, "Work and precision: one thread, float64; lower left is better", path, (batch, alone))


def draw_steps(report: Mapping[str, Any], path: Path) -> None:
    """Error against time step; crosses at the top: diverged, or left unsolved, a line of them for each integrator. Raises
    `OSError`."""

    def panel(axes: Axes, scene: Mapping[str, Any]) -> None:
        height = 0.97  # of the axes
        for rows, style in _curves(scene, report["integrators"]).values():
            _curve(axes, rows, lambda row: row["dt"], style)
            if failed := [row["dt"] for row in rows if row["diverged"] or row["unsolved_steps"]]:
                top = axes.get_xaxis_transform()
                axes.plot(failed, [height] * len(failed), color=style["color"], marker="x", linestyle="", transform=top)
                height -= 0.05
        axes.set_xlabel("Δt [s], mean of the adaptive runs'")
        axes.margins(y=0.2)  # room for the crosses

    _figure(report, panel, "Error against time step (crosses: diverged or unsolved)", path)


Curves = dict[tuple[str, str], tuple[list[Row], dict[str, Any]]]


def _curves(scene: Mapping[str, Any], integrators: list[str]) -> Curves:
    """(simulator, integrator) → its rows and how they are drawn."""
    found: Curves = {}
    for row in scene["rows"]:
        name = (row["simulator"], row["integrator"])
        found.setdefault(name, ([], _style(*name, integrators)))[0].append(row)
    return found


def _style(simulator: str, integrator: str, integrators: list[str]) -> dict[str, Any]:
    if simulator == PEER:
        return dict(PEER_STYLES[integrator])
    if integrator in ADAPTIVE_STYLES:
        return dict(ADAPTIVE_STYLES[integrator])
    return {"color": COLORS[integrators.index(integrator) % len(COLORS)], "marker": "o"}


def _curve(axes: Axes, rows: list[Row], along: Callable[[Row], float], style: Mapping[str, Any]) -> None:
    shown = [row for row in rows if not row["diverged"] and math.isfinite(row["error"])]
    errors = [max(FLOOR, row["error"]) for row in shown]
    axes.plot([along(row) for row in shown], errors, **{"markersize": 4, "linewidth": 1.3, **style})


def _figure(
    report: Mapping[str, Any],
    panel: Callable[[Axes, Mapping[str, Any]], None],
    title: str,
    path: Path,
    lines: Sequence[Line2D] = (),
) -> None:
    scenes = report["scenes"]
    across = min(3, len(scenes))
    down = math.ceil(len(scenes) / across)
    figure, grid = plt.subplots(
        down, across, figsize=(max(9.0, 5 * across), 3.8 * down + 1), dpi=90, layout="constrained", squeeze=False
    )
    for axes in grid.flat[len(scenes) :]:
        axes.set_visible(False)
    for axes, scene in zip(grid.flat, scenes.values(), strict=False):
        panel(axes, scene)
        axes.set(xscale="log", yscale="log", title=scene["title"], ylabel=f"error [{scene['unit']}]")
        axes.grid(alpha=0.3)
        for own in scene["own_references"].values():
            axes.axhline(max(FLOOR, own["uncertainty"]), color="0.6", linewidth=0.8, linestyle=":")
    styles = {name: style for scene in scenes.values() for name, (_, style) in _curves(scene, report["integrators"]).items()}
    handles = [Line2D([], [], label=" ".join(name), markersize=5, **style) for name, style in styles.items()]
    handles += lines
    handles.append(Line2D([], [], color="0.6", linestyle=":", label="± of a reference of its own"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(title, fontsize=13)
    write_figure(path, figure)
    plt.close(figure)
