"""Fig. 6 of the paper: what ten seconds of a chain sliding off a slope cost, against Δt, contacts in touch, and friction.

Ours and the conventional stepper take the same scene from the same starts; `figure_6_peers` has MuJoCo do it. The conventional
stepper is in PyTorch, so the paper's integrator is there in PyTorch too, to compare times of like with like. A run gives one row of
plain data: which engine made it, whether it was stable, how wrong it was, and what it cost. `figure_6_claims` holds the rows
against the paper.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import center_of_mass, kinetic_energy, momentum, potential_energy
from pbfd_torch.bench import figure_6_peers, mujoco_runs
from pbfd_torch.bench.stepped import one_by_one, stepped
from pbfd_torch.bench.timing import Progress, timed
from pbfd_torch.conventional.newton_euler import NewtonEuler
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.models import chains
from pbfd_torch.native.engine import Engine, Torch
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.kinematics import Motion, place

Row = dict[str, Any]

GAIN_LIMIT = 0.1  # of energy: more is unstable
IN_TOUCH = 1e-4  # [m] from the ground: no further counts as a contact
SPEED = 1.0  # [m/s] at which the PBFD law's C∥ gives μ
COMMON_STEP = 0.0025  # [s], the largest that the paper gives Newton–Euler
MASS = 10 * chains.MASS
LIFT = MASS * chains.GRAVITY * chains.RADIUS  # [J], a scale for gains of energy while hardly anything moves yet


# What is simulated --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Start:
    """`make`: q `[1, nq]`; `spin`: standard deviation of the hinges' speeds [rad/s], with a fixed seed."""

    title: str
    make: Callable[[], Tensor]
    spin: float = 0.0

    def state(self) -> tuple[Tensor, Tensor]:
        """q `[1, nq]` and v `[1, nv]`."""
        q = self.make()
        v = q.new_zeros(1, q.shape[-1] - 1)
        random = torch.Generator().manual_seed(0)
        v[:, 6:] = self.spin * torch.randn(256, v.shape[-1] - 6, dtype=q.dtype, generator=random)[:1]
        return q, v


STARTS = {
    "laid": Start("laid straight on the slope", lambda: chains.chain_slope().q),
    "dropped": Start("pitched by 20°, dropped from 0.1 m", lambda: chains.chain_slope_drop().q),
    "scattered": Start("laid, hinges at random 5 rad/s", lambda: chains.chain_slope().q, 5.0),
}
SCENE = "dropped"  # the paper's, of panels (c) and (d)


def coulomb(mu: float, dt: float) -> FrictionLaw:
    """Dry friction."""
    return CoulombFriction(mu)


def pbfd(mu: float, dt: float) -> FrictionLaw:
    """PBFD's law with the C∥ that gives μ at `SPEED`."""
    return PbfdFriction.as_derived(0.0).calibrated(mu, chains.STIFFNESS, SPEED, dt)


LAWS = {"Coulomb": coulomb, "PBFD": pbfd}


@dataclass(frozen=True)
class Case:
    """One run. Attributes:
    start: its name among `STARTS`.
    dt, steps: time step [s] and how many.
    points: per link; mu: coefficient of friction; law: its name among `LAWS`.
    """

    start: str
    dt: float
    steps: int
    points: int = 2
    mu: float = chains.SLOPE_FRICTION
    law: str = "Coulomb"

    def scene(self) -> Scene:
        """`chain_slope` with these contacts."""
        scene = chains.chain_slope(points=self.points).scene
        law = LAWS[self.law](self.mu, self.dt)
        terms = [dataclasses.replace(term, friction=law) if isinstance(term, Contact) else term for term in scene.terms]
        return dataclasses.replace(scene, terms=tuple(terms))


# Who simulates it ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Steps:
    """What `Simulator` and `NewtonEuler` have in common.

    Attributes:
        engine: that makes the steps, by its name.
        start: q `[worlds, nq]`, v `[worlds, nv]` → state.
        made: (state, count) → the states after so many steps, and how these were solved, `[count, worlds, ...]`.
        rates: states → pose rates Ṫ `[*, nlink, 3, 4]`, whose kinetic energy is the scheme's own: of implicit Euler over the step,
            which is not that of a velocity at its end.
    """

    engine: str
    start: Callable[[Tensor, Tensor], Any]
    made: Callable[[Any, int], tuple[Any, Solution]]
    rates: Callable[[Any], Tensor]


@dataclass(frozen=True)
class Formulation:
    """A simulator of this library. `make`: (scene, Δt, engine) → its steps."""

    title: str
    make: Callable[[Scene, float, Engine | None], Steps]


def _ours(integrator: Callable[[], Any], by: Engine | None = None) -> Callable[[Scene, float, Engine | None], Steps]:
    """`by`: an engine whatever is asked for."""

    def make(scene: Scene, dt: float, engine: Engine | None) -> Steps:
        simulator = Simulator(scene, dt, integrator(), engine=by or engine)
        return Steps(
            simulator.engine,
            simulator.initial_state,
            lambda state, count: stepped(simulator, state, count),
            lambda states: simulator.integrator.pose_rates(scene.articulation, states, simulator.step_size),
        )

    return make


def _newton_euler(scene: Scene, dt: float, engine: Engine | None) -> Steps:
    """In PyTorch always."""
    stepper = NewtonEuler(scene, dt)
    return Steps(
        Torch.name,
        stepper.initial_state,
        lambda state, count: one_by_one(stepper.step, state, count),
        lambda states: pose_rates(scene, states.q, states.v),
    )


def pose_rates(scene: Scene, q: Tensor, v: Tensor) -> Tensor:
    """Ṫ `[*batch, nlink, 3, 4]` of a velocity v `[*batch, nv]` at q `[*batch, nq]`."""
    return Motion(place(scene.articulation, q), v).rates


EAGER = "implicit-euler-torch"
FORMULATIONS = {
    "implicit-euler": Formulation("ours, Euler", _ours(ImplicitEuler)),
    EAGER: Formulation("ours, Euler, PyTorch", _ours(ImplicitEuler, Torch())),
    "energy-momentum": Formulation("ours, energy–mom.", _ours(EnergyMomentum)),
    "conventional": Formulation("Newton–Euler", _newton_euler),
}
OURS = ("implicit-euler", EAGER, "energy-momentum")
IN_B_ALONE = (EAGER, "energy-momentum")  # not in panels (c) and (d)
TITLES = {key: x.title for key, x in FORMULATIONS.items()} | {key: x.title for key, x in figure_6_peers.PEERS.items()}
# in panel (b), how many times as many steps as others: cheap ones, whose stability is to be seen
REACH = {"conventional": 4, **dict.fromkeys(figure_6_peers.PEERS, 10_000)}


@dataclass(frozen=True)
class Effort:
    """How much is measured. Attributes:
    duration: of a trajectory [s].
    time_steps: [s], of panel (b).
    worlds: in the batch; batch_steps: how many of its steps are timed.
    repeats: of what takes less than a third of a second, to take the shortest time.
    most_steps: in one run, times `REACH` in panel (b): longer ones are cut, and times are per simulated second.
    points: per link, of panel (c); frictions: μ of panel (d).
    """

    duration: float = 10.0
    time_steps: Sequence[float] = (0.001, 0.002, 0.0025, 0.005, 0.01, 0.02, 0.05, 0.1)
    worlds: int = 256
    batch_steps: int = 2
    repeats: int = 3
    most_steps: int = 500
    points: Sequence[int] = (2, 4, 8, 16, 32)
    frictions: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    starts: Sequence[str] = field(default_factory=lambda: tuple(STARTS))

    def case(self, start: str, dt: float, reach: int = 1, **changes: Any) -> Case:
        """A run as long as it may be."""
        return Case(start, dt, max(1, min(round(self.duration / dt), reach * self.most_steps)), **changes)


FULL = Effort()
QUICK = Effort(
    duration=0.5,
    time_steps=(0.0025, 0.02, 0.1),
    worlds=4,
    batch_steps=1,
    repeats=1,
    most_steps=80,
    points=(2, 16),
    frictions=(0.1, 0.4, 0.8),
    starts=("dropped", "scattered"),
)


# One run ------------------------------------------------------------------------------------------------------------------


def measure_run(
    simulator: str, case: Case, worlds: int = 0, batch_steps: int = 1, repeats: int = 1, engine: Engine | None = None
) -> Row:
    """One row. worlds > 1: a batch of them is timed too, for `batch_steps`; `repeats` as in `Effort`; engine: of ours. Times: wall
    ms per simulated second and world."""
    (q, v), scene = STARTS[case.start].state(), case.scene()
    row = {"simulator": simulator, "engine": mujoco_runs.ENGINE, **dataclasses.asdict(case), "simulated_s": case.steps * case.dt}
    if simulator not in FORMULATIONS:
        ran = figure_6_peers.run(simulator, q[0], v[0], case.dt, case.steps, case.points, case.mu, repeats)
        seen = observed(case, ran.q[:, None], pose_rates(scene, ran.q, ran.v)[:, None])
        time = {"1": 1e3 * ran.seconds / row["simulated_s"]} if seen["finite"] else {}
        return {**row, **seen, "unsolved_steps": 0, "evaluations": math.nan, "ms_per_s": time}
    steps = FORMULATIONS[simulator].make(scene, case.dt, engine)
    start = steps.start(q, v)
    (states, solution), seconds = timed(lambda: lambda: steps.made(start, case.steps), repeats, enough_s=0.3)
    moving = torch.cat((pose_rates(scene, q, v)[None], steps.rates(states)))
    seen = observed(case, torch.cat((q[None], states.q)), moving)
    time = {"1": 1e3 * seconds / row["simulated_s"]} if seen["finite"] else {}
    if worlds > 1 and seen["stable"]:
        begun = mapped(lambda first, rest: torch.cat((first[None], rest[:-1])), start, states)
        time[str(worlds)] = _batch_time(steps, begun, worlds, batch_steps, repeats) / case.dt
    return {
        **row,
        **seen,
        "engine": steps.engine,
        "unsolved_steps": int((~solution.solved).sum()),
        "evaluations": int(solution.evaluations.sum()) / case.steps,
        "ms_per_s": time,
    }


def _batch_time(steps: Steps, states: Any, worlds: int, count: int, repeats: int) -> float:
    """[ms] of one step of one world in a batch, whose worlds start all along a trajectory `[T, 1, ...]`: so few steps tell what it
    costs."""
    rows = torch.arange(worlds) * len(states.q) // worlds
    start = mapped(lambda x: x[rows, 0], states)
    return 1e3 * timed(lambda: lambda: steps.made(start, count), repeats, enough_s=0.3)[1] / count / worlds


def observed(case: Case, q: Tensor, rates: Tensor) -> Row:
    """What a motion q `[T + 1, 1, nq]` with pose rates `[T + 1, 1, nlink, 3, 4]` shows.

    energy_gain: the largest rise of mechanical energy above what it had been, over the kinetic energy reached by then and that of
    lifting the chain by its radius. margin_m: how far the centre of mass went beyond sliding straight down all the time with the
    case's μ, gravity's normal part and the landing included: 0 while everything slides downhill, < 0: too much friction."""
    scene = case.scene()
    placement = place(scene.articulation, q)
    kinetic = kinetic_energy(scene.articulation, rates)[:, 0]
    energy = kinetic + potential_energy(placement, scene.gravity)[:, 0]
    center, linear = center_of_mass(placement)[:, 0], momentum(placement, rates)[0][:, 0]
    depth = torch.cat([term.depth(placement) for term in scene.terms if isinstance(term, Contact)], -1)
    finite = bool(torch.isfinite(energy).all())
    gain = float(((energy - energy.cummin(0)[0]) / (kinetic.cummax(0)[0] + LIFT)).amax()) if finite else math.nan
    time = case.dt * (len(q) - 1)
    beyond = center[-1] - center[0] - time * linear[0] / MASS
    slide = chains.GRAVITY * (math.sin(chains.SLOPE) - case.mu * math.cos(chains.SLOPE))
    return {
        "finite": finite,
        "stable": finite and gain <= GAIN_LIMIT,
        "energy_gain": gain,
        "margin_m": float(beyond[0] - 0.5 * slide * time**2 + case.mu * beyond[2]),
        "penetration_mm": 1e3 * float(depth.amax().clamp_min(0)),
        "in_touch": float((depth > -IN_TOUCH).sum(-1).double().mean()) if finite else math.nan,
        "speed_m_s": float(torch.linalg.vector_norm(linear[-1]) / MASS),
    }


# All of them --------------------------------------------------------------------------------------------------------------


def best_step(rows: Sequence[Row], simulator: str, start: str) -> float | None:
    """The largest Δt of panel (b) that is stable from a start, with every smaller one; None: there is none."""
    own = [row for row in rows if (row["simulator"], row["start"]) == (simulator, start)]
    unstable = min((row["dt"] for row in own if not row["stable"]), default=math.inf)
    return max((row["dt"] for row in own if row["dt"] < unstable), default=None)


def measure(effort: Effort, progress: Progress, engine: Engine | None = None) -> dict[str, Any]:
    """The three panels as plain data, ours by an engine: rows of (b) `time_steps`, (c) `contacts`, (d) `friction`, both of the
    start `SCENE`; `best_dt`: start → simulator → Δt, `own_dt` what (c) and (d) take for it; and a `picture` of the scene. Without
    MuJoCo, its rows are missing. Those of `IN_B_ALONE` are not in (c) and (d)."""
    simulators = _simulators(engine)
    steps = []
    for simulator, start, dt in [(x, y, z) for y in effort.starts for x in simulators for z in effort.time_steps]:
        case = effort.case(start, dt, REACH.get(simulator, 1))
        steps.append(measure_run(simulator, case, effort.worlds, effort.batch_steps, effort.repeats, engine))
        progress(1)
    best = {start: {key: best_step(steps, key, start) for key in simulators} for start in effort.starts}
    own = {key: dt or min(effort.time_steps) for key, dt in best[SCENE].items() if key not in IN_B_ALONE}
    contacts = []
    for simulator, points in [(x, y) for x in own for y in effort.points]:
        for dt in sorted({own[simulator], COMMON_STEP}):
            case = effort.case(SCENE, dt, points=points)
            contacts.append(measure_run(simulator, case, effort.worlds, effort.batch_steps, effort.repeats, engine))
        progress(1)
    frictions = []
    for simulator, law in [*((key, "Coulomb") for key in own), ("implicit-euler", "PBFD")]:
        for mu in effort.frictions:
            case = effort.case(SCENE, own[simulator], mu=mu, law=law)
            frictions.append(measure_run(simulator, case, repeats=effort.repeats, engine=engine))
            progress(1)
    return {
        "time_steps": steps,
        "contacts": contacts,
        "friction": frictions,
        "best_dt": best,
        "own_dt": own,
        "picture": list(snapshots(engine)),
    }


def _simulators(engine: Engine | None) -> list[str]:
    """Those that can be run; ours in PyTorch is not run twice."""
    ours = [key for key in FORMULATIONS if not (key == EAGER and engine == Torch())]
    return [*ours, *(figure_6_peers.PEERS if mujoco_runs.version() else ())]


def units(effort: Effort, engine: Engine | None = None) -> int:
    """What `measure` tells its progress in all."""
    simulators = _simulators(engine)
    refined = sum(key not in IN_B_ALONE for key in simulators)
    steps = len(effort.starts) * len(effort.time_steps) * len(simulators)
    return steps + refined * len(effort.points) + (refined + 1) * len(effort.frictions)


def snapshots(engine: Engine | None = None, dt: float = 0.02, every: int = 10, count: int = 7) -> Iterator[Row]:
    """The dropped chain every so many steps: x and z [m] of its links' ends, gravity along −z."""
    case = Case(SCENE, dt, every * count)
    scene = case.scene()
    steps = FORMULATIONS["implicit-euler"].make(scene, dt, engine)
    start = steps.start(*STARTS[case.start].state())
    path = torch.cat((start.q[None], steps.made(start, case.steps)[0].q))
    for k in range(0, case.steps, every):
        poses = place(scene.articulation, path[k]).poses[0, :, :3]
        ends = torch.cat((poses[..., 3], poses[-1:, :, 3] + chains.LENGTH * poses[-1:, :, 0]))
        x, z = ends[:, 0], ends[:, 2]
        sine, cosine = math.sin(chains.SLOPE), math.cos(chains.SLOPE)
        yield {"time_s": k * dt, "x_m": (cosine * x + sine * z).tolist(), "z_m": (cosine * z - sine * x).tolist()}
