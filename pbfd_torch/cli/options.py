"""The command's choices, and the setup they lead to."""

from __future__ import annotations

import dataclasses
import enum
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from pbfd_torch.errors import InputError
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES, Setup, file_setup
from pbfd_torch.native.engine import Engine, Native, Torch
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import AdaptiveSimulator, Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.named import OnSquares, jtj_lm, lbfgs, lm
from pbfd_torch.stepping.stepper import Solver
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import DryFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.pbfd_friction import PbfdFriction

CALIBRATION_SPEED = 1.0  # [m/s] at which the PBFD law's C∥ gives the scene's μ


class Integrator(enum.StrEnum):
    IMPLICIT_EULER = "implicit-euler"
    BDF2 = "bdf2"
    VARIATIONAL = "variational"
    ENERGY_MOMENTUM = "energy-momentum"
    RUNGE_KUTTA = "runge-kutta"


class SolverChoice(enum.StrEnum):
    JTJ_LM = "jtj-lm"
    JTJ_LM_DIRECT = "jtj-lm-direct"
    JTJ_LM_DAMPED = "jtj-lm-damped"
    LM = "lm"
    LBFGS = "lbfgs"


class Schedule(enum.StrEnum):
    LOCK_STEP = "lock-step"
    ASYNCHRONOUS = "asynchronous"


class EngineChoice(enum.StrEnum):
    NATIVE = "native"
    TORCH = "torch"

    @staticmethod
    def engine(choice: EngineChoice | None) -> Engine | None:
        """What was chosen; None: the core where it can."""
        return None if choice is None else _ENGINES[choice]


EngineOption = Annotated[
    EngineChoice | None,
    typer.Option("--engine", help="What makes the steps; default: the compiled core where it can, else torch."),
]


class Friction(enum.StrEnum):
    COULOMB = "coulomb"
    ANCHORED = "anchored"
    PBFD_PRINTED = "pbfd"
    PBFD_DERIVED = "pbfd-derived"
    NONE = "none"


class Dtype(enum.StrEnum):
    FLOAT64 = "float64"
    FLOAT32 = "float32"

    @property
    def torch(self) -> torch.dtype:
        return torch.float64 if self is Dtype.FLOAT64 else torch.float32


class Device(enum.StrEnum):
    CPU = "cpu"
    CUDA = "cuda"


_SOLVERS: dict[SolverChoice, Callable[[], Solver]] = {
    SolverChoice.JTJ_LM: Fallbacks,
    SolverChoice.JTJ_LM_DIRECT: Descent,
    SolverChoice.JTJ_LM_DAMPED: jtj_lm,
    SolverChoice.LM: lambda: OnSquares(lm()),
    SolverChoice.LBFGS: lambda: OnSquares(lbfgs()),
}

_ENGINES: dict[EngineChoice, Engine] = {EngineChoice.NATIVE: Native(), EngineChoice.TORCH: Torch()}


@dataclass(frozen=True)
class Choices:
    """What the user chose, besides the scene, its length and where the result goes."""

    integrator: Integrator = Integrator.ENERGY_MOMENTUM
    solver: SolverChoice = SolverChoice.JTJ_LM
    friction: Friction | None = None
    dtype: Dtype = Dtype.FLOAT64
    device: Device = Device.CPU
    seed: int | None = None
    free_base: bool | None = None
    keyframe: str | None = None
    schedule: Schedule = Schedule.LOCK_STEP
    workers: int = 1
    accuracy: float | None = None
    engine: EngineChoice | None = None

    def __post_init__(self) -> None:
        if self.accuracy is not None and self.schedule is Schedule.ASYNCHRONOUS:
            raise InputError("--accuracy lets every world go at its own pace already: leave out --schedule asynchronous")
        if self.schedule is Schedule.ASYNCHRONOUS and self.workers > 1:
            raise InputError(f"--workers is {self.workers}: must be 1 with --schedule asynchronous")
        if self.schedule is Schedule.ASYNCHRONOUS and self.solver in (SolverChoice.LM, SolverChoice.LBFGS):
            raise InputError(f"--solver is {self.solver.value}: must be one of the jtj-lm with --schedule asynchronous")

    def make_solver(self) -> Solver:
        return _SOLVERS[self.solver]()

    def make_simulator(self, scene: Scene, dt: float) -> Simulator[Any]:
        """Raises `InputError` for a Δt or an accuracy out of range, and for an engine that cannot."""
        integrator, solver, engine = INTEGRATORS[self.integrator.value](), self.make_solver(), EngineChoice.engine(self.engine)
        if self.accuracy is None:
            return Simulator(scene, dt, integrator, solver, engine=engine)
        return AdaptiveSimulator(scene, dt, self.accuracy, integrator, solver, engine=engine)


def use_threads(count: int) -> None:
    """Lets PyTorch use `count` CPU threads. Its default, one per core, makes the factorisation of many small matrices up to 20
    times slower where another process uses a core."""
    torch.set_num_threads(count)


def load_setup(scene: str, worlds: int | None, choices: Choices) -> Setup:
    """The named scene or the file, in the wanted number of worlds, on the wanted device. Raises `InputError` or `ModelError`."""
    if choices.device is Device.CUDA and not torch.cuda.is_available():
        raise InputError("--device is cuda, but PyTorch finds no CUDA device: choose cpu")
    if scene in SCENES:
        if choices.free_base is not None:
            given = "--free-base" if choices.free_base else "--fixed-base"
            raise InputError(f"{given} is for URDF files only: leave it out for the scene '{scene}'")
        if choices.keyframe is not None:
            raise InputError(f"--keyframe is for MJCF files only: leave it out for the scene '{scene}'")
        count = {} if worlds is None else {"worlds": worlds}
        setup = SCENES[scene](**count, dtype=choices.dtype.torch, device=choices.device.value)
    elif Path(scene).suffix or os.path.exists(scene):
        setup = file_setup(scene, worlds or 1, choices.dtype.torch, choices.device.value, choices.free_base, choices.keyframe)
    else:
        raise InputError(f"'{scene}' is no file and no named scene: the scenes are {', '.join(SCENES)}")
    return setup if choices.seed is None else _shaken(setup, choices.seed)


def _shaken(setup: Setup, seed: int) -> Setup:
    """All worlds but the first start with random extra velocities, normal with 0.05 m/s and rad/s."""
    generator = torch.Generator().manual_seed(seed)
    extra = 0.05 * torch.randn(setup.v.shape, generator=generator, dtype=torch.float64)
    extra[0] = 0
    return dataclasses.replace(setup, v=setup.v + extra.to(setup.v.device, setup.v.dtype))


def with_friction(setup: Setup, choice: Friction | None, dt: float) -> Setup:
    """The setup with another friction law in all its contacts; the PBFD laws are calibrated to its μ at 1 m/s and this Δt.
    Raises `InputError` where there is no contact."""
    if choice is not None and not any(isinstance(term, Contact | BodyContact) for term in setup.scene.terms):
        raise InputError(f"--friction is {choice.value}, but nothing can touch in '{setup.scene.name}': leave it out")
    if choice is None or choice is Friction.COULOMB:
        return setup
    terms = [
        dataclasses.replace(term, friction=_law(choice, term, dt)) if isinstance(term, Contact | BodyContact) else term
        for term in setup.scene.terms
    ]
    return dataclasses.replace(setup, scene=dataclasses.replace(setup.scene, terms=tuple(terms)))


def _law(choice: Friction, contact: Contact | BodyContact, dt: float) -> FrictionLaw | None:
    if choice is Friction.NONE or not isinstance(contact.friction, DryFriction):
        return None
    if choice is Friction.ANCHORED:
        return AnchoredFriction(contact.friction.mu)
    base = PbfdFriction.as_printed(0.0) if choice is Friction.PBFD_PRINTED else PbfdFriction.as_derived(0.0)
    return base.calibrated(contact.friction.mu, contact.normal_force.stiffness, CALIBRATION_SPEED, dt)
