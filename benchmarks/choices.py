"""What the default tolerance, solver and friction law cost and what they leave: one of them changed at a time, on three scenes.

python benchmarks/choices.py --picture choices.png
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
from matplotlib.ticker import LogLocator, NullLocator

from pbfd_torch.cli.options import Friction, with_friction
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.simulator import Simulator, Solver
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.named import TABLE_1
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11)
SOLVERS = ("JTJ-LM, GE", "LM, GE")  # L-BFGS on GE solves none of the first steps of the chain in 4000 evaluations


@dataclass(frozen=True)
class Scene:
    """Attributes:
    name, dt, seconds: what is run.
    title: what the error is of, in m unless it says so.
    error: the scene's own numbers → error.
    """

    name: str
    dt: float
    seconds: float
    title: str
    error: Callable[[Mapping[str, object]], float]


def worst(numbers: Mapping[str, object], name: str) -> float:
    """The largest absolute value of one of the scene's numbers over its worlds."""
    return float(torch.as_tensor(numbers[name]).abs().max())


ALL = (
    Scene("chain-fixed", 0.02, 1.0, "tip after 1 s", lambda found: worst(found, "tip_error_m")),
    Scene("box-slide", 0.02, 1.5, "stopping distance, worst μ, relative", lambda found: worst(found, "stop_distance_error")),
    Scene("chain-slope-drop", 0.05, 5.0, "Coulomb margin after 5 s", lambda found: worst(found, "coulomb_margin_m")),
)


@dataclass(frozen=True)
class Choice:
    """Attributes:
    kind: which default is changed.
    label: to what.
    solver: None: the default.
    friction: (setup, dt) → the setup under another law.
    """

    kind: str
    label: str
    solver: Solver | None = None
    friction: Callable[[Setup, float], Setup] = field(default=lambda setup, dt: setup)


def anchored(setup: Setup, dt: float) -> Setup:
    """Every contact with anchors, at the μ it has."""
    terms = [
        dataclasses.replace(term, friction=AnchoredFriction(term.friction.mu))
        if isinstance(term, Contact) and isinstance(term.friction, CoulombFriction)
        else term
        for term in setup.scene.terms
    ]
    return dataclasses.replace(setup, scene=dataclasses.replace(setup.scene, terms=tuple(terms)))


def choices(touching: bool) -> list[Choice]:
    """The tolerances, the default among them, then other solvers, then other laws where something touches."""
    found = [Choice("tolerance", f"{x:g}", Fallbacks.within(x)) for x in TOLERANCES]
    found += [Choice("solver", name, TABLE_1[name]()) for name in SOLVERS]
    if touching:
        found.append(Choice("friction", "anchored", friction=anchored))
        found.append(Choice("friction", "PBFD", friction=lambda setup, dt: with_friction(setup, Friction.PBFD_PRINTED, dt)))
    return found


def draw(axes: Any, scene: Scene, drawn: Mapping[str, list[tuple[float, float, str]]]) -> None:
    """One panel: of each kind, evaluations a step, error and label."""
    for kind, points in drawn.items():
        x, y, _ = zip(*points, strict=True)
        axes.plot(x, y, marker="o", linestyle="-" if kind == "tolerance" else "", label=kind)
        for a, b, label in points:
            axes.annotate(label, (a, b), xytext=(3, 5), textcoords="offset points", fontsize=8, rotation=55)
    axes.set(
        xscale="log",
        yscale="log",
        title=f"{scene.name}, Δt {scene.dt:g} s",
        xlabel="evaluations a step",
        ylabel=f"error: {scene.title}",
    )
    for axis in (axes.xaxis, axes.yaxis):
        # within two decades all ticks would be labelled, and run into each other
        if math.log10(axis.get_view_interval()[1] / axis.get_view_interval()[0]) < 2:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
    axes.margins(x=0.15, y=0.25)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path, help="PNG file")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    figure, panels = plt.subplots(1, len(ALL), figsize=(15, 4.6), layout="constrained")
    for scene, axes in zip(ALL, panels, strict=True):
        print(f"\n{scene.name}, Δt {scene.dt} s: error of the {scene.title}; float64, one thread, eager")
        print("changed   | to          | error     | evaluations a step | ms a step | unsolved")
        plain = SCENES[scene.name]()
        drawn: dict[str, list[tuple[float, float, str]]] = {}
        for choice in choices(any(isinstance(term, Contact) for term in plain.scene.terms)):
            setup = choice.friction(plain, scene.dt)
            simulator = Simulator(setup.scene, scene.dt, solver=choice.solver)
            steps = round(scene.seconds / scene.dt)
            start = simulator.initial_state(setup.q, setup.v)
            began = time.perf_counter()
            rollout = simulator.rollout(start, steps=steps)
            wall = 1e3 * (time.perf_counter() - began) / steps
            error, spent = scene.error(setup.metrics(rollout)), float(rollout.evaluations.double().mean())
            unsolved = int((~rollout.solved).sum())
            print(f"{choice.kind:9s} | {choice.label:11s} | {error:9.2e} | {spent:18.2f} | {wall:9.1f} | {unsolved}")
            drawn.setdefault(choice.kind, []).append((spent, max(error, 1e-14), choice.label))
        draw(axes, scene, drawn)
    if chosen.picture is not None:
        figure.savefig(chosen.picture, dpi=90)


if __name__ == "__main__":
    main()
