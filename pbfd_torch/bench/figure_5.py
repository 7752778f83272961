"""Fig. 5 of the paper: how far a box slides, against the parameter of the friction law, at several time steps.

The box is the paper's, 2D: it moves along x and z and turns about y, on the four lower corners of a box. Every law runs all values
of its parameter as a batch of worlds, and is compared with what it should do: a point mass that brakes with the law's own μ(v).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from torch import Tensor

from pbfd_torch.bench.stepped import stepped
from pbfd_torch.bench.timing import Progress
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Collider
from pbfd_torch.files import write_figure
from pbfd_torch.native.engine import Engine, Torch
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.named import OnLagged, lm
from pbfd_torch.stepping.stepper import Solver
from pbfd_torch.terms.calibration import effective_mu, load_per_point, normal_force_for
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

GRAVITY = 9.81
MASS = 1.0  # [kg]
HALF = (0.1, 0.1, 0.05)  # half extents [m]
CORNERS = 4  # that touch
PENETRATION = 1e-3  # at rest [m]
SPEED = 1.0  # at the start [m/s], as in the paper
DURATION = 4.0  # [s]
AT_REST = 0.01 * SPEED  # [m/s]
TIME_STEPS = (0.005, 0.01, 0.02, 0.05)
QUICK_TIME_STEPS = (0.02, 0.05)
NORMAL_FORCE = normal_force_for(MASS, GRAVITY, CORNERS, PENETRATION)
LOAD = load_per_point(MASS, GRAVITY, CORNERS)
NOTES = (
    f"distance: what the box covers in {DURATION:g} s, falls: throughout, as the parameter grows, least: the shortest one",
    f"moving: worlds whose box is faster than {AT_REST:g} m/s at the end",
    "error: of the distance, against a point mass that brakes with the law's own μ(v); for Coulomb's law that is v²/(2μg)",
    (
        "PBD, min E: the same law, each step the minimum of the energy E (Eq. 6) by LM, as PBD has it, instead of the root of r: "
        "in PyTorch, for the core has no such solver"
    ),
    "trials: evaluations of r; time: of one step of one world, in a batch of all values of the parameter",
)


@dataclass(frozen=True)
class Case:
    """One law. `make`: the law for values `[worlds, 1]` of its parameter, which run from 10^`low` to 10^`high` times `unit`.
    `solver`: None: the default one; with any other, steps are made in PyTorch."""

    title: str
    low: float
    high: float
    unit: float
    make: Callable[[Tensor], FrictionLaw]
    solver: Solver | None = None

    def values(self, count: int) -> Tensor:
        """`[count]`, in a geometric progression."""
        return self.unit * torch.logspace(self.low, self.high, count, dtype=torch.float64)


_UNIT = float(NORMAL_FORCE.stiffness)
CASES = {
    "coulomb": Case("Coulomb", -1.25, 0.0, 1.0, CoulombFriction),
    "pbd": Case("PBD", -1.0, 3.0, _UNIT, PbdFriction),
    "pbd-energy": Case("PBD, min E", -1.0, 3.0, _UNIT, PbdFriction, OnLagged(lm())),
    "pbfd-printed": Case("PBFD, printed", 1.0, 5.0, _UNIT, PbfdFriction.as_printed),
    "pbfd-derived": Case("PBFD, derived", -1.0, 3.0, _UNIT, PbfdFriction.as_derived),
}


def sliding_box(law: FrictionLaw) -> Scene:
    """The box on the plane z = 0."""
    x, y, z = (h * h * MASS / 3 for h in HALF)
    joints = (
        Joint("along", JointKind.SLIDE, (1.0, 0.0, 0.0)),
        Joint("up", JointKind.SLIDE, (0.0, 0.0, 1.0)),
        Joint("pitch", JointKind.HINGE, (0.0, 1.0, 0.0)),
    )
    rows = ((y + z, 0.0, 0.0), (0.0, x + z, 0.0), (0.0, 0.0, x + y))
    articulation = Articulation.from_links([Link("box", joints=joints, mass=MASS, inertia=rows)])
    colliders, ground = [Collider("box", "box", Box(HALF))], HalfSpace()
    contact = Contact.between(articulation, colliders, ground, NORMAL_FORCE, law)
    gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    return Scene(articulation, (Inertia(), contact), gravity, colliders, (ground,), "sliding box")


def expected_distance(law: FrictionLaw, dt: float, worlds: int) -> Tensor:
    """What a point mass covers in the duration [m] `[worlds]`: dv/dt = −μ(v) g, by the trapezoidal rule over ln v."""
    slowed = torch.logspace(-9, math.log10(20), 4000, dtype=torch.float64)  # ln of the start's speed over v
    speed = SPEED * torch.exp(-torch.cat((slowed.new_zeros(1), slowed)))
    mu = effective_mu(law, NORMAL_FORCE, speed, dt, LOAD).expand(worlds, -1)
    lasts = speed / (mu * GRAVITY)  # dt/d(−ln v)
    width = -speed.log().diff()
    moment, path = (_accumulated(0.5 * width * (x[:, 1:] + x[:, :-1])) for x in (lasts, lasts * speed))
    before = (moment < DURATION).sum(-1, keepdim=True).clamp(max=len(speed) - 1) - 1
    rest = (DURATION - moment.gather(-1, before)).clamp_min(0)
    reach = path.gather(-1, before + 1) - path.gather(-1, before)
    span = moment.gather(-1, before + 1) - moment.gather(-1, before)
    return (path.gather(-1, before) + reach * (rest / span).clamp_max(1)).squeeze(-1)


def _accumulated(parts: Tensor) -> Tensor:
    return torch.cat((torch.zeros_like(parts[:, :1]), parts.cumsum(-1)), -1)


def measure_case(case: Case, dt: float, count: int, progress: Progress, engine: Engine | None = None) -> dict[str, Any]:
    """One curve as plain data: distances [m] and final speeds [m/s] over the values, which engine made it, and what it cost."""
    values = case.values(count)
    law = case.make(values[:, None])
    simulator = Simulator(sliding_box(law), dt, solver=case.solver, engine=engine if case.solver is None else Torch())
    q, v = torch.zeros(count, 3, dtype=torch.float64), torch.zeros(count, 3, dtype=torch.float64)
    q[:, 1], v[:, 0] = HALF[2] - PENETRATION, SPEED
    state = simulator.initial_state(q, v)
    steps = round(DURATION / dt)
    started = time.perf_counter()
    states, solution = stepped(simulator, state, steps)
    seconds = time.perf_counter() - started
    progress(1)
    distance, expected = states.q[-1, :, 0], expected_distance(law, dt, count)
    speed = simulator.integrator.velocity(simulator.scene.articulation, states, simulator.step_size)[-1, :, 0]
    least = int(distance.argmin())
    return {
        "engine": simulator.engine,
        "values": values.tolist(),
        "distance_m": distance.tolist(),
        "expected_m": expected.tolist(),
        "final_speed_m_s": speed.tolist(),
        "falls": bool((distance.diff() < 0).all()),
        "least_m": float(distance[least]),
        "least_at": float(values[least]),
        "error_max_m": float((distance - expected).abs().max()),
        "moving": int((speed.abs() > AT_REST).sum()),
        "steps": steps,
        "unsolved_steps": int((~solution.solved).sum()),
        "evaluations": int(solution.evaluations.sum()) / (steps * count),
        "us_per_step": 1e6 * seconds / (steps * count),
    }


def measure(time_steps: Sequence[float], count: int, progress: Progress, engine: Engine | None = None) -> dict[str, dict[str, Any]]:
    """All curves: case → time step, as text → curve."""
    return {key: {f"{dt:g}": measure_case(case, dt, count, progress, engine) for dt in time_steps} for key, case in CASES.items()}


COLORS = ("#440154", "#31688e", "#35b779", "#e8a400", "#d62728", "#7f7f7f")
PANELS = (
    ("coulomb", "(a) dry friction: Coulomb's law", "μ"),
    ("pbd", "(b) PBD: the whole gradient of Eq. 11", "C∥ [N/m³]"),
    ("pbfd-printed", "(c) PBFD: Eq. 12 as printed, ‖u‖^β", "C∥ [N/m⁴]"),
    ("pbfd-derived", "(d) PBFD: Eq. 12 as derived, ‖u‖^(β−1)", "C∥ [N/m³]"),
)


def draw(curves: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Four panels, one law each; a colour for every time step. Raises `OSError` where the file cannot be written."""
    figure, grid = plt.subplots(2, 2, figsize=(11, 8), dpi=80, layout="constrained")
    for axes, (key, title, label) in zip(grid.flat, PANELS, strict=True):
        for color, (dt, curve) in zip(COLORS, curves[key].items(), strict=False):
            _draw_curve(axes, curve, color)
            if key == "pbd":
                beside = curves["pbfd-derived"][dt]
                axes.plot(beside["values"], beside["expected_m"], color=color, linestyle=":", linewidth=1)
                axes.plot(curve["least_at"], curve["least_m"], marker="v", markersize=11, color=color, markeredgecolor="black")
        if key != "coulomb":
            axes.axhline(SPEED * DURATION, color="0.6", linewidth=1, linestyle="--")
        axes.set(xscale="log", title=title, xlabel=label, ylabel=f"distance in {DURATION:g} s [m]")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    steps = [
        Line2D([], [], color=color, marker="o", markersize=5, label=f"Δt = {dt} s")
        for color, dt in zip(COLORS, curves["coulomb"], strict=False)
    ]
    marks = [
        Line2D([], [], color="0.3", label="point mass with the law's μ(v)"),
        Line2D([], [], color="0.3", marker="o", linestyle="", markersize=5, label="box, simulated"),
        Line2D([], [], color="0.3", marker="o", linestyle="", markersize=5, markerfacecolor="white", label="still moving"),
        Line2D([], [], color="0.3", marker="v", linestyle="", markersize=9, markeredgecolor="black", label="least distance of PBD"),
        Line2D([], [], color="0.3", linestyle=":", label="(d) again: PBD without f*"),
        Line2D([], [], color="0.6", linestyle="--", label="no friction at all"),
    ]
    figure.legend(handles=[*steps, *marks], loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(f"Fig. 5: a box that starts at {SPEED:g} m/s; sliding distance against the strength of friction", fontsize=13)
    write_figure(path, figure)
    plt.close(figure)


def _draw_curve(axes: Axes, curve: Mapping[str, Any], color: str) -> None:
    """Line: expected; markers: simulated, hollow while the box still moves."""
    axes.plot(curve["values"], curve["expected_m"], color=color, linewidth=1.3)
    moving = [abs(speed) > AT_REST for speed in curve["final_speed_m_s"]]
    for hollow, face in ((False, color), (True, "white")):
        chosen = [k for k, moves in enumerate(moving) if moves is hollow]
        points = [[curve[name][k] for k in chosen] for name in ("values", "distance_m")]
        axes.plot(*points, linestyle="", marker="o", markersize=4.5, color=color, markerfacecolor=face)
