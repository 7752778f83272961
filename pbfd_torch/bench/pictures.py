"""The two pictures of `pbfd bench solvers`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pbfd_torch.bench.table_1 import SUBSTEPS
from pbfd_torch.files import write_figure

# one colour per optimiser, dark on GE and light on E; the default in black
STYLES: dict[str, dict[str, Any]] = {
    "LM, E": {"color": "#9ecae1", "marker": "s"},
    "LM, GE": {"color": "#08519c", "marker": "s"},
    "JTJ-LM, E": {"color": "#fdae6b", "marker": "o"},
    "JTJ-LM, GE": {"color": "#d94801", "marker": "o"},
    "L-BFGS, E": {"color": "#a1d99b", "marker": "^"},
    "L-BFGS, GE": {"color": "#006d2c", "marker": "^"},
    "default": {"color": "black", "marker": "D"},
}
UNSOLVED = "unsolved: what was spent on it"
PANELS = (
    ("iterations", "iterations per step", 1.0),
    ("seconds", "time per step [ms]", 1e3),
    ("tip_error_m", "tip error of the step [m]", 1.0),
)
FLOOR = 1e-17  # [m]: where an error of zero is drawn on a logarithmic axis


def draw_figure_4(chains: Mapping[str, Any], path: Path) -> None:
    """Chains side by side; iterations, time and error of every step."""
    figure, grid = plt.subplots(3, len(chains), figsize=(14, 11), dpi=130, layout="constrained", sharex="col", sharey="row")
    for column, (chain, found) in zip(grid.T, chains.items(), strict=True):
        for axes, (field, label, unit) in zip(column, PANELS, strict=True):
            for case, style in STYLES.items():
                _curve(axes, found["cases"][case], field, unit, style)
            if field == "iterations":
                axes.set_yscale("symlog", linthresh=1)
                axes.set_ylim(bottom=0)
            else:
                axes.set_yscale("log")
            axes.set_ylabel(label)
            axes.tick_params(labelleft=True)
            axes.grid(alpha=0.3)
        touching = "no contact" if chain == "chain-fixed" else "contact with friction"
        worlds = f", {found['worlds']} worlds" if found["worlds"] > 1 else ""
        column[0].set_title(f"{chain}: {touching}, Δt = {found['dt']:g} s{worlds}")
        column[-1].set_xlabel("step")
    handles = [Line2D([], [], label=case, linewidth=1.5, markersize=5, **style) for case, style in STYLES.items()]
    handles.append(Line2D([], [], color="0.4", marker="x", linestyle="", markersize=7, label=UNSOLVED))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle("Fig. 4: the cases of Table I on the same steps (on E friction is lagged)", fontsize=14)
    _save(figure, path)


def _curve(axes: Axes, found: Mapping[str, Any], field: str, unit: float, style: Mapping[str, Any]) -> None:
    """Markers at the measured steps, joined where none was left out."""
    steps = found["per_step"]
    x, y = steps["step"], [max(FLOOR, unit * value) if field == "tip_error_m" else unit * value for value in steps[field]]
    if x == list(range(x[0], x[0] + len(x))):
        axes.plot(x, y, color=style["color"], linewidth=1.2, zorder=2)
    solved = [k for k, count in enumerate(steps["unsolved"]) if count == 0]
    failed = [k for k, count in enumerate(steps["unsolved"]) if count > 0]
    axes.plot([x[k] for k in solved], [y[k] for k in solved], linestyle="", markersize=3.5, zorder=3, **style)
    crosses = {"marker": "x", "markersize": 6, "color": style["color"]}
    axes.plot([x[k] for k in failed], [y[k] for k in failed], linestyle="", zorder=3, **crosses)


def draw_table_1(sizes: Sequence[int], fit: Sequence[int], measured: Mapping[str, Any], path: Path) -> None:
    """Cost over degrees of freedom: substeps above, whole iterations below, one column per variant."""
    figure, grid = plt.subplots(2, len(measured), figsize=(17, 11), dpi=130, layout="constrained", sharey="row")
    for column, (title, found) in zip(grid.T, measured.items(), strict=True):
        for axes, kind in zip(column, ("substeps", "iterations"), strict=True):
            colors = plt.get_cmap("tab10")
            for k, (name, row) in enumerate(found[kind].items()):
                label = SUBSTEPS.get(name, name)
                style = {"color": colors(k), "marker": "o"} if kind == "substeps" else STYLES[name]
                axes.plot(sizes, row["us_per_world"], markersize=4, linewidth=1.4, label=f"{label}: {row['exponent']:.1f}", **style)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks(sizes, [str(n) for n in sizes])
            axes.minorticks_off()
            axes.tick_params(labelleft=True)
            axes.set_xlabel("degrees of freedom n")
            axes.set_ylabel("time per world [µs]")
            axes.grid(alpha=0.3)
            axes.legend(
                title=f"{kind}: exponent over n = {fit[0]} … {fit[-1]}",
                fontsize=8,
                title_fontsize=9,
                loc="upper left",
                framealpha=0.8,
            )
        column[0].set_title(f"{title} (autodiff: {found['worlds_of_autodiff']})")
    for row in grid:
        # room for the legends above the curves
        low, high = row[0].get_ylim()
        row[0].set_ylim(low, high * (high / low) ** 0.45)
        for axes in row:
            _guides(axes, sizes)
    figure.suptitle("Table I: measured cost of substeps and of whole iterations", fontsize=14)
    _save(figure, path)


def _guides(axes: Axes, sizes: Sequence[int]) -> None:
    """Grey slopes n, n² and n³ from the lower left corner on."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    for power in (1, 2, 3):
        ends = [low * 1.3, low * 1.3 * (sizes[-1] / sizes[0]) ** power]
        axes.plot([sizes[0], sizes[-1]], ends, color="0.7", linestyle=":", linewidth=1, zorder=1)
        axes.annotate(
            f"n{'' if power == 1 else '²³'[power - 2]}", (sizes[-1], ends[1]), color="0.5", fontsize=9, annotation_clip=True
        )


def _save(figure: Any, path: Path) -> None:
    write_figure(path, figure)
    plt.close(figure)
