"""Pictures of an identification: fit against data, residuals, and how the cost fell."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pbfd_torch.identify.identification import Identified, variances

SIMULATED, MEASURED = "#d94801", "#08519c"


def draw_fit(axes: Axes, time: Tensor, measured: Tensor, simulated: Tensor, labels: Sequence[str]) -> None:
    """Channels `[steps, k]` over time `[steps]` [s]: measured as dots, simulated as lines, each named at its end."""
    for k, label in enumerate(labels):
        hidden = "" if k == 0 else "_"  # one entry each in the legend
        axes.plot(time, measured[:, k], ".", color=MEASURED, markersize=4, alpha=0.7, label=f"{hidden}measured")
        axes.plot(time, simulated[:, k], color=SIMULATED, linewidth=1.4, label=f"{hidden}simulated")
        axes.annotate(label, (float(time[-1]), float(simulated[-1, k])), xytext=(5, 0), textcoords="offset points", va="center")
    axes.set_xlabel("time [s]")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def draw_residuals(axes: Axes, found: Identified) -> None:
    """Residuals of the best fit in standard deviations of the noise, beside the normal density."""
    residual = found.best.fit.residual
    axes.hist(residual.tolist(), bins=40, range=(-4, 4), density=True, color=MEASURED, alpha=0.6, label="residuals")
    x = torch.linspace(-4, 4, 200)
    axes.plot(x, torch.exp(-0.5 * x * x) / (2 * torch.pi) ** 0.5, color=SIMULATED, label="standard normal")
    axes.set_xlabel("residual / σ of the noise")
    axes.set_ylabel("density")
    axes.legend(frameon=False)


def draw_cost(axes: Axes, found: Identified) -> None:
    """How the residual's variance fell from every start, over the iterations of all horizons; 1 is what the noise alone leaves."""
    begin = 0
    for k, fit in enumerate((*found.before, found.fit)):
        history = variances(fit).reshape(len(fit.history), -1)
        steps = range(begin, begin + len(history))
        axes.plot(steps, history, "-o", color=MEASURED, alpha=0.6, linewidth=1.2, markersize=3)
        if k > 0:
            axes.axvline(begin - 0.5, color="0.7", linewidth=1, label="longer horizon" if k == 1 else "_")
        begin += len(history)
    axes.axhline(1.0, color=SIMULATED, linestyle="--", label="the noise alone")
    axes.set_yscale("log")
    axes.set_xlabel("evaluation")
    axes.set_ylabel("‖r‖² / (m − n)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def draw_values(axes: Axes, found: Identified, truth: Tensor | None = None) -> None:
    """The best fit's quantities with two standard deviations, in per cent of the truth `[k]` where it is known and else of
    themselves."""
    one = found.best
    values, deviations = one.values, one.certainty.deviation
    against = values if truth is None else truth
    names = [quantity.name for quantity in one.identification.quantities]
    rows = range(len(names))
    error, bar = 100 * (values / against - 1), 200 * deviations / against.abs()
    axes.errorbar(error.tolist(), list(rows), xerr=bar.tolist(), fmt="o", color=MEASURED, capsize=3, markersize=4)
    axes.axvline(0, color=SIMULATED, linewidth=1)
    axes.set_yticks(list(rows), names)
    axes.invert_yaxis()
    axes.set_xlabel("off by [%], ± 2σ" if truth is not None else "± 2σ [%]")
    axes.grid(alpha=0.3, axis="x")


def draw(figure: Figure, found: Identified, truth: Tensor | None = None) -> None:
    """Cost, residuals and values side by side."""
    left, middle, right = figure.subplots(1, 3)
    draw_cost(left, found)
    draw_residuals(middle, found)
    draw_values(right, found, truth)
